"""Drivers are found by name, built-in ones lazily, others by entry points."""

from __future__ import annotations

import re
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from drivers import registry
from drivers.errors import SettingsError
from drivers.protocols import Camera3D, Devices, Robot
from drivers.recorded import make_camera, make_robot
from drivers.registry import CAMERA_GROUP, HARDWARE_LOGS, ROBOT_GROUP, DriverContext, driver_names, hardware_remark, make_devices, untried_drivers
from tests.support.sessions import write_session
from tests.support.source import ROOT


def _make(folder: Path, robot: str = "recorded", camera: str = "recorded") -> Devices:
    settings = {"session": "s"}
    return make_devices(robot_driver=robot, robot_settings=settings, camera_driver=camera, camera_settings=settings, robot_model=None, folder=folder)


def _third_party(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    def found(*, group: str) -> list[EntryPoint]:
        return [EntryPoint("mine", value, group), EntryPoint("recorded", "no:where", group)]

    monkeypatch.setattr(registry, "entry_points", found)


def test_made_devices_satisfy_the_protocols_and_are_not_opened(tmp_path: Path) -> None:
    devices = _make(tmp_path)  # the session does not exist yet
    assert isinstance(devices.robot, Robot)
    assert isinstance(devices.camera, Camera3D)


@pytest.mark.parametrize(("robot", "camera", "where"), [("kuka", "recorded", "robot.driver"), ("recorded", "kinect", "camera.driver")])
def test_an_unknown_driver_is_told_with_the_choices(robot: str, camera: str, where: str, tmp_path: Path) -> None:
    with pytest.raises(SettingsError) as caught:
        _make(tmp_path, robot, camera)
    assert caught.value.where == where
    assert caught.value.remedy is not None
    assert "simulated, recorded" in caught.value.remedy


def test_third_parties_come_by_entry_points_and_cannot_replace_built_in_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _third_party(monkeypatch, "drivers.recorded:make_robot")
    names = driver_names(ROBOT_GROUP)
    assert names.count("recorded") == 1
    assert names[-1] == "mine"
    assert driver_names(CAMERA_GROUP)[-1] == "mine"
    write_session(tmp_path / "s")
    with _make(tmp_path, robot="mine") as devices:
        assert devices.robot.read_state().joints_rad is not None


@pytest.mark.parametrize("value", ["no_such_module:make", "drivers.recorded:no_such_function"])
def test_a_driver_that_cannot_be_loaded_is_told(value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _third_party(monkeypatch, value)
    with pytest.raises(SettingsError, match="cannot be loaded"):
        _make(tmp_path, robot="mine")


def test_a_driver_counts_as_run_on_hardware_only_with_a_signed_log() -> None:
    """Every one that drives anything, until its page under docs/ bears a date, a name and a signature."""
    built_in = {*registry._BUILT_IN[ROBOT_GROUP], *registry._BUILT_IN[CAMERA_GROUP]}
    assert set(untried_drivers(*built_in)) == built_in - {"simulated", "recorded"} - set(HARDWARE_LOGS)
    for driver, page in HARDWARE_LOGS.items():
        assert driver in built_in
        assert re.search(r"Signed: .+, \d{4}-\d{2}-\d{2}", (ROOT / "docs" / page).read_text(encoding="utf-8"))
    assert "never run on hardware" in hardware_remark("abb_socket")
    assert "none of spherecal's own" in hardware_remark("my_arm")
    assert untried_drivers("simulated", "my_arm") == ("my_arm",)


def test_robot_and_camera_of_a_cell_share_what_they_need(tmp_path: Path) -> None:
    shared: dict[str, object] = {}
    context = DriverContext({"session": "s"}, None, tmp_path, shared)
    robot, camera = make_robot(context), make_camera(context)
    assert robot._recording is camera._recording
    assert make_robot(DriverContext({"session": "s"}, None, tmp_path))._recording is not robot._recording
