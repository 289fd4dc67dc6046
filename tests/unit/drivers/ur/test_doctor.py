"""`spherecal doctor` on a UR: what it reads, what it finds wrong, and what it says to do."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from drivers.files.yaml import dump_yaml
from drivers.kinematics import mdh
from drivers.models import load_robot_model
from drivers.protocols import RobotState
from drivers.simulated.truth import CameraTruth, Truth
from drivers.simulated.truth_file import write_truth
from measure.cli import app
from measure.cli_run import run_app
from measure.doctor import robot_problems
from tests.support.fake_ur import FakeUr, own_address
from tests.unit.drivers.ur.conftest import HOME


def cell(folder: Path, host: str, model: str = "ur5e", **settings: object) -> Path:
    path = folder / "cell.yaml"
    data = {
        "format": "spherecal-cell/1",
        "name": "ur",
        "robot": {"driver": "ur_rtde", "model": model, "host": host, **settings},
        "camera": {"driver": "simulated", "truth": "none.yaml"},
        "flange_from_camera": None,
        "spheres": {"A": {"diameter_mm": 38.1, "expanded_uncertainty_mm": 0.001}},
    }
    path.write_text(dump_yaml(data), encoding="utf-8")
    return path


def told(path: Path, capfd: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """The robot's half of what the doctor says; the cell has no camera."""
    capfd.readouterr()
    run_app(app, ["doctor", str(path), "--json"])
    found: dict[str, Any] = json.loads(capfd.readouterr().out)
    problems = [text.removeprefix("robot: ") for text in found["problems"] if text.startswith("robot: ")]
    return {**found["robot"], "problems": problems, "hints": found["hints"]}


@pytest.fixture
def camera(tmp_path: Path) -> None:
    """A truth for the camera, so that only the robot can be wrong."""
    write_truth(Truth(camera=CameraTruth(resolution_px=(32, 20))), tmp_path / "none.yaml")


@pytest.mark.usefixtures("camera")
class TestDoctor:
    def test_a_healthy_robot(self, controller: FakeUr, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
        count = controller.n_motions()
        robot = told(cell(tmp_path, controller.host), capfd)
        assert robot["ok"] is True
        assert len(robot["joints_rad"]) == 6
        assert (robot["mode"], robot["safety"], robot["active_tool"]) == ("automatic", "normal", "tool0")
        assert robot["serial"].isdigit()
        assert "PolyScope 5" in robot["controller"]
        assert 0 <= robot["age_s"] < 0.05
        assert any("own calibration" in hint for hint in robot["hints"])
        assert any("ur_rtde has never run on hardware" in hint for hint in robot["hints"])
        assert controller.n_motions() == count
        assert controller.bench.ask("axes")  # still there

    def test_it_is_unreachable(self, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
        robot = told(cell(tmp_path, own_address(8)), capfd)
        assert robot["ok"] is False
        assert "connection refused" in robot["problems"][0]
        assert "RTDE enabled" in robot["problems"][0]

    def test_it_is_another_model(self, controller: FakeUr, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
        robot = told(cell(tmp_path, controller.host, "ur10e"), capfd)
        assert robot["ok"] is False
        assert "model: ur5e" in robot["problems"][0]

    def test_it_cannot_move_now(self, controller: FakeUr, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
        controller.fault("emergency_stop")
        controller.fault("local")
        robot = told(cell(tmp_path, controller.host), capfd)
        assert robot["ok"] is False
        assert "emergency stop is active (safety mode ROBOT_EMERGENCY_STOP" in robot["problems"][0]
        assert any("motors are off" in hint for hint in robot["hints"])
        assert any("local mode" in hint for hint in robot["hints"])

    def test_a_program_of_somebody_else_runs(self, controller: FakeUr, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
        controller.fault("foreign_program")
        robot = told(cell(tmp_path, controller.host), capfd)
        assert any("program 'production.urp' runs" in hint for hint in robot["hints"])

    def test_it_answers_too_slowly(self, controller: FakeUr, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
        controller.fault("lag 0.2")
        robot = told(cell(tmp_path, controller.host), capfd)
        assert robot["ok"] is False
        assert "too slowly" in robot["problems"][0]
        assert "cable of its own" in robot["problems"][0]

    @pytest.mark.parametrize(
        "settings",
        [
            {"hots": "1.2.3.4"},
            {"host": ""},
            {"host": 5},
            {"host": None},
            {"frequency_hz": 1000},
            {"acceleration_rad_s2": 0},
            {"upper_registers": "yes"},
        ],
    )
    def test_its_settings_are_wrong(self, settings: dict[str, object], tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
        path = cell(tmp_path, "127.0.0.1", **settings) if "host" not in settings else cell(tmp_path, settings["host"])  # type: ignore[arg-type]
        capfd.readouterr()
        assert run_app(app, ["doctor", str(path), "--offline", "--json"]) == 3
        problems = json.loads(capfd.readouterr().out)["problems"]
        assert any("ur_rtde" in text or "robot." in text for text in problems)


def test_metres_are_named() -> None:
    model, joints = load_robot_model("ur5e"), HOME
    pose = mdh.base_from_flange(model, joints)
    assert robot_problems(RobotState(joints, pose, 0.0, moving=False), model) == []
    pose[:3, 3] /= 1000
    (problem,) = robot_problems(RobotState(joints, pose, 0.0, moving=False), model)
    assert "metres" in problem
