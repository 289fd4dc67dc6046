"""The contract on the simulated and the recorded camera, and that the contract sees a camera that breaks it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from acquire.session import SessionWriter
from drivers.contract.camera import CameraContract, CameraRig
from drivers.contract.checks import ContractBroken
from drivers.errors import CameraNotReached
from drivers.kinematics import se3
from drivers.protocols import CameraInfo, Frame3D
from drivers.recorded import RecordedCamera, Recording
from drivers.simulated.camera import SimulatedCamera
from tests.support.fake_devices import fake_cell
from tests.support.scan_scene import RADIUS_MM, ScanScene
from tests.support.simulated import JOINTS_RAD, cell_at, exact_camera, in_base, truth_with_sphere


class TestSimulatedCamera(CameraContract):
    @pytest.fixture
    def rig(self) -> CameraRig:
        cell = cell_at(truth_with_sphere(camera=exact_camera(range_noise_mm=0.02)))
        centre_in_base_mm = np.array(in_base((20.0, -15.0, 350.0)))

        def move() -> None:
            cell.start_motion(JOINTS_RAD + 0.01 * (1 + cell.clock_s % 3) * np.eye(6)[0], speed_rad_s=1.0)
            cell.advance(10.0)

        return CameraRig(
            make=lambda: SimulatedCamera(cell),
            radius_mm=19.05,
            centre_mm=lambda: np.asarray(se3.apply(se3.inverse(cell.true_base_from_camera()), centre_in_base_mm)),
            move_sphere=move,
            real_time=False,
        )


class TestRecordedCamera(CameraContract):
    @pytest.fixture
    def rig(self, tmp_path: Path) -> CameraRig:
        scene = ScanScene()
        with SessionWriter.create(tmp_path / "s", purpose="calibration", cell=fake_cell(tmp_path)) as writer:
            for i in range(8):
                writer.append(sphere="A", joints_rad=np.array([0.1 * i, 0.0]), xyz_mm=scene.expose())

        def make() -> RecordedCamera:
            return RecordedCamera(Recording(tmp_path / "s"))

        return CameraRig(make=make, radius_mm=RADIUS_MM, centre_mm=lambda: scene.centre_mm, real_time=False, has_settings=False)


@dataclass(slots=True, eq=False)
class PlainCamera:
    """Keeps every promise, in memory."""

    scene: ScanScene
    sequence: int = 0
    is_open: bool = False
    clock_s: float = 0.0

    def open(self) -> CameraInfo:
        self.is_open = True
        return CameraInfo("plain", settings_digest="0")

    def points(self) -> NDArray[np.float32]:
        return self.scene.expose()

    def capture(self, *, timeout_s: float) -> Frame3D:
        del timeout_s
        if not self.is_open:
            raise CameraNotReached("not open", remedy="Open it.")
        self.sequence += 1
        self.clock_s += 0.1
        return Frame3D(xyz_mm=self.points(), sequence=self.sequence, time_s=self.clock_s)

    def close(self) -> None:
        self.is_open = False


class Metres(PlainCamera):
    def points(self) -> NDArray[np.float32]:
        return self.scene.expose() / np.float32(1000)


class Upward(PlainCamera):
    """Its y axis looks up."""

    def points(self) -> NDArray[np.float32]:
        return self.scene.expose() * np.array([1, -1, 1], dtype=np.float32)


class ZeroHoles(PlainCamera):
    def points(self) -> NDArray[np.float32]:
        return np.nan_to_num(self.scene.expose())


class Doubles(PlainCamera):
    def points(self) -> NDArray[np.float32]:
        return self.scene.expose().astype(np.float64)


BUFFER = np.zeros((120, 160, 3), dtype=np.float32)


class Borrowed(PlainCamera):
    """Hands out its one buffer."""

    def points(self) -> NDArray[np.float32]:
        BUFFER[:] = self.scene.expose()
        return BUFFER


class Stale(PlainCamera):
    """Always one frame late."""

    def open(self) -> CameraInfo:
        self.last = self.scene.expose()
        return super().open()

    def points(self) -> NDArray[np.float32]:
        last, self.last = self.last, self.scene.expose()
        return last


class Numberless(PlainCamera):
    def capture(self, *, timeout_s: float) -> Frame3D:
        return replace(super().capture(timeout_s=timeout_s), sequence=7)


class Open(PlainCamera):
    def close(self) -> None:
        pass


class Moody(PlainCamera):
    """Its settings are others each time."""

    def open(self) -> CameraInfo:
        self.is_open = True
        return CameraInfo("moody", settings_digest=str(id(self)))


def rig_of(kind: type[PlainCamera]) -> CameraRig:
    scene = ScanScene()
    return CameraRig(
        make=lambda: kind(scene), radius_mm=RADIUS_MM, centre_mm=lambda: scene.centre_mm, move_sphere=scene.move, real_time=False, tolerance_mm=0.02
    )


class TestPlainCamera(CameraContract):
    @pytest.fixture
    def rig(self) -> CameraRig:
        return rig_of(PlainCamera)


class TestTheContractSees:
    BROKEN: ClassVar[dict[str, tuple[type[PlainCamera], str]]] = {
        "metres": (Metres, "test_frames_are_float32_mm_with_nan_for_holes"),
        "axes that are not optical": (Upward, "test_a_known_sphere_is_where_it_is"),
        "holes at zero": (ZeroHoles, "test_frames_are_float32_mm_with_nan_for_holes"),
        "doubles": (Doubles, "test_frames_are_float32_mm_with_nan_for_holes"),
        "one buffer for all frames": (Borrowed, "test_a_frame_stays_as_it_was"),
        "old frames": (Stale, "test_a_frame_shows_the_scene_after_its_trigger"),
        "frames without numbers": (Numberless, "test_frames_are_numbered_and_time_goes_on"),
        "a link that never closes": (Open, "test_no_frame_without_a_link"),
        "another identity each time": (Moody, "test_the_identity_is_the_same_every_time"),
    }

    @pytest.mark.parametrize("name", BROKEN)
    def test_a_camera_with(self, name: str) -> None:
        broken, promise = self.BROKEN[name]
        with pytest.raises(ContractBroken):
            getattr(CameraContract(), promise)(rig_of(broken))
