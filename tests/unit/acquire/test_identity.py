"""Identity: what both sides tell must agree, what one side does not tell is no difference, and every refusal names a remedy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.cell import Cell, load_cell
from acquire.identity import BOUND, check_one_system, differences, identity_marks, identity_of_new_session, reopen_camera, reopen_robot
from acquire.session import SessionWriter
from drivers.errors import CameraMisconfigured, DataError, SettingsError, WrongController
from drivers.files.session import Session, read_session
from drivers.protocols import CameraInfo, Devices, RobotInfo
from tests.support.fake_devices import FakeCamera, FakeRobot

CELL = """\
format: spherecal-cell/1
name: identity
robot: {driver: recorded, model: ur5e}
camera: {driver: recorded}
flange_from_camera: null
spheres: {}
"""
TOLD = {"robot_serial": "r1", "camera_serial": "c1", "camera_settings": "abc", "camera_correction": "2026-11-01"}

identities = st.dictionaries(st.sampled_from([*BOUND, "operator"]), st.one_of(st.none(), st.sampled_from(["1", "2"]), st.integers(1, 2)))


def cell_of(folder: Path, more: str = "") -> Cell:
    folder.mkdir(exist_ok=True)
    (folder / "cell.yaml").write_text(CELL + more, encoding="utf-8")
    return load_cell(folder / "cell.yaml")


def session_of(folder: Path, cell: Cell, identity: Mapping[str, object] | None) -> Session:
    SessionWriter.create(folder, purpose="workpiece", cell=cell, identity=identity).close()
    return read_session(folder)


@given(identities, identities)
def test_only_what_both_tell_can_differ_and_either_side_finds_it(first: dict[str, object], second: dict[str, object]) -> None:
    found = {difference.key for difference in differences(first, second)}
    assert found == {difference.key for difference in differences(second, first)}
    assert found == {key for key in first if None not in (first[key], second.get(key)) and str(first[key]) != str(second[key])}
    assert not differences(first, first)
    assert not differences(first, {})


def test_a_new_session_carries_the_cell_and_the_devices(tmp_path: Path) -> None:
    cell = cell_of(tmp_path, "identity: {camera_serial: c1, payload_kg: 3.5}\n")
    assert identity_of_new_session(cell, TOLD) == {**TOLD, "payload_kg": 3.5}
    assert identity_of_new_session(cell, {}) == {"camera_serial": "c1", "payload_kg": 3.5}
    with pytest.raises(SettingsError, match=r"camera's serial number is c2, the cell file says c1") as caught:
        identity_of_new_session(cell, {"camera_serial": "c2"})
    assert caught.value.remedy


@pytest.mark.parametrize("key", TOLD)
def test_a_session_is_not_resumed_with_another_device(tmp_path: Path, key: str) -> None:
    cell = cell_of(tmp_path)
    folder = session_of(tmp_path / "s", cell, TOLD).folder
    SessionWriter.resume(folder, cell=cell, told=TOLD).close()
    SessionWriter.resume(folder, cell=cell).close()
    with pytest.raises(SettingsError, match=r"is other, the session was begun with") as caught:
        SessionWriter.resume(folder, cell=cell, told={**TOLD, key: "other"})
    assert caught.value.where == f"identity.{key}"
    assert caught.value.remedy
    SessionWriter.resume(session_of(tmp_path / "old", cell, None).folder, cell=cell, told=TOLD).close()  # of an older version, or imported


@pytest.mark.parametrize("key", TOLD)
def test_a_calibration_measures_its_own_system(tmp_path: Path, key: str) -> None:
    session = session_of(tmp_path / "s", cell_of(tmp_path), TOLD)
    for known in (TOLD, {}, {"payload_kg": 3}):
        assert identity_marks(known, session) == ()
    with pytest.raises(DataError, match=r"the calibration is of other") as caught:
        identity_marks({**TOLD, key: "other"}, session)
    assert f"identity_mismatch: {{{key}: mark}}" in str(caught.value.remedy)


def test_the_cell_file_says_what_is_let_pass(tmp_path: Path) -> None:
    cell = cell_of(tmp_path, "identity: {shift: night, payload_kg: 3}\nidentity_mismatch: {camera_settings: mark, shift: refuse}\n")
    session = session_of(tmp_path / "s", cell, TOLD)
    assert identity_marks({"camera_settings": "other"}, session) == ("the digest of the camera's settings is abc, the calibration is of other",)
    with pytest.raises(DataError, match="shift is night"):
        identity_marks({"shift": "day"}, session)
    with pytest.raises(DataError, match="the payload is 3, the calibration is of 5"):
        identity_marks({"payload_kg": 5}, session)  # told by the cell file alone
    assert identity_marks({"operator": "x"}, session_of(tmp_path / "t", cell, {"operator": "y"})) == ("operator is y, the calibration is of x",)


def test_sessions_of_two_cameras_are_not_solved_together(tmp_path: Path) -> None:
    cell = cell_of(tmp_path)
    first, second, silent = (session_of(tmp_path / name, cell, told) for name, told in (("a", TOLD), ("b", TOLD), ("c", None)))
    check_one_system([silent, first, second])
    with pytest.raises(DataError, match="serial number is c2, an earlier session's c1") as caught:
        check_one_system([silent, first, session_of(tmp_path / "d", cell, {"camera_serial": "c2"})])
    assert str(caught.value.file) == str(tmp_path / "d")


class Told(FakeCamera):
    """A camera that says who it is."""

    opened = False

    def __init__(self) -> None:
        super().__init__()
        self.info = CameraInfo("fake", serial="c1", settings_digest="abc")

    def open(self) -> CameraInfo:
        self.opened = True
        return self.info

    def close(self) -> None:
        self.opened = False


class ToldRobot(FakeRobot):
    """A robot that says who it is."""

    info = RobotInfo("fake", serial="r1")

    def open(self) -> RobotInfo:
        return self.info


def test_what_is_opened_anew_must_be_the_same() -> None:
    robot, camera = ToldRobot(), Told()
    with Devices(robot, camera) as devices:
        assert devices.identity == {"robot_serial": "r1", "camera_serial": "c1", "camera_settings": "abc"}
        reopen_camera(camera, devices.identity)
        reopen_robot(robot, devices.identity)
        assert camera.opened
        camera.info = replace(camera.info, settings_digest="def")
        with pytest.raises(CameraMisconfigured, match="settings is def, the run was begun with abc"):
            reopen_camera(camera, devices.identity)
        assert not camera.opened
        robot.info = RobotInfo("fake", serial="r2")
        with pytest.raises(WrongController, match="serial number is r2"):
            reopen_robot(robot, devices.identity)
