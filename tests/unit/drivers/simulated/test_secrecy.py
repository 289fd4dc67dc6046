"""No solver can read the truth: not by import, not in a session, not by opening its file, not from a device."""

from __future__ import annotations

import json
import re
import struct
import subprocess
import sys
import tomllib
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import devices_of, load_cell
from acquire.session import SessionWriter
from drivers.files.yaml import dump_yaml
from drivers.kinematics import mdh, se3
from drivers.protocols import CameraInfo, RobotInfo
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.draws import PAPER_FLANGE_FROM_CAMERA, random_truth
from drivers.simulated.robot import SimulatedRobot
from drivers.simulated.truth import SphereTruth, Truth
from drivers.simulated.truth_file import write_truth
from tests.support.simulated import CENTRE_IN_CAMERA_MM, JOINTS_RAD, in_base, paper_model
from tests.support.source import modules_of

ROOT = Path(__file__).parents[4]
N_SHOTS = 16
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")


def secret_truth() -> Truth:
    """Errors of every kind, every number drawn, so that none is in a cell file by chance."""
    rng = np.random.default_rng(11)
    x, y, z = (value + rng.normal() for value in in_base(CENTRE_IN_CAMERA_MM))
    truth = random_truth(paper_model(), rng, spheres={"A": SphereTruth((x, y, z), 38.1 + 1e-3 * rng.normal())})
    return replace(truth, camera=replace(truth.camera, resolution_px=(320, 200)))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Truth]:
    """A folder with cell, truth and a session recorded through the cell's devices."""
    folder = tmp_path_factory.mktemp("secret")
    truth = secret_truth()
    write_truth(truth, folder / "truth.yaml")
    cell_data = {
        "format": "spherecal-cell/1",
        "name": "secret",
        "robot": {"driver": "simulated", "model": "irb1410_paper", "truth": "truth.yaml"},
        "camera": {"driver": "simulated"},
        "flange_from_camera": [list(row) for row in PAPER_FLANGE_FROM_CAMERA],
        "spheres": {"A": {"diameter_mm": 38.1, "expanded_uncertainty_mm": 0.001}},
    }
    (folder / "cell.yaml").write_text(dump_yaml(cell_data), encoding="utf-8")
    cell = load_cell(folder / "cell.yaml")
    with devices_of(cell) as devices, SessionWriter.create(folder / "session", purpose="calibration", cell=cell) as writer:
        rng = np.random.default_rng(12)
        for _ in range(N_SHOTS):
            # the sphere stays in view and moves about in it, as a solve needs it
            devices.robot.start_move(JOINTS_RAD + rng.uniform(-1, 1, 6) * [0.06, 0.05, 0.05, 0.2, 0.1, 0.6], speed_rad_s=0.5)
            devices.robot.wait(30.0)
            state, frame = devices.robot.read_state(), devices.camera.capture(timeout_s=5.0)
            writer.append(sphere="A", joints_rad=state.joints_rad, base_from_flange=state.base_from_flange, xyz_mm=frame.xyz_mm)
    return folder, truth


def secrets(truth: Truth) -> set[float]:
    """Every number of the truth that needs more than five digits: nobody else can have it by chance."""

    def numbers(value: object) -> list[float]:
        if isinstance(value, dict):
            return [n for item in value.values() for n in numbers(item)]
        if isinstance(value, tuple | list):
            return [n for item in value for n in numbers(item)]
        return [float(value)] if isinstance(value, int | float) and not isinstance(value, bool) else []

    public = {38.1, *np.ravel(PAPER_FLANGE_FROM_CAMERA)}
    return {n for n in numbers(asdict(truth)) if float(f"{n:.5g}") != n and n not in public}


def test_a_session_holds_no_number_of_the_truth(recorded: tuple[Path, Truth]) -> None:
    folder, truth = recorded
    hidden = np.array(sorted(secrets(truth)))
    assert len(hidden) > 40
    files = [path for path in (folder / "session").rglob("*") if path.is_file()]
    texts = [path for path in files if path.suffix != ".ply"]
    assert len(files) - len(texts) == N_SHOTS
    assert not [path for path in files if "truth" in path.name]
    for path in texts:
        found = np.array([float(text) for text in NUMBER.findall(path.read_text(encoding="utf-8"))])
        near = np.abs(found[:, None] - hidden) <= 1e-9 * np.abs(hidden)
        assert not near.any(), f"{path.name} holds {hidden[near.any(axis=0)]}"
    for path in set(files) - set(texts):
        data = path.read_bytes()
        assert not [n for n in hidden if struct.pack("<d", n) in data]


def test_the_search_would_find_a_number_of_the_truth(recorded: tuple[Path, Truth]) -> None:
    folder, truth = recorded
    leaked = {float(text) for text in NUMBER.findall((folder / "truth.yaml").read_text(encoding="utf-8"))}
    assert secrets(truth) <= leaked


def test_what_a_session_says_of_the_robot_is_the_nominal_model(recorded: tuple[Path, Truth]) -> None:
    folder, _ = recorded
    for line in (folder / "session" / "shots.jsonl").read_text(encoding="utf-8").splitlines():
        shot = json.loads(line)
        nominal = mdh.base_from_flange(paper_model(), shot["joints_rad"])
        np.testing.assert_allclose(shot["base_from_flange"], nominal, atol=1e-9)


READER = """
import json, sys
opened = []
sys.addaudithook(lambda event, args: opened.append(str(args[0])) if event == "open" else None)
from calibrate.solve import CalibrationSettings, calibrate
from drivers.files.session import read_session
found = calibrate([read_session(sys.argv[1])], CalibrationSettings(camera_error="pillow"))
found.save(sys.argv[2])
print(json.dumps({"used": found.statistics.used, "opened": opened, "modules": sorted(sys.modules)}))
"""


def test_a_calibration_never_touches_the_truth(recorded: tuple[Path, Truth], tmp_path: Path) -> None:
    """Every file that is opened on the way is heard, by whatever call: the truth lies one folder up, within reach."""
    folder, truth = recorded
    command = [sys.executable, "-c", READER, str(folder / "session"), str(tmp_path / "calibration.yaml")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300, cwd=folder)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["used"] >= N_SHOTS - 3
    assert any(name.endswith("shots.jsonl") for name in report["opened"])
    assert not [name for name in report["opened"] if "truth" in Path(name).name]
    assert not [name for name in report["modules"] if name.startswith("drivers.simulated")]
    told = np.array([float(number) for number in NUMBER.findall((tmp_path / "calibration.yaml").read_text(encoding="utf-8"))])
    assert not [n for n in secrets(truth) if (np.abs(told - n) <= 1e-9 * abs(n)).any()]


def test_import_linter_forbids_the_simulator_to_acquire_and_calibrate() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = [c for c in settings["tool"]["importlinter"]["contracts"] if "drivers.simulated" in c.get("forbidden_modules", ())]
    assert {"acquire", "calibrate"} <= set(contracts[0]["source_modules"])


def test_nothing_of_acquire_or_calibrate_loads_the_simulator() -> None:
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for top in ("acquire", "calibrate") for path in modules_of(top)]
    code = f"import importlib, sys\nfor name in {names!r}: importlib.import_module(name.removesuffix('.__init__'))\n"
    code += "sys.exit(any(name.startswith('drivers.simulated') for name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr


def test_devices_show_nothing_but_their_protocols() -> None:
    truth = secret_truth()
    cell = SimulatedCell(truth, paper_model())
    robot, camera = SimulatedRobot(cell), SimulatedCamera(cell)
    shown = {name for device in (robot, camera) for name in dir(device) if not name.startswith("_")}
    assert shown == {"open", "read_state", "start_move", "stop", "wait", "close", "capture"}
    told = repr((robot.open(), camera.open()))
    assert isinstance(robot.open(), RobotInfo)
    assert isinstance(camera.open(), CameraInfo)
    assert not [n for n in secrets(truth) if repr(n) in told]


def test_the_true_hand_eye_is_not_the_first_guess() -> None:
    difference = se3.log(se3.inverse(PAPER_FLANGE_FROM_CAMERA) @ np.array(secret_truth().camera.flange_from_camera))
    assert np.linalg.norm(difference[:3]) > 0.3
    assert np.linalg.norm(difference[3:]) > 1e-3
