"""Mech-Mind Mech-Eye area-scan cameras, by address, through the vendor's library. Never run on hardware.

The untransformed point cloud is taken, which is in the camera's own frame whatever reference frame is set in Mech-Eye
Viewer. The library's `discover_cameras` broadcasts and is never called.
"""

from __future__ import annotations

from ipaddress import IPv4Address
from typing import Annotated, Any

from pydantic import Field, field_validator

from drivers.cameras.frames import require_serial, settings_digest
from drivers.cameras.settings import CameraSettings, parse_settings
from drivers.cameras.vendor import VendorCamera, VendorScan, stdout_to_stderr
from drivers.errors import CameraBusy, CameraError, CameraLost, CameraMisconfigured, CameraNotReached, CameraSdkMissing, CameraTimeout
from drivers.files.schema import Text
from drivers.protocols import CameraInfo
from drivers.registry import DriverContext

_CONNECT_MS = 2500
_REMEDY = "Check cable, power and address, and that Mech-Eye Viewer is disconnected."
_KINDS: dict[str, type[CameraError]] = {
    "TIMEOUT_ERROR": CameraTimeout,
    "ACQUISITION_TRIGGER_WAIT": CameraTimeout,
    "DEVICE_OFFLINE": CameraLost,
    "INVALID_DEVICE": CameraLost,
    "MESSAGE_CHANNEL_ERROR": CameraLost,
    "DEVICE_BUSY": CameraBusy,
    "MESSAGE_CHANNEL_OCCUPPIED": CameraBusy,
    "PARAMETER_ERROR": CameraMisconfigured,
    "NO_SUPPORT_ERROR": CameraMisconfigured,
    "OUT_OF_RANGE_ERROR": CameraMisconfigured,
}


class MechEyeSettings(CameraSettings):
    """The settings of the driver `mech_eye`."""

    address: Annotated[Text, Field(description="IPv4 address of the camera")]
    user_set: Annotated[Text | None, Field(description="user set of the camera that is selected first")] = None

    @field_validator("address")
    @classmethod
    def _is_an_address(cls, value: str) -> str:
        return str(IPv4Address(value))


def make_camera(context: DriverContext) -> VendorCamera:
    """The camera of a cell file.

    Raises:
        SettingsError: `address` is missing or no address; an unknown or wrong setting.
    """
    settings = parse_settings(MechEyeSettings, context.settings, "mech_eye")
    return VendorCamera("mech_eye", lambda: MechEyeSession(settings))


class MechEyeSession:
    """One connection."""

    def __init__(self, settings: MechEyeSettings) -> None:
        self._settings = settings
        self._camera: Any = None
        self._library: Any = None

    def connect(self) -> CameraInfo:
        """Connect by address, select the user set, and set mm."""
        try:
            with stdout_to_stderr():
                from mecheye import area_scan_3d_camera, shared
        except ImportError as error:
            raise CameraSdkMissing(f"mecheyeapi cannot be loaded ({error})", remedy="pip install 'spherecal[mech_eye]'") from error
        self._library = area_scan_3d_camera
        camera = area_scan_3d_camera.Camera()
        with stdout_to_stderr():
            status = camera.connect(self._settings.address, _CONNECT_MS)
        try:
            check(status, f"connecting to {self._settings.address}")
        except (CameraTimeout, CameraLost) as error:
            raise CameraNotReached(error.message, remedy=_REMEDY) from error
        self._camera = camera
        if self._settings.user_set is not None:
            check(camera.user_set_manager().select_user_set(self._settings.user_set), f"selecting the user set {self._settings.user_set}")
        check(camera.set_point_cloud_unit(shared.CoordinateUnit_Millimeter), "setting mm")
        told = area_scan_3d_camera.CameraInfo()
        check(camera.get_camera_info(told), "asking who it is")
        return self._info(told)

    def scan(self, timeout_s: float) -> VendorScan:
        """Trigger, and the untransformed cloud."""
        frame = self._library.Frame3D()
        check(self._camera.capture_3d(frame, max(1, int(1000 * timeout_s))), "capturing")
        points = frame.get_untextured_point_cloud().data()
        return VendorScan(points, temperatures_c=self._temperatures(), diagnostics={"frame_id": int(frame.frame_id())})

    def disconnect(self) -> None:
        """Give the camera back."""
        if self._camera is not None:
            with stdout_to_stderr():
                self._camera.disconnect()
            self._camera = None

    def _info(self, told: Any) -> CameraInfo:
        said = self._settings
        serial = str(told.serial_number)
        require_serial(serial, said.serial)
        return CameraInfo(
            adapter="mech_eye",
            vendor="Mech-Mind",
            model=str(told.model),
            serial=serial,
            firmware=str(told.firmware_version.to_string()),
            settings_digest=settings_digest({"user_set": said.user_set, "preset": said.preset}),
            onboard_correction=said.onboard_correction,
            notes=() if said.user_set else ("no user_set is named, so settings changed in Mech-Eye Viewer are not noticed",),
        )

    def _temperatures(self) -> dict[str, float]:
        told = self._library.CameraStatus()
        if not self._camera.get_camera_status(told).is_ok():
            return {}
        return {"cpu": float(told.temperature.cpu_temperature), "projector": float(told.temperature.projector_temperature)}


def check(status: Any, doing: str) -> None:
    """Nothing, for success of a call of the library.

    Raises:
        CameraError: of the kind that fits its code.
    """
    if status.is_ok():
        return
    code = int(status.error_code)
    names = {int(getattr(type(status), name)): name for name in dir(type(status)) if name.startswith("MMIND_STATUS_")}
    name = names.get(code, f"code {code}").removeprefix("MMIND_STATUS_")
    raise _KINDS.get(name, CameraLost)(f"{doing} failed: {status.error_description} ({name})", remedy=_REMEDY)
