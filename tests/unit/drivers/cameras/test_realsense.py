"""The RealSense camera: the contract on the vendor's software device, and recordings replayed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.cameras.depth_images import Intrinsics, depth_points_mm
from drivers.cameras.realsense import RealsenseCamera, make_camera
from drivers.cameras.realsense_settings import RealsenseSettings
from drivers.contract.camera import CameraContract, CameraRig
from drivers.contract.camera_rig import require_sphere
from drivers.errors import CameraError, CameraMisconfigured, CameraNotReached, SettingsError
from drivers.registry import DriverContext
from tests.support.fake_realsense import UNIT_M, FakeRealsense, Pinhole, lines_of_sight
from tests.support.scan_scene import RADIUS_MM, ScanScene
from tests.support.scenes import frame

SIGHT = lines_of_sight(Pinhole())
HEIGHT, WIDTH = SIGHT.shape[:2]


class Scene(ScanScene):
    """The sphere on the lines of sight of the software device."""

    def expose(self) -> NDArray[np.float32]:
        self.n_exposures += 1
        return frame([(self.centre_mm, RADIUS_MM)], sight=SIGHT, noise_mm=0.0, seed=self.n_exposures)


def camera_of(fake: FakeRealsense, **settings: object) -> RealsenseCamera:
    """The adapter on the software device."""
    return RealsenseCamera(RealsenseSettings.model_validate({"serial": "SW1", "discard_frames": 1, **settings}), fake.find)


class TestSoftwareDevice(CameraContract):
    @pytest.fixture
    def rig(self) -> Iterator[CameraRig]:
        scene = Scene()
        fake = FakeRealsense(scene.expose)
        with fake.streaming():
            yield CameraRig(
                make=lambda: camera_of(fake),
                short_timeout_s=0.5,
                radius_mm=RADIUS_MM,
                centre_mm=lambda: scene.centre_mm,
                move_sphere=scene.move,
                tolerance_mm=0.01,
                nobody={"no such serial": lambda: make_camera(DriverContext({"serial": "0000"}, None, Path()))},
                faults={"silence": lambda: setattr(fake, "silent", True), "old_frame": fake.send},
                clear=lambda: setattr(fake, "silent", False),
            )


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"serial": "SW2"}, "serial number SW1, the cell file names SW2"),
        ({"size": (640, 480)}, "no depth stream of size"),
        ({"depth_unit_mm": 0.1}, "no option depth_units that can be set"),
        ({"options": {"exposure": 8500.0}}, "no option exposure"),
    ],
)
def test_settings_that_do_not_fit_the_camera(settings: dict[str, object], said: str) -> None:
    with pytest.raises(CameraMisconfigured, match=said) as caught:
        camera_of(FakeRealsense(Scene().expose), **settings).open()
    assert caught.value.remedy


def test_what_the_camera_tells_of_itself() -> None:
    camera = camera_of(FakeRealsense(Scene().expose), depth_unit_mm=0.01)
    info = camera.open()
    camera.close()
    assert (info.vendor, info.model, info.serial) == ("Intel", "software D4xx", "SW1")
    assert not info.notes
    coarse = camera_of(FakeRealsense(Scene().expose, unit_m=1e-3)).open()
    assert any("steps of 1 mm" in note for note in coarse.notes)
    assert coarse.settings_digest != info.settings_digest


def test_temperatures_come_along() -> None:
    fake = FakeRealsense(Scene().expose)
    camera = camera_of(fake)
    camera.open()
    with fake.streaming():
        assert camera.capture(timeout_s=3).temperatures_c == {"asic": 41.5}
    camera.close()


def test_a_distorted_stream_is_refused() -> None:
    fake = FakeRealsense(Scene().expose, distortion=0.1)
    camera = camera_of(fake)
    camera.open()
    with fake.streaming(), pytest.raises(CameraMisconfigured, match="distorted"):
        camera.capture(timeout_s=3)
    camera.close()


def record(folder: Path, scene: Scene, n_frames: int) -> Path:
    """A recording of the software device, by the vendor's recorder."""
    fake = FakeRealsense(scene.expose)
    path = folder / "scan.db3"
    recorder = fake.rs.recorder(str(path), fake.device)
    sensor = recorder.query_sensors()[0]
    queue = fake.rs.frame_queue(50)
    sensor.open(sensor.get_stream_profiles()[0])
    sensor.start(queue)
    for _ in range(n_frames):
        fake.send()
        queue.wait_for_frame(2000)
    sensor.stop()
    sensor.close()
    return path


def test_a_recording_is_replayed_frame_by_frame(tmp_path: Path) -> None:
    scene = Scene()
    path = record(tmp_path, scene, 5)
    camera = make_camera(DriverContext({"recording": path.name}, None, tmp_path))
    info = camera.open()
    assert info.serial == "SW1"
    assert any("replays" in note for note in info.notes)
    frames = [camera.capture(timeout_s=2) for _ in range(5)]
    assert [frame.sequence for frame in frames] == [1, 2, 3, 4, 5]
    assert [frame.diagnostics["frame_number"] for frame in frames] == [1, 2, 3, 4, 5]
    rig = CameraRig(make=lambda: camera, radius_mm=RADIUS_MM, centre_mm=lambda: scene.centre_mm, tolerance_mm=0.01)
    for one in frames:
        require_sphere(one, rig)
    with pytest.raises(CameraNotReached, match="the recording is over"):
        camera.capture(timeout_s=0.5)
    camera.close()


@pytest.mark.parametrize("name", ["missing.db3", "broken.db3"])
def test_recordings_that_cannot_be_read(tmp_path: Path, name: str) -> None:
    pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed: pip install 'spherecal[realsense]'")
    (tmp_path / "broken.db3").write_bytes(b"no recording")
    with pytest.raises(CameraError):
        make_camera(DriverContext({"recording": name}, None, tmp_path)).open()


@pytest.mark.parametrize("settings", [{}, {"serial": "1", "depth_unit_mm": 0.0}, {"serial": "1", "discard_frames": 0}, {"serial": 1}])
def test_settings_are_checked(settings: dict[str, object]) -> None:
    with pytest.raises(SettingsError):
        make_camera(DriverContext(settings, None, Path()))


def test_points_are_those_of_the_vendor_s_own_deprojection() -> None:
    rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed: pip install 'spherecal[realsense]'")
    rng = np.random.default_rng(2)
    depth = rng.integers(0, 65535, (HEIGHT, WIDTH), dtype=np.uint16)
    pinhole = rs.intrinsics()
    pinhole.width, pinhole.height, pinhole.fx, pinhole.fy, pinhole.ppx, pinhole.ppy = WIDTH, HEIGHT, 701.0, 699.0, 80.5, 59.25
    points = depth_points_mm(depth, 1000 * UNIT_M, Intrinsics(WIDTH, HEIGHT, 701.0, 699.0, 80.5, 59.25))
    for row, column in rng.integers(0, (HEIGHT, WIDTH), (200, 2)):
        vendor_m = rs.rs2_deproject_pixel_to_point(pinhole, [float(column), float(row)], float(depth[row, column]) * UNIT_M)
        assert np.abs(points[row, column] - 1000 * np.array(vendor_m)).max() < 1e-4
    assert np.isnan(points[depth == 0]).all()
