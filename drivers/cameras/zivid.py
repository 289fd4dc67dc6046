"""Zivid cameras through the vendor's SDK. Never run on hardware; the SDK could not be installed where this was written.

The SDK itself looks for its cameras on the network; that is its own doing and cannot be switched off from here. A point
cloud straight from a capture is in the camera's own frame; transforms are only ever applied by calls that are not made.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from drivers.cameras.frames import require_serial, settings_digest
from drivers.cameras.settings import CameraSettings, parse_settings
from drivers.cameras.vendor import VendorCamera, VendorScan
from drivers.errors import CameraNotReached, CameraSdkMissing
from drivers.files.disk import read_bytes, sha256_hex
from drivers.files.schema import Text
from drivers.protocols import CameraInfo
from drivers.registry import DriverContext

_SENSORS = ("dmd", "general", "led", "lens", "pcb")


class ZividSettings(CameraSettings):
    """The settings of the driver `zivid`."""

    settings_file: Annotated[Text, Field(description="capture settings (.yml) saved by Zivid Studio, relative to the cell file")]
    file_camera: Annotated[Text | None, Field(description="a file camera (.zfc) instead of a camera")] = None

    @model_validator(mode="after")
    def _which(self) -> ZividSettings:
        if self.serial is None and self.file_camera is None:
            msg = "the camera's serial number is needed, or a file_camera"
            raise ValueError(msg)
        return self


def make_camera(context: DriverContext) -> VendorCamera:
    """The camera of a cell file.

    Raises:
        SettingsError: `settings_file`, or both `serial` and `file_camera`, are missing; an unknown or wrong setting.
    """
    settings = parse_settings(ZividSettings, context.settings, "zivid")
    return VendorCamera("zivid", lambda: ZividSession(settings, context.folder))


class ZividSession:
    """One connection."""

    def __init__(self, settings: ZividSettings, folder: Path) -> None:
        self._settings, self._folder = settings, folder
        self._application: Any = None
        self._camera: Any = None
        self._capture_settings: Any = None

    def connect(self) -> CameraInfo:
        """Connect by serial number and load the capture settings.

        Raises:
            FileError: the settings file cannot be read.
        """
        try:
            import zivid
        except ImportError as error:
            remedy = "Install the Zivid SDK, then pip install 'spherecal[zivid]'."
            raise CameraSdkMissing(f"zivid cannot be loaded ({error})", remedy=remedy) from error
        path = self._folder / self._settings.settings_file
        digest = sha256_hex(read_bytes(path))
        self._capture_settings = zivid.Settings.load(path)
        self._application = zivid.Application()
        try:
            self._camera = self._connected(self._application)
        except RuntimeError as error:
            remedy = "Check cable, power and serial number, and close Zivid Studio."
            raise CameraNotReached(f"the Zivid camera does not connect ({error})", remedy=remedy) from error
        return self._info(zivid, digest)

    def scan(self, timeout_s: float) -> VendorScan:
        """Capture; the SDK has no deadline of its own."""
        del timeout_s  # VendorCamera's thread keeps it
        return frame_scan(self._camera.capture_3d(self._capture_settings), self._camera.state.temperature)

    def disconnect(self) -> None:
        """Give the camera back; the application is left alone, because releasing it ends every other one in the process."""
        if self._camera is not None:
            self._camera.disconnect()
            self._camera = None

    def _connected(self, application: Any) -> Any:
        if self._settings.file_camera is not None:
            return application.create_file_camera(self._folder / self._settings.file_camera)
        return application.connect_camera(serial_number=self._settings.serial)

    def _info(self, zivid: Any, digest: str) -> CameraInfo:
        said, told = self._settings, self._camera.info
        require_serial(str(told.serial_number), said.serial)
        return CameraInfo(
            adapter="zivid",
            vendor="Zivid",
            model=str(told.model_name),
            serial=str(told.serial_number),
            firmware=str(told.firmware_version),
            settings_digest=settings_digest({"settings_file": digest, "preset": said.preset}),
            onboard_correction=said.onboard_correction or infield_correction(zivid, self._camera),
        )


def infield_correction(zivid: Any, camera: Any) -> str | None:
    """Time stamp of the infield correction that the camera applies; None where it has none."""
    calibration: Any = getattr(zivid, "calibration", None)
    if not hasattr(calibration, "has_camera_correction"):
        calibration = zivid.experimental.calibration
    if not calibration.has_camera_correction(camera):
        return None
    return f"infield {calibration.camera_correction_timestamp(camera).isoformat()}"


def frame_scan(frame: Any, temperature: Any) -> VendorScan:
    """A frame of the SDK as a scan: mm, optical frame, holes are NaN; signal to noise as quality."""
    cloud = frame.point_cloud()
    temperatures_c = {name: float(getattr(temperature, name)) for name in _SENSORS if hasattr(temperature, name)}
    return VendorScan(cloud.copy_data("xyz"), cloud.copy_data("snr"), "snr", temperatures_c=temperatures_c)
