"""The recorded robot and camera replay a session and nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.errors import CameraNotReached, FileError, InvalidFrame, MotionRefused, RobotError, RobotNotReached, SettingsError
from drivers.protocols import Devices
from drivers.recorded import make_camera, make_robot
from drivers.registry import DriverContext
from tests.support.sessions import scan_bytes, shot_dict, write_session


def _devices(folder: Path) -> Devices:
    context = DriverContext({"session": folder.name}, None, folder.parent)
    return Devices(make_robot(context), make_camera(context))


def _points(index: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    return np.frombuffer(scan_bytes(index)[-48:], "<f4").reshape(1, 4, 3)


def test_each_pose_gives_its_own_scan_in_any_order(tmp_path: Path) -> None:
    with _devices(write_session(tmp_path / "s")) as devices:
        for index in (2, 0, 1, 0):
            joints = np.array(shot_dict(index)["joints_rad"]) + 5e-4
            devices.robot.start_move(joints, speed_rad_s=0.1)
            state = devices.robot.read_state()
            assert state.joints_rad is not None
            assert state.joints_rad.tolist() == shot_dict(index)["joints_rad"]  # measured, not commanded
            assert state.base_from_flange is not None
            assert not state.moving
            assert np.array_equal(devices.camera.capture(timeout_s=1).xyz_mm, _points(index))


def test_target_angles_lead_to_a_shot_too_and_frames_are_numbered(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "s", 2, lambda shots: shots[1].update(target_joints_rad=[1.0] * 6))
    with _devices(folder) as devices:
        devices.robot.start_move(np.ones(6), speed_rad_s=0.1)
        frames = [devices.camera.capture(timeout_s=1) for _ in range(2)]
    assert np.array_equal(frames[0].xyz_mm, _points(1))
    assert frames[1].sequence > frames[0].sequence


def test_shots_at_one_pose_are_played_in_turn(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "s", 3, lambda shots: shots[2].update(joints_rad=shots[0]["joints_rad"]))
    with _devices(folder) as devices:
        seen = []
        for _ in range(3):
            devices.robot.start_move(np.array(shot_dict(0)["joints_rad"]), speed_rad_s=0.1)
            seen.append(devices.camera.capture(timeout_s=1).xyz_mm)
    assert [next(i for i in range(3) if np.array_equal(xyz, _points(i))) for xyz in seen] == [0, 2, 0]


def test_a_pose_that_was_never_recorded_is_refused(tmp_path: Path) -> None:
    with _devices(write_session(tmp_path / "s")) as devices:
        for joints in (np.array(shot_dict(0)["joints_rad"]) + 2e-3, np.zeros(5)):
            with pytest.raises(MotionRefused) as caught:
                devices.robot.start_move(joints, speed_rad_s=0.1)
            assert caught.value.remedy
        with pytest.raises(InvalidFrame):
            devices.camera.capture(timeout_s=1)


def test_time_passes_only_when_it_is_waited_for(tmp_path: Path) -> None:
    with _devices(write_session(tmp_path / "s")) as devices:
        start = devices.robot.read_state().time_s
        devices.robot.wait(3600)
        assert devices.robot.read_state().time_s == start + 3600
        devices.robot.stop()


def test_a_camera_alone_plays_the_scans_in_order(tmp_path: Path) -> None:
    camera = make_camera(DriverContext({"session": "s"}, None, write_session(tmp_path / "s", 2).parent))
    for _ in range(2):
        camera.open()
        assert [np.array_equal(camera.capture(timeout_s=1).xyz_mm, _points(i)) for i in range(2)] == [True, True]
        with pytest.raises(CameraNotReached, match="over"):
            camera.capture(timeout_s=1)
        camera.close()
        camera.close()
    with pytest.raises(CameraNotReached, match="not open"):
        camera.capture(timeout_s=1)


def test_a_recording_of_poses_says_so(tmp_path: Path) -> None:
    def poses_only(shots: list[dict[str, object]]) -> None:
        for shot in shots:
            shot["joints_rad"] = None

    with pytest.raises(RobotError, match="no axis angles") as caught, _devices(write_session(tmp_path / "s", 2, poses_only)):
        pass
    assert caught.value.remedy


def test_failed_and_empty_recordings(tmp_path: Path) -> None:
    def failed(shots: list[dict[str, object]]) -> None:
        for shot in shots:
            shot["status"] = "failed"

    folder = write_session(tmp_path / "s", 2, failed)
    with pytest.raises(RobotError, match="no scans"), _devices(folder):
        pass
    with pytest.raises(CameraNotReached, match="no scans"):
        _devices(folder).camera.open()
    with pytest.raises(FileError, match="no such folder"), _devices(tmp_path / "none"):
        pass
    with pytest.raises(RobotNotReached, match="not open"):
        _devices(folder).robot.read_state()


def test_a_scan_that_changed_is_told(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "s")
    with _devices(folder) as devices:
        (folder / "scans" / "0000.ply").write_bytes(scan_bytes(1))
        devices.robot.start_move(np.array(shot_dict(0)["joints_rad"]), speed_rad_s=0.1)
        with pytest.raises(FileError, match="sha256"):
            devices.camera.capture(timeout_s=1)


@pytest.mark.parametrize(("settings", "word"), [({}, "session: FOLDER"), ({"session": 3}, "session"), ({"session": "s", "sesion": "t"}, "sesion")])
def test_settings_are_checked_when_a_device_is_made(settings: dict[str, object], word: str, tmp_path: Path) -> None:
    for make in (make_robot, make_camera):
        with pytest.raises(SettingsError, match=word):
            make(DriverContext(settings, None, tmp_path))
