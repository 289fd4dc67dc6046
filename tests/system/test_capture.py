"""The run as an operator drives it: asked before it moves, stopped by Ctrl-C, resumed, stepped through."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from acquire.cell import load_cell
from acquire.events import Finish, PoseStarted
from acquire.plan import Plan, PlannedPose, load_plan, write_plan
from drivers.files.session import read_session
from drivers.files.yaml import dump_yaml, parse_yaml
from measure.running import capture_session
from measure.running_record import RunRecord, read_runs
from measure.running_solve import Question, solve_so_far
from tests.support.driven import mark_driven
from tests.system.conftest import Cli, SmallCell

N_POSES = 4


def real_time_cell(small: SmallCell, folder: Path, speed_rad_s: float, settle_s: float = 0.1) -> tuple[Path, Path]:
    """A copy of the small cell that takes the time a robot takes, and a short plan for it."""
    text = small.cell.read_text()
    truth = f"truth: {small.folder / 'truth.yaml'}"
    text = text.replace("truth: truth.yaml", f"{truth}, instant: false")
    text = text.replace("speed_rad_s: 0.5, settle_s: 0.5", f"speed_rad_s: {speed_rad_s}, settle_s: {settle_s}")
    cell = folder / "cell.yaml"
    cell.write_text(text)
    plan = load_plan(small.folder / "calibration_plan.yaml")
    short = type(plan)(load_cell(cell).sha256, plan.purpose, plan.poses[:N_POSES])
    write_plan(short, folder / "plan.yaml")
    mark_driven(cell, folder / "plan.yaml")
    return cell, folder / "plan.yaml"


def started(arguments: Sequence[object], **streams: int) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "measure.cli", "capture", *(str(argument) for argument in arguments)]
    given = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | streams
    return subprocess.Popen(command, text=True, **given)  # type: ignore[call-overload,no-any-return]


def test_a_dry_run_lists_the_poses_and_touches_nothing(small: SmallCell, tmp_path: Path, cli: Cli) -> None:
    result = cli("capture", small.cell, small.folder / "workpiece_plan.yaml", "-o", tmp_path / "s", "--dry-run")
    assert result.code == 0
    assert "nothing was moved" in result.out
    assert max(len(line) for line in result.out.splitlines()) <= 80
    told = cli("capture", small.cell, small.folder / "workpiece_plan.yaml", "-o", tmp_path / "s", "--dry-run", "--json").told
    assert (told["n_shots"], told["state"]) == (0, "dry_run")
    assert list(tmp_path.iterdir()) == []


def test_a_session_is_not_overwritten(small: SmallCell, cli: Cli) -> None:
    before = read_session(small.workpiece_session).digest
    result = cli("capture", small.cell, small.folder / "workpiece_plan.yaml", "-o", small.workpiece_session, "--yes", "--json")
    assert result.code == 1
    assert "--resume" in result.told["error"]["remedy"]
    assert read_session(small.workpiece_session).digest == before


def test_resuming_a_complete_session_adds_nothing(small: SmallCell, cli: Cli) -> None:
    before = read_session(small.workpiece_session).digest
    told = cli("capture", small.cell, small.folder / "workpiece_plan.yaml", "-o", small.workpiece_session, "--resume", "--json").told
    assert told["state"] == "complete"
    assert read_session(small.workpiece_session).digest == before


def test_a_moving_robot_needs_somebody_who_says_so(small: SmallCell, tmp_path: Path) -> None:
    cell, plan = real_time_cell(small, tmp_path, 1.0)
    for option in ([], ["--step"]):
        process = started([cell, plan, "-o", tmp_path / "s", *option])
        _, err = process.communicate(timeout=60)
        assert process.returncode == 1
        assert err.count("\n") == 1
        assert "--yes" in err
        assert not (tmp_path / "s").exists()


@pytest.mark.parametrize(("typed", "code"), [("yes\n", 1), pytest.param("move\n", 0, marks=pytest.mark.qualify)])
def test_the_motion_is_confirmed_by_a_typed_word(typed: str, code: int, small: SmallCell, tmp_path: Path) -> None:
    cell, plan = real_time_cell(small, tmp_path, 8.0, 0.05)
    ours, theirs = pty.openpty()
    process = started([cell, plan, "-o", tmp_path / "s"], stdin=theirs, stderr=theirs)
    os.close(theirs)
    shown = read_until(ours, b"to start:")
    os.write(ours, typed.encode())
    shown += read_until(ours, None)
    process.communicate(timeout=60)
    os.close(ours)
    assert b"4 poses at up to 8 rad/s" in shown
    assert process.returncode == code, shown
    if code == 0:
        assert b"points" in shown  # the live table
        assert len(read_session(tmp_path / "s").shots) == N_POSES
    else:
        assert not (tmp_path / "s").exists()


@pytest.mark.qualify  # the keys are tested in the unit tests, an attended first run at a terminal below
def test_step_by_step_a_pose_is_taken_skipped_or_the_end(small: SmallCell, tmp_path: Path) -> None:
    cell, plan = real_time_cell(small, tmp_path, 8.0, 0.05)
    ours, theirs = pty.openpty()
    process = started([cell, plan, "-o", tmp_path / "s", "--step", "--json"], stdin=theirs, stderr=theirs)
    os.close(theirs)
    for answer in (b"\n", b"s", b"\n", b"q"):
        read_until(ours, b"q ends the run:")
        os.write(ours, answer)
    read_until(ours, None)
    out, _ = process.communicate(timeout=60)
    os.close(ours)
    told = json.loads(out)
    assert (told["n_shots"], told["n_skipped"], told["state"]) == (2, 1, "stopped")
    assert process.returncode == 0


@pytest.mark.qualify
def test_ctrl_c_ends_after_the_shot_and_the_run_can_be_resumed(small: SmallCell, tmp_path: Path) -> None:
    cell, plan = real_time_cell(small, tmp_path, 6.0, 0.05)
    process = started([cell, plan, "-o", tmp_path / "s", "--yes", "--json"])
    if process.stderr is None:
        pytest.fail("no pipe")
    process.stderr.readline()  # the first shot's line
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    told = json.loads(out)
    assert told["state"] == "stopped"
    assert 1 <= told["n_shots"] < N_POSES
    assert "--resume" in err
    process = started([cell, plan, "-o", tmp_path / "s", "--yes", "--json", "--resume"])
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert json.loads(out)["n_shots"] == N_POSES
    assert [shot.index for shot in read_session(tmp_path / "s").shots] == list(range(N_POSES))


@pytest.mark.parametrize("signals", [(signal.SIGINT, signal.SIGINT), (signal.SIGTERM,)])
def test_ctrl_c_twice_or_a_termination_stops_now_and_leaves_no_empty_session(signals: Sequence[int], small: SmallCell, tmp_path: Path) -> None:
    cell, plan = real_time_cell(small, tmp_path, 0.02)  # a minute to the first pose
    process = started([cell, plan, "-o", tmp_path / "s", "--yes", "--json"])
    deadline = time.monotonic() + 30
    while not (tmp_path / "s" / "shots.jsonl").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.3)
    for number in signals:
        process.send_signal(number)
        time.sleep(0.3)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 130, err
    assert json.loads(out)["error"]["type"] == "Interrupted"
    assert err.splitlines()[-1] == "interrupted"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cell.runs.jsonl", "cell.yaml", "plan.yaml"]


def test_a_cell_without_its_truth_leaves_no_session(small: SmallCell, tmp_path: Path, cli: Cli) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_bytes(small.cell.read_bytes())
    result = cli("capture", cell, small.folder / "workpiece_plan.yaml", "-o", tmp_path / "s", "--yes", "--json")
    assert result.code == 1
    assert "truth.yaml" in result.told["error"]["file"]
    assert list(tmp_path.iterdir()) == [cell]


def near_home(small: SmallCell, folder: Path) -> tuple[Path, Path, list[str]]:
    """A real-time cell, its robot at a pose that sees a sphere, and a plan of three poses close by, never driven."""
    cell, plan = real_time_cell(small, folder, 8.0, 0.05)
    home = load_plan(plan).poses[0].joints_rad
    truth = parse_yaml((small.folder / "truth.yaml").read_text(), file="truth.yaml")
    if not isinstance(truth, dict):
        pytest.fail("no truth")
    truth["robot"]["home_rad"] = home.tolist()
    (folder / "truth.yaml").write_text(dump_yaml(truth))
    cell.write_text(cell.read_text().replace(str(small.folder / "truth.yaml"), "truth.yaml"))
    # on the way that the plan comes by, which is clear
    poses = tuple(PlannedPose(f"h{i}", None, home - 0.006 * (i + 1)) for i in range(3))
    write_plan(Plan(load_cell(cell).sha256, "workpiece", poses), plan)
    return cell, plan, [pose.id for pose in poses]


def runs_of(cell: Path) -> list[RunRecord]:
    return list(read_runs(cell.with_suffix(".runs.jsonl")))


def answered(arguments: Sequence[object], answers: Sequence[bytes]) -> tuple[int, dict[str, Any], bytes]:
    """A run at a terminal with one answer per question; exit code, the JSON object, and what was shown."""
    ours, theirs = pty.openpty()
    process = started([*arguments, "--json"], stdin=theirs, stderr=theirs)
    os.close(theirs)
    shown = b""
    for answer in answers:
        shown += read_until(ours, b"q ends the run:")
        os.write(ours, answer)
    shown += read_until(ours, None)
    out, _ = process.communicate(timeout=60)
    os.close(ours)
    return process.returncode, json.loads(out), shown


def test_the_first_run_of_a_plan_is_attended_slow_and_recorded(small: SmallCell, tmp_path: Path) -> None:
    cell, plan, names = near_home(small, tmp_path)
    before = runs_of(cell)
    process = started([cell, plan, "-o", tmp_path / "s", "--yes"])
    _, err = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "3 of the plan's 3 poses were never driven" in err
    assert not (tmp_path / "s").exists()
    # one pose is left out: it has still to be shown
    code, told, shown = answered([cell, plan, "-o", tmp_path / "s"], [b"\n", b"s", b"\n"])
    assert (code, told["n_skipped"], told["state"]) == (0, 1, "complete")
    assert b"step by step at 0.1 rad/s" in shown
    assert b"NO safety function" in shown
    (first,) = runs_of(cell)[len(before) :]
    assert (first.driven, first.stepped, first.speed_rad_s, first.state) == ((names[0], names[2]), True, 0.1, "done")
    # Redo at the third pose takes the second again
    code, told, shown = answered([cell, plan, "-o", tmp_path / "t"], [b"\n", b"\n", b"r", b"\n", b"\n"])
    assert (code, told["n_shots"]) == (0, 3)
    process = started([cell, plan, "-o", tmp_path / "u", "--yes", "--json"])
    out, err = process.communicate(timeout=60)
    assert json.loads(out)["n_shots"] == 3, err
    assert not runs_of(cell)[-1].stepped


@pytest.mark.qualify  # without a terminal above; the pause itself in the unit tests
def test_ctrl_c_at_a_terminal_pauses_and_the_same_process_goes_on(small: SmallCell, tmp_path: Path) -> None:
    cell, plan = real_time_cell(small, tmp_path, 6.0, 0.05)
    ours, theirs = pty.openpty()
    process = started([cell, plan, "-o", tmp_path / "s", "--yes", "--json"], stdin=theirs, stderr=theirs)
    os.close(theirs)
    shown = read_until(ours, b"predicted place")
    process.send_signal(signal.SIGINT)
    shown += read_until(ours, b"q ends the run:")
    assert b"pauses after this shot" in shown
    os.write(ours, b"r")
    read_until(ours, None)
    out, _ = process.communicate(timeout=60)
    os.close(ours)
    assert process.returncode == 0
    assert json.loads(out)["n_shots"] == N_POSES
    assert sum(shot.replaces is not None for shot in read_session(tmp_path / "s").all_shots) == 1


@pytest.mark.qualify
def test_a_run_goes_beyond_its_plan_until_enough_is_known(small: SmallCell, tmp_path: Path, cli: Cli) -> None:
    plan = load_plan(small.folder / "calibration_plan.yaml")
    write_plan(type(plan)(plan.cell_sha256, plan.purpose, plan.poses[:20]), tmp_path / "plan.yaml")
    options = ("--yes", "--json", "--until-length-u", 0.001, "--extend", 1)
    result = cli("capture", small.cell, tmp_path / "plan.yaml", "-o", tmp_path / "s", *options)
    assert (result.code, result.told["n_shots"], result.told["state"]) == (0, 21, "complete")
    session = read_session(tmp_path / "s")
    assert str(session.shots[-1].pose_id).startswith("extra")
    solved = solve_so_far(Question(tmp_path / "s", plan.poses))
    assert solved.trouble is None
    assert solved.best in {pose.id for pose in plan.poses[20:]}
    assert solved.length_u_mm is not None
    # what a later calibration of the same shots with more of them is predicted to be is better
    more = solve_so_far(Question(small.calibration_session, ()))
    assert more.length_u_mm is not None
    assert more.length_u_mm < solved.length_u_mm
    # when it is enough the pose in hand is finished, and the run is done
    cell = load_cell(small.cell)
    enough = capture_session(cell, plan, tmp_path / "u", watcher=lambda event: Finish() if isinstance(event, PoseStarted) else None)
    assert (enough.state, enough.n_shots) == ("enough", 1)
    assert cli("capture", small.cell, tmp_path / "plan.yaml", "-o", tmp_path / "t", "--yes", "--extend", 1).code == 1


def read_until(descriptor: int, words: bytes | None) -> bytes:
    """What a terminal shows until some words come, or to the end."""
    shown = b""
    while words is None or words not in shown:
        try:
            part = os.read(descriptor, 4096)
        except OSError:  # the other side has closed its terminal
            return shown
        if not part:
            return shown
        shown += part
    return shown
