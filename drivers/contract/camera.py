"""The contract of `drivers.protocols.Camera3D` as a pytest class.

Subclass it and give a fixture `rig`:

    class TestMyCamera(CameraContract):
        @pytest.fixture
        def rig(self) -> Iterator[CameraRig]:
            yield CameraRig(make=lambda: MyCamera("192.168.0.20"))

Tests whose means a rig does not have are skipped, and say which.
"""

from __future__ import annotations

import time
from itertools import pairwise

import numpy as np

from drivers.contract.camera_rig import CameraRig, capture_or_error, fault_of, opened_camera, require_sphere
from drivers.contract.checks import in_time, require, require_raises, skip_without
from drivers.errors import CameraBusy, CameraLost, CameraMisconfigured, CameraNotReached, CameraTimeout, IncompleteFrame
from drivers.protocols import CONNECT_S, Camera3D, Frame3D

__all__ = ["CameraContract", "CameraRig"]

_METRES_BELOW_MM = 10.0
_TRIES = 10
_OVER_S = 0.5


class CameraContract:
    """One test per promise of the protocol."""

    def test_it_is_a_camera_that_says_what_it_is(self, rig: CameraRig) -> None:
        """The protocol's methods are there; `close` may be called at any time, any number of times; it can be opened again."""
        camera = rig.make()
        require(isinstance(camera, Camera3D), "does not satisfy drivers.protocols.Camera3D")
        camera.close()
        require(bool(camera.open().adapter), "CameraInfo.adapter is empty")
        camera.close()
        camera.close()
        camera.open()
        camera.capture(timeout_s=rig.timeout_s)
        camera.close()

    def test_the_identity_is_the_same_every_time(self, rig: CameraRig) -> None:
        """A calibration is bound to it: serial, settings and on-board correction do not change by opening again."""
        infos = []
        for _ in range(2):
            camera = rig.make()
            infos.append(camera.open())
            camera.close()
        require(infos[0] == infos[1], f"opened twice: {infos[0]} and {infos[1]}")
        require(not rig.has_settings or bool(infos[0].settings_digest), "CameraInfo.settings_digest is empty")

    def test_no_frame_without_a_link(self, rig: CameraRig) -> None:
        """Before `open` and after `close` there is nothing to capture."""
        never_opened = rig.make()
        require_raises(lambda: never_opened.capture(timeout_s=rig.timeout_s), CameraNotReached)
        with opened_camera(rig) as camera:
            camera.capture(timeout_s=rig.timeout_s)
        require_raises(lambda: camera.capture(timeout_s=rig.timeout_s), CameraNotReached)

    def test_frames_are_float32_mm_with_nan_for_holes(self, rig: CameraRig) -> None:
        """(height, width, 3), C-contiguous, in mm and in front of the camera; a hole is NaN in all three and never (0, 0, 0)."""
        with opened_camera(rig) as camera:
            frame = camera.capture(timeout_s=rig.timeout_s)
        xyz = frame.xyz_mm
        require(xyz.ndim == 3 and xyz.shape[-1] == 3, f"a frame of the shape {xyz.shape}")
        require(xyz.dtype == np.float32 and xyz.flags.c_contiguous, f"{xyz.dtype}, C-contiguous: {xyz.flags.c_contiguous}")
        require(rig.organised == (xyz.shape[0] > 1), f"a grid of {xyz.shape[0]} rows, expected an {'' if rig.organised else 'un'}organised frame")
        whole, empty = np.isfinite(xyz).all(axis=-1), np.isnan(xyz).all(axis=-1)
        require(bool((whole | empty).all()), "a point that is neither whole nor NaN in all three")
        require(bool(whole.any()), "not a single point")
        require(bool(xyz[whole].any(axis=-1).all()), "a hole is marked by (0, 0, 0)")
        depth_mm = float(np.median(xyz[whole][:, 2]))
        require(depth_mm > _METRES_BELOW_MM, f"the median depth is {depth_mm:g}: metres, or the z axis looks back")
        _require_images_fit(frame)

    def test_a_known_sphere_is_where_it_is(self, rig: CameraRig) -> None:
        """Unit, axes and scale, all at once."""
        with opened_camera(rig) as camera:
            require_sphere(camera.capture(timeout_s=rig.timeout_s), rig)

    def test_frames_are_numbered_and_time_goes_on(self, rig: CameraRig) -> None:
        """Sequence numbers and times of the trigger rise from frame to frame, and lie within the call."""
        frames = []
        with opened_camera(rig) as camera:
            for _ in range(4):
                began_s = time.monotonic()
                frame = camera.capture(timeout_s=rig.timeout_s)
                if rig.real_time:
                    require(began_s <= frame.time_s <= time.monotonic(), "time_s is not the time of the trigger")
                frames.append(frame)
        for earlier, later in pairwise(frames):
            require(later.sequence > earlier.sequence, f"frame {later.sequence} after frame {earlier.sequence}")
            require(later.time_s > earlier.time_s or (not rig.real_time and later.time_s == earlier.time_s), "time does not rise from frame to frame")

    def test_a_frame_stays_as_it_was(self, rig: CameraRig) -> None:
        """Arrays are owned: later frames, and closing the camera, do not change those that were handed over."""
        with opened_camera(rig) as camera:
            frames = [camera.capture(timeout_s=rig.timeout_s)]
            copies = [frames[0].xyz_mm.copy()]
            for _ in range(3):
                if rig.move_sphere is not None:
                    rig.move_sphere()
                frames.append(camera.capture(timeout_s=rig.timeout_s))
                copies.append(frames[-1].xyz_mm.copy())
        for frame, copy in zip(frames, copies, strict=True):
            require(np.array_equal(frame.xyz_mm, copy, equal_nan=True), f"frame {frame.sequence} has changed since it was handed over")
        for first, second in pairwise(frames):
            require(not np.shares_memory(first.xyz_mm, second.xyz_mm), "two frames share their memory")

    def test_a_frame_shows_the_scene_after_its_trigger(self, rig: CameraRig) -> None:
        """The sphere is moved between captures, right before the trigger; every frame shows it where it is now."""
        move = rig.move_sphere
        if move is None:
            skip_without("a sphere that can be moved")
        with opened_camera(rig) as camera:
            for _ in range(3):
                move()
                require_sphere(camera.capture(timeout_s=rig.timeout_s), rig)

    def test_nobody_at_the_address(self, rig: CameraRig) -> None:
        """`open` ends in time, and other threads run on meanwhile."""
        if not rig.nobody:
            skip_without("addresses where no camera is")
        for make in rig.nobody.values():
            camera = make()
            with in_time(CONNECT_S):
                require_raises(camera.open, CameraNotReached, CameraTimeout)
            camera.close()

    def test_another_client_holds_it(self, rig: CameraRig) -> None:
        """Told as that, and not at the first capture."""
        fault_of(rig, "busy")()
        camera = rig.make()
        with in_time(CONNECT_S):
            require_raises(camera.open, CameraBusy)
        camera.close()
        rig.clear()
        with opened_camera(rig) as camera:
            camera.capture(timeout_s=rig.timeout_s)

    def test_settings_that_would_spoil_a_calibration(self, rig: CameraRig) -> None:
        """Found when it is opened, or with the first frame; no such frame is handed over."""
        fault_of(rig, "misconfigured")()
        camera = rig.make()

        def open_and_capture() -> None:
            camera.open()
            camera.capture(timeout_s=rig.timeout_s)

        require_raises(open_and_capture, CameraMisconfigured)
        camera.close()

    def test_silence(self, rig: CameraRig) -> None:
        """No frame comes: CameraTimeout in time, while other threads run; afterwards it works as before."""
        break_it = fault_of(rig, "silence")
        with opened_camera(rig) as camera:
            camera.capture(timeout_s=rig.timeout_s)
            break_it()
            with in_time(rig.short_timeout_s + _OVER_S):
                require_raises(lambda: camera.capture(timeout_s=rig.short_timeout_s), CameraTimeout)
            rig.clear()
            camera.capture(timeout_s=rig.timeout_s)

    def test_a_late_frame_is_never_taken_for_the_next(self, rig: CameraRig) -> None:
        """A frame comes after its call has given up; the sphere has moved since."""
        self._old_one_is_not_taken(rig, "late", CameraTimeout)

    def test_a_frame_that_lay_in_the_queue_is_never_taken(self, rig: CameraRig) -> None:
        """A frame was exposed, by whomever, before the call."""
        self._old_one_is_not_taken(rig, "old_frame")

    def _old_one_is_not_taken(self, rig: CameraRig, fault: str, *first_ends_in: type[CameraTimeout]) -> None:
        break_it = fault_of(rig, fault)
        if rig.move_sphere is None:
            skip_without("a sphere that can be moved")
        with opened_camera(rig) as camera:
            require_sphere(camera.capture(timeout_s=rig.timeout_s), rig)
            break_it()
            if first_ends_in:
                require_raises(lambda: camera.capture(timeout_s=rig.short_timeout_s), *first_ends_in)
            rig.move_sphere()
            rig.clear()
            require_sphere(camera.capture(timeout_s=rig.timeout_s), rig)

    def test_lost_packets(self, rig: CameraRig) -> None:
        """Frames with gaps are errors; frames that are handed over are whole."""
        break_it = fault_of(rig, "lost_packets")
        with opened_camera(rig) as camera:
            full = int(np.isfinite(camera.capture(timeout_s=rig.timeout_s).xyz_mm).sum())
            break_it()
            results = [capture_or_error(camera, rig.short_timeout_s) for _ in range(_TRIES)]
            rig.clear()
            camera.capture(timeout_s=rig.timeout_s)
        errors = [result for result in results if not isinstance(result, Frame3D)]
        require(any(isinstance(error, IncompleteFrame) for error in errors), f"{len(errors)} errors in {_TRIES} frames, none of them IncompleteFrame")
        wrong = [error for error in errors if not isinstance(error, IncompleteFrame | CameraTimeout)]
        require(not wrong, f"lost packets end in {wrong[:1]}")
        for result in results:
            if isinstance(result, Frame3D):
                require(int(np.isfinite(result.xyz_mm).sum()) > 0.9 * full, "a frame with gaps was handed over")

    def test_a_camera_that_goes_away(self, rig: CameraRig) -> None:
        """Told in time, again and again; nothing hangs; opened anew, it works when it is back."""
        break_it = fault_of(rig, "gone")
        with opened_camera(rig) as camera:
            camera.capture(timeout_s=rig.timeout_s)
            break_it()
            for _ in range(2):
                with in_time(max(rig.short_timeout_s + _OVER_S, CONNECT_S)):
                    require_raises(lambda: camera.capture(timeout_s=rig.short_timeout_s), CameraLost, CameraTimeout)
            with in_time(CONNECT_S):
                camera.close()
        rig.clear()
        with opened_camera(rig) as camera:
            camera.capture(timeout_s=rig.timeout_s)


def _require_images_fit(frame: Frame3D) -> None:
    for name, image in (("intensity", frame.intensity), ("quality", frame.quality)):
        if image is not None:
            require(image.shape == frame.xyz_mm.shape[:2], f"{name} of the shape {image.shape} beside points {frame.xyz_mm.shape}")
            require(image.dtype == np.float32, f"{name} is {image.dtype}")
    if frame.intensity is not None:
        require(bool(np.nanmin(frame.intensity) >= 0 and np.nanmax(frame.intensity) <= 1), "intensity outside 0..1")
    require((frame.quality is None) == (frame.quality_kind is None), "quality and quality_kind belong together")
