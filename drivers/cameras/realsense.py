"""Intel RealSense D400, live by serial number or from a recording, through the vendor's library.

The camera streams all the time; `capture` empties the queue, lets a few frames pass that may have been exposed before the
call, and takes the next. Depths come in steps of `depth_unit_mm`: the camera's default of 1 mm is no good for metrology.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import numpy as np

from drivers.cameras.depth_images import Intrinsics, depth_points_mm
from drivers.cameras.frames import require_serial, settings_digest
from drivers.cameras.realsense_settings import RealsenseSettings
from drivers.cameras.settings import parse_settings
from drivers.errors import CameraBusy, CameraError, CameraLost, CameraMisconfigured, CameraNotReached, CameraSdkMissing, CameraTimeout
from drivers.protocols import CameraHealth, CameraInfo, Frame3D
from drivers.registry import DriverContext

_QUEUE = 8
_COARSE_MM = 0.1
_TEMPERATURES = ("asic", "projector")
_REMEDY = "Check the USB cable (USB 3), the serial number, and that no other program uses the camera."


def make_camera(context: DriverContext) -> RealsenseCamera:
    """The camera of a cell file.

    Raises:
        SettingsError: neither `serial` nor `recording`; an unknown or wrong setting.
    """
    settings = parse_settings(RealsenseSettings, context.settings, "realsense")
    if settings.recording is not None:
        path = context.folder / settings.recording
        return RealsenseCamera(settings, lambda rs: _replay(rs, str(path)))
    return RealsenseCamera(settings, lambda rs: _live(rs, str(settings.serial)))


def _live(rs: Any, serial: str) -> Any:
    for device in rs.context().query_devices():
        if device.get_info(rs.camera_info.serial_number) == serial:
            return device
    raise CameraNotReached(f"no RealSense camera with the serial number {serial} at this computer", where="camera.serial", remedy=_REMEDY)


def _replay(rs: Any, path: str) -> Any:
    try:
        device = rs.context().load_device(path)
    except RuntimeError as error:
        raise CameraNotReached(f"the recording cannot be read ({error})", file=path, remedy="Name a .db3 file of the vendor's recorder.") from error
    device.set_real_time(False)
    return device


class RealsenseCamera:
    """The depth sensor of one device. Satisfies `drivers.protocols.Camera3D`.

    Args:
        settings: what is set.
        find: gives the vendor's device object, from the vendor's module; raises CameraNotReached.
    """

    def __init__(self, settings: RealsenseSettings, find: Callable[[Any], Any]) -> None:
        self._settings, self._find = settings, find
        self._rs: Any = None
        self._device: Any = None
        self._sensor: Any = None
        self._queue: Any = None
        self._intrinsics: Intrinsics | None = None
        self._unit_mm = 0.0
        self._replays = False
        self._sequence = 0
        self._last_number = -1

    def open(self) -> CameraInfo:
        """Find the device, set its options, and let it stream.

        Raises:
            CameraNotReached: there is none, or (CameraBusy) another program holds it.
            CameraMisconfigured: an option or a stream that it has not, or depths in other steps than wanted.
            CameraSdkMissing: pyrealsense2 is not installed.
        """
        self.close()
        try:
            import pyrealsense2 as rs
        except ImportError as error:
            raise CameraSdkMissing(f"pyrealsense2 cannot be loaded ({error})", remedy="pip install 'spherecal[realsense]'") from error
        try:
            self._rs, self._device = rs, self._find(rs)
            self._replays = bool(self._device.is_playback())
            return self._open(rs, self._device)
        except CameraError:
            self.close()
            raise
        except RuntimeError as error:
            self.close()
            kind = CameraBusy if "busy" in str(error).lower() or "in use" in str(error).lower() else CameraNotReached
            raise kind(f"the RealSense camera does not open ({error})", remedy=_REMEDY) from error

    def capture(self, *, timeout_s: float) -> Frame3D:
        """The next frame that was certainly exposed after this call; of a recording the next one.

        Raises:
            CameraNotReached: not open, or the recording is over.
            CameraTimeout: no frame came in time.
            CameraLost: the vendor's library failed.
        """
        if self._queue is None:
            raise CameraNotReached("the camera is not open", remedy="Open it first.")
        called_s = time.monotonic()
        try:
            if not self._replays:
                self._drain()
                for _ in range(self._settings.discard_frames):
                    self._next(called_s + timeout_s, timeout_s)
            return self._frame(self._next(called_s + timeout_s, timeout_s), called_s)
        except CameraError:
            raise
        except RuntimeError as error:
            raise CameraLost(f"the RealSense camera fails ({error})", remedy=_REMEDY) from error

    def close(self) -> None:
        """Stop the stream."""
        if self._sensor is not None:
            with suppress(RuntimeError):
                self._sensor.stop()
            with suppress(RuntimeError):
                self._sensor.close()
        self._sensor = self._queue = self._intrinsics = self._device = None

    def _open(self, rs: Any, device: Any) -> CameraInfo:
        sensor = _depth_sensor(device)
        self._apply(rs, sensor)
        profile = self._profile(rs, sensor)
        self._intrinsics = _intrinsics(profile.get_intrinsics())
        self._unit_mm = 1000.0 * float(sensor.get_option(rs.option.depth_units))
        self._check_unit()
        queue = rs.frame_queue(_QUEUE)
        sensor.open(profile)
        self._sensor = sensor
        sensor.start(queue)
        self._queue, self._last_number = queue, -1
        return self._info(rs, device, profile)

    def _apply(self, rs: Any, sensor: Any) -> None:
        wanted = dict(self._settings.options)
        if self._settings.depth_unit_mm is not None and not self._replays:
            current_mm = 1000.0 * float(sensor.get_option(rs.option.depth_units))
            if abs(current_mm / self._settings.depth_unit_mm - 1) > 1e-3:
                wanted["depth_units"] = self._settings.depth_unit_mm / 1000.0
        for name, value in wanted.items():
            option = getattr(rs.option, name, None)
            if option is None or not sensor.supports(option) or sensor.is_option_read_only(option):
                raise CameraMisconfigured(f"the camera has no option {name} that can be set", where=f"camera.options.{name}", remedy=_REMEDY)
            sensor.set_option(option, value)

    def _profile(self, rs: Any, sensor: Any) -> Any:
        depths = [profile for profile in sensor.get_stream_profiles() if profile.stream_type() == rs.stream.depth]
        videos = [profile.as_video_stream_profile() for profile in depths if profile.format() == rs.format.z16]
        size, fps = self._settings.size, self._settings.fps
        fitting = [video for video in videos if size in {None, (video.width(), video.height())} and fps in {None, video.fps()}]
        if not fitting:
            streams = sorted({f"{video.width()} x {video.height()} at {video.fps()}" for video in videos})
            remedy = f"Depth streams that it has: {', '.join(streams) or 'none'}."
            raise CameraMisconfigured(f"the camera has no depth stream of size {size} at {fps} a second", where="camera.size", remedy=remedy)
        return next((video for video in fitting if video.is_default()), fitting[0])

    def _check_unit(self) -> None:
        wanted_mm = self._settings.depth_unit_mm
        if wanted_mm is not None and abs(self._unit_mm / wanted_mm - 1) > 1e-3:
            found = f"its depths come in steps of {self._unit_mm:g} mm, not {wanted_mm:g} mm"
            raise CameraMisconfigured(found, where="camera.depth_unit_mm", remedy="Record again with that step, or correct the cell file.")

    def _info(self, rs: Any, device: Any, profile: Any) -> CameraInfo:
        def told(key: Any) -> str | None:
            return str(device.get_info(key)) if device.supports(key) else None

        said = self._settings
        serial = told(rs.camera_info.serial_number)
        require_serial(serial, said.serial)
        intrinsics = _intrinsics(profile.get_intrinsics())
        data = {"intrinsics": asdict(intrinsics), "fps": profile.fps(), "unit_mm": round(self._unit_mm, 9), "options": dict(said.options)}
        notes = (f"depths come in steps of {self._unit_mm:g} mm: set depth_unit_mm to 0.1 or finer",) if self._unit_mm > 1.001 * _COARSE_MM else ()
        return CameraInfo(
            adapter="realsense",
            vendor="Intel",
            model=told(rs.camera_info.name),
            serial=serial,
            firmware=told(rs.camera_info.firmware_version),
            settings_digest=settings_digest({**data, "preset": said.preset}),
            onboard_correction=said.onboard_correction or _calibration_table(device),
            sdk_version=f"librealsense {getattr(rs, '__version__', '')}".strip(),
            notes=(*notes, f"replays {said.recording}") if self._replays else notes,
        )

    def _drain(self) -> None:
        while True:
            came, frame = self._queue.try_wait_for_frame(0)
            if not came:
                return
            self._last_number = frame.get_frame_number()

    def _next(self, end_s: float, timeout_s: float) -> Any:
        while True:
            left_ms = max(0, int(1000 * (end_s - time.monotonic())))
            came, frame = self._queue.try_wait_for_frame(left_ms)
            if not came:
                if self._replays and "stopped" in str(self._device.current_status()):
                    raise CameraNotReached("the recording is over", remedy="Open it again to play from the beginning.")
                raise CameraTimeout(f"no frame came within {timeout_s:g} s", remedy="Check the USB cable, and allow more time for long exposures.")
            if frame.get_frame_number() > self._last_number:
                self._last_number = frame.get_frame_number()
                return frame

    def _frame(self, frame: Any, called_s: float) -> Frame3D:
        depth = np.array(np.asanyarray(frame.get_data()), dtype=np.uint16, copy=True)
        if self._intrinsics is None:
            raise CameraNotReached("the camera is not open", remedy="Open it first.")
        self._sequence += 1
        return Frame3D(
            xyz_mm=depth_points_mm(depth, self._unit_mm, self._intrinsics),
            sequence=self._sequence,
            time_s=called_s,
            temperatures_c=self._temperatures(),
            done_s=time.monotonic(),
            device_time_ns=int(1e6 * frame.get_timestamp()),
            diagnostics={"frame_number": frame.get_frame_number(), "time_domain": str(frame.get_frame_timestamp_domain())},
        )

    def health(self) -> CameraHealth:
        """The temperatures of its sensors.

        Raises:
            CameraNotReached: not open, or it does not answer.
        """
        if self._sensor is None:
            raise CameraNotReached("the camera is not open", remedy="Open it first.")
        try:
            return CameraHealth(self._temperatures())
        except RuntimeError as error:
            raise CameraLost(f"the camera does not answer ({error})", remedy="Check the USB cable, and open it anew.") from error

    def _temperatures(self) -> dict[str, float]:
        options = {name: getattr(self._rs.option, f"{name}_temperature") for name in _TEMPERATURES}
        return {name: float(self._sensor.get_option(option)) for name, option in options.items() if self._sensor.supports(option)}


def _depth_sensor(device: Any) -> Any:
    """The depth sensor; software devices and recordings have plain sensors, without the extension of one."""
    sensors = list(device.query_sensors())
    return next((sensor for sensor in sensors if sensor.is_depth_sensor()), sensors[0])


def _intrinsics(found: Any) -> Intrinsics:
    return Intrinsics(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy, tuple(float(value) for value in found.coeffs))


def _calibration_table(device: Any) -> str | None:
    """A digest of the calibration that the camera holds; its self-calibration changes it."""
    with suppress(RuntimeError):
        if device.is_auto_calibrated_device():
            return hashlib.sha256(bytes(device.as_auto_calibrated_device().get_calibration_table())).hexdigest()[:16]
    return None
