"""The whole way with an ABB robot: `simulate-controller abb` in a process of its own, over TCP and over its serial line."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import devices_of, load_cell
from acquire.plan import load_plan, write_plan
from calibrate import Calibration
from drivers.abb.adapter import AbbRobot
from drivers.abb.line import LineClient
from drivers.abb.protocol import Verb, angle_text
from drivers.abb.settings import parse_settings
from drivers.errors import RobotTimeout
from drivers.files.session import read_session
from drivers.files.yaml import dump_yaml, parse_yaml
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.truth_file import load_truth, write_truth
from drivers.transport import TcpLink
from measure.cli import app
from measure.cli_run import run_app
from tests.support.driven import mark_driven
from tests.system.conftest import Cli, SmallCell

N_CALIBRATION, N_VERIFICATION = 20, 6
ONE_UM = 1e-3


@dataclass(frozen=True, slots=True)
class Served:
    """Where a simulated controller serves."""

    port: int
    state_port: int
    serial_port: str
    bench_port: int


@contextmanager
def served(*options: object) -> Iterator[Served]:
    """`spherecal simulate-controller abb` until the block ends."""
    command = [sys.executable, "-m", "measure.cli", "simulate-controller", "abb", "--host", "127.0.0.1", "--port", "0", "--bench-port", "0"]
    pipe = subprocess.PIPE
    process = subprocess.Popen([*command, "--until-eof", *map(str, options)], stdin=pipe, stdout=pipe, stderr=pipe, text=True)
    assert process.stderr is not None
    try:
        line = process.stderr.readline()
        match = re.search(r"program (\d+), second program (\d+), serial line (\S+), bench (\d+)", line)
        if match is None:
            pytest.fail(f"{line!r} {process.stderr.read()}")
        yield Served(int(match[1]), int(match[2]), match[3], int(match[4]))
    finally:
        _, err = process.communicate(timeout=20)
        assert process.returncode == 0, err


def quantised(joints_rad: FloatArray) -> FloatArray:
    """What the line can carry."""
    return np.radians([float(angle_text(float(angle))) for angle in np.degrees(joints_rad)])


@dataclass(frozen=True, slots=True)
class Work:
    """Cell files for the same truth, and plans that are exact in the line's decimals."""

    folder: Path

    def cell(self, name: str, at: Served, **robot: object) -> Path:
        """The cell with the simulated controller's robot, and a camera that it carries."""
        data = parsed(self.folder / "plain.yaml")
        model = mapping(data["robot"])["model"]
        data["robot"] = {"driver": "abb_socket", "model": model, **robot}
        data["identity"] = {**mapping(data["identity"]), "robot_serial": "SIMULATED-0001"}
        data["camera"] = {**mapping(data["camera"]), "truth": "truth.yaml", "controller": f"127.0.0.1:{at.bench_port}"}
        path = self.folder / f"{name}.yaml"
        path.write_text(dump_yaml(data))
        return path


def parsed(path: Path) -> dict[str, object]:
    """The keys of a YAML file."""
    return mapping(parse_yaml(path.read_text(), file=path))


def mapping(value: object) -> dict[str, object]:
    """The same, known to be a mapping."""
    assert isinstance(value, dict)
    return value


@pytest.fixture(scope="module")
def work(small: SmallCell, tmp_path_factory: pytest.TempPathFactory) -> Work:
    """The small cell without what hangs on the clock: drift and encoder noise."""
    folder = tmp_path_factory.mktemp("abb")
    truth = load_truth(small.folder / "truth.yaml")
    steady = replace(truth.robot, drift_per_hour=(0.0,) * 6, axis_drift_rad_per_hour=(), encoder_noise_rad=0.0)
    write_truth(replace(truth, robot=steady), folder / "truth.yaml")
    data = parsed(small.cell)
    data["motion"] = {"speed_rad_s": 1.0, "settle_s": 0.1, "frames": 1}
    (folder / "plain.yaml").write_text(dump_yaml(data))
    cell = load_cell(folder / "plain.yaml")
    for name, n in (("calibration", N_CALIBRATION), ("verification", N_VERIFICATION)):
        plan = load_plan(small.folder / f"{name}_plan.yaml")
        step = max(len(plan.poses) // n, 1)
        poses = [
            replace(pose, joints_rad=quantised(pose.joints_rad), via_rad=tuple(quantised(via) for via in pose.via_rad)) for pose in plan.poses[::step]
        ]
        write_plan(type(plan)(cell.sha256, plan.purpose, tuple(poses[:n])), folder / f"{name}_plan.yaml")
    return Work(folder)


def run(*arguments: object) -> None:
    """A command that must succeed."""
    assert run_app(app, [str(argument) for argument in arguments]) == 0


def plan_for(work: Work, cell: Path, name: str) -> Path:
    """The plan, made for this cell file."""
    plan = load_plan(work.folder / f"{name}_plan.yaml")
    path = work.folder / f"{cell.stem}_{name}_plan.yaml"
    write_plan(type(plan)(load_cell(cell).sha256, plan.purpose, plan.poses), path)
    mark_driven(cell, path)
    return path


def test_the_whole_way_over_tcp_and_over_the_serial_line_gives_what_the_plain_simulation_gives(work: Work, cli: Cli) -> None:
    plain = work.folder / "plain.yaml"
    with served("--cell", plain, "--speed-up", 60) as at:
        tcp = work.cell("tcp", at, host="127.0.0.1", port=at.port, state_port=at.state_port)
        serial = work.cell("serial", at, serial_port=at.serial_port)
        told = cli("doctor", tcp, "--json").told
        assert told["problems"] == []
        run("capture", tcp, plan_for(work, tcp, "calibration"), "-o", work.folder / "tcp_c", "--yes", "-q")
        run("capture", serial, plan_for(work, serial, "verification"), "-o", work.folder / "serial_v", "--yes", "-q")
    for cell, name, session in ((plain, "calibration", "plain_c"), (plain, "verification", "plain_v")):
        run("capture", cell, plan_for(work, cell, name), "-o", work.folder / session, "--yes", "-q")
    _same_sessions(work.folder / "tcp_c", work.folder / "plain_c", same_scans=True)
    _same_sessions(work.folder / "serial_v", work.folder / "plain_v", same_scans=False)
    for name in ("tcp", "plain"):
        arguments = ["calibrate", work.folder / f"{name}_c", "-o", work.folder / f"{name}_calibration.yaml", "--camera-error", "pillow", "-q"]
        assert run_app(app, list(map(str, arguments))) in {0, 3}  # so few shots do not pass, and need not here
    centres, expected = (Calibration.load(work.folder / f"{name}_calibration.yaml").sphere_centres_in_base_mm for name in ("tcp", "plain"))
    for sphere, centre in expected.items():
        np.testing.assert_allclose(centres[sphere], centre, atol=ONE_UM)
    result = cli("verify", work.folder / "tcp_calibration.yaml", work.folder / "serial_v", "--json")
    assert result.code == 0, result.err
    assert result.told["n_shots"] == N_VERIFICATION


@pytest.mark.qualify
def test_the_whole_way_over_each_line_alone(work: Work, cli: Cli) -> None:
    """Calibration and verification over TCP, and again over the serial line; each run begins with a robot that never moved, as the plain one does."""
    plain = work.folder / "plain.yaml"
    told = {}
    for line in ("alone", "alone_tcp", "alone_serial"):
        for name in ("calibration", "verification"):
            with served("--cell", plain, "--speed-up", 60) as at:
                how: dict[str, object] = {"serial_port": at.serial_port} if line == "alone_serial" else {"host": "127.0.0.1", "port": at.port}
                cell = plain if line == "alone" else work.cell(line, at, **how)
                run("capture", cell, plan_for(work, cell, name), "-o", work.folder / f"{line}_{name}", "--yes", "-q")
            if line != "alone":
                _same_sessions(work.folder / f"{line}_{name}", work.folder / f"alone_{name}", same_scans=True)
        calibration = work.folder / f"{line}.calibration.yaml"
        session = str(work.folder / f"{line}_calibration")
        assert run_app(app, ["calibrate", session, "-o", str(calibration), "--camera-error", "pillow", "-q"]) in {0, 3}
        told[line] = cli("verify", calibration, work.folder / f"{line}_verification", "--json").told
    for line in ("alone_tcp", "alone_serial"):
        assert abs(told[line]["centre_rms_mm"] - told["alone"]["centre_rms_mm"]) < ONE_UM
        found, expected = ([length["error_mm"] for length in told[name]["lengths"]] for name in (line, "alone"))
        np.testing.assert_allclose(found, expected, atol=ONE_UM)


def _same_sessions(found: Path, expected: Path, *, same_scans: bool) -> None:
    """Axis angles within what the line rounds, and the very same scans where the same motions went before."""
    shots, others = read_session(found).shots, read_session(expected).shots
    assert [shot.pose_id for shot in shots] == [shot.pose_id for shot in others]
    for shot, other in zip(shots, others, strict=True):
        assert shot.joints_rad is not None
        assert other.joints_rad is not None
        assert shot.base_from_flange is not None
        np.testing.assert_allclose(shot.joints_rad, other.joints_rad, atol=1e-6)
        np.testing.assert_allclose(shot.base_from_flange[:3, 3], other.base_from_flange[:3, 3], atol=2e-3)  # type: ignore[index]
        if same_scans:
            assert shot.sha256 is not None
            assert shot.sha256 == other.sha256


def test_a_run_that_an_emergency_stop_ended_is_resumed(work: Work, cli: Cli) -> None:
    from drivers.simulated.controllers.bench import BenchClient

    with served("--cell", work.folder / "plain.yaml", "--speed-up", 60) as at:
        cell = work.cell("held", at, host="127.0.0.1", port=at.port, state_port=at.state_port)
        plan = plan_for(work, cell, "verification")
        bench = BenchClient("127.0.0.1", at.bench_port)
        bench.ask("fault emergency_stop")
        result = cli("capture", cell, plan, "-o", work.folder / "held_s", "--yes", "--json")
        assert result.code == 1
        assert result.told["error"]["type"] == "EmergencyStop"
        assert not (work.folder / "held_s").exists()
        assert cli("doctor", cell, "--json").told["problems"]
        bench.ask("clear")
        result = cli("capture", cell, plan, "-o", work.folder / "held_s", "--yes", "--json")
        assert result.code == 0, result.err
        assert json.loads(result.out)["n_shots"] == N_VERIFICATION


def test_a_program_of_the_robots_own_asks_for_pictures(work: Work) -> None:
    """`serve-cell` in a process of its own; the test is the robot's program: it moves, triggers, and asks later."""
    with served("--cell", work.folder / "plain.yaml", "--speed-up", 60) as at:
        cell = work.cell("master", at, host="127.0.0.1", port=at.port)
        plan = load_plan(plan_for(work, cell, "verification"))
        command = [sys.executable, "-m", "measure.cli", "serve-cell", str(cell), "-o", str(work.folder / "master_s")]
        command += ["--port", "0", "--count", "3", "--json"]
        pipe = subprocess.PIPE
        process = subprocess.Popen([*command, "--plan", str(plan_for(work, cell, "verification"))], stdout=pipe, stderr=pipe, text=True)
        assert process.stderr is not None
        match = re.search(r"at 127\.0\.0\.1:(\d+)", process.stderr.readline())
        assert match is not None
        robot = devices_of(load_cell(cell)).robot
        robot.open()
        client = LineClient(TcpLink("127.0.0.1", int(match[1])))
        client.open(1.0)
        for i in (1, 2, 3):
            robot.start_move(plan.poses[i - 1].joints_rad, speed_rad_s=1.0)
            while (state := robot.read_state()).moving:
                robot.wait(0.02)
            assert state.joints_rad is not None
            client.ask(Verb.TRIGGER, str(i), *(angle_text(float(angle)) for angle in np.degrees(state.joints_rad)), timeout_s=1.0)
            told = "EXPOSING"
            while told in ("EXPOSING", "EXPOSED") and (i < 3 or told == "EXPOSING"):
                told = client.ask(Verb.RESULT, str(i), timeout_s=1.0).line.arguments[1]
                time.sleep(0.02)
            assert told != "NG"
        client.close()
        robot.close()
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert json.loads(out)["n_shots"] == 3
    shots = read_session(work.folder / "master_s").shots
    assert [shot.pose_id for shot in shots] == [pose.id for pose in plan.poses[:3]]
    assert all(shot.status == "ok" and shot.sphere is not None for shot in shots)


def test_a_fault_from_the_start_and_one_that_is_not_known(tmp_path: Path, cli: Cli) -> None:
    with served("--fault", "silence") as at:
        robot = AbbRobot(parse_settings({"host": "127.0.0.1", "port": at.port}), None)
        with pytest.raises(RobotTimeout):
            robot.open()
    result = cli("simulate-controller", "abb", "--host", "127.0.0.1", "--port", "0", "--bench-port", "0", "--fault", "nonsense", "--json")
    assert result.code == 1
    assert "black_hole" in result.told["error"]["message"]
    told = cli("abb-program", "--out", tmp_path / "rapid", "--json").told
    assert "spherecal.mod" in told["files"]
    assert cli("abb-program", "--out", tmp_path / "rapid", "--json").code == 1
