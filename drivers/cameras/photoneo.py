"""Photoneo PhoXi and MotionCam-3D through PhoXi Control and the vendor's phoxi_api. Never run on hardware.

PhoXi Control must be running on this computer. A frame is tied to its trigger by its id. Clouds in a marker's or a robot's
space are refused.
"""

from __future__ import annotations

import time
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from drivers.cameras.frames import settings_digest
from drivers.cameras.settings import CameraSettings, parse_settings
from drivers.cameras.vendor import VendorCamera, VendorScan
from drivers.errors import CameraLost, CameraMisconfigured, CameraNotReached, CameraSdkMissing, CameraTimeout, IncompleteFrame
from drivers.files.schema import Text
from drivers.protocols import CameraInfo
from drivers.registry import DriverContext

_SPACE = "CoordinatesSettings/CoordinateSpace"
_CAMERA_SPACE = "CameraSpace"
_GROUP = "CapturingSettings"
_CONNECT_MS = 20_000


class PhotoneoSettings(CameraSettings):
    """The settings of the driver `photoneo`."""

    serial: Annotated[Text, Field(description="the camera's id in PhoXi Control, e.g. MCL-011")]
    address: Annotated[Text | None, Field(description="the camera's address, where PhoXi Control has not discovered it")] = None
    profile: Annotated[Text | None, Field(description="profile of the camera that is activated first")] = None


def make_camera(context: DriverContext) -> VendorCamera:
    """The camera of a cell file.

    Raises:
        SettingsError: `serial` is missing; an unknown or wrong setting.
    """
    settings = parse_settings(PhotoneoSettings, context.settings, "photoneo")
    return VendorCamera("photoneo", lambda: PhotoneoSession(settings))


class PhotoneoSession:
    """One connection."""

    def __init__(self, settings: PhotoneoSettings) -> None:
        self._settings = settings
        self._api: Any = None
        self._device: Any = None

    def connect(self) -> CameraInfo:
        """Connect by id, set the software trigger, and see that clouds are in camera space."""
        try:
            import phoxi_api
        except ImportError as error:
            raise CameraSdkMissing(f"phoxi-api cannot be loaded ({error})", remedy="pip install 'spherecal[photoneo]'") from error
        self._api = phoxi_api
        try:
            control = phoxi_api.PhoXiControl()
            if not control.is_phoxicontrol_running():
                raise CameraNotReached("PhoXi Control is not running", remedy="Start PhoXi Control on this computer.")
            self._device = control.connect(self._settings.serial, address=self._settings.address, timeout_ms=_CONNECT_MS)
        except phoxi_api.PhoXiError as error:
            raise CameraNotReached(f"the camera {self._settings.serial} does not connect ({error})", remedy="Connect it in PhoXi Control.") from error
        return self._prepared(self._device)

    def scan(self, timeout_s: float) -> VendorScan:
        """Trigger, and the frame with the trigger's id."""
        device, api, end_s = self._device, self._api, time.monotonic() + timeout_s
        try:
            frame_id = device.trigger_frame(wait_accept=False, wait_grabbing_end=False)
            frame = device.get_frame(frame_id, timeout_ms=max(1, int(1000 * (end_s - time.monotonic()))))
        except api.PhoXiTimeoutError as error:
            raise CameraTimeout(f"no frame came within {timeout_s:g} s", remedy="Allow more time; see PhoXi Control's log.") from error
        except api.PhoXiDisconnectedError as error:
            raise CameraLost(f"the camera has gone ({error})", remedy="Connect it in PhoXi Control, and open it anew.") from error
        return frame_scan(frame, frame_id)

    def disconnect(self) -> None:
        """Stop the acquisition and log out."""
        if self._device is not None:
            self._device.disconnect(logout=True, stop_acquisition=True)
            self._device = None

    def _prepared(self, device: Any) -> CameraInfo:
        if device.is_acquiring():
            device.stop_acquisition()
        if self._settings.profile is not None:
            device.set_active_profile(self._settings.profile)
        read, unreadable = device.get_settings([_SPACE, _GROUP])
        check_space(read.get(_SPACE))
        device.set_trigger_mode(self._api.PhoXiDevice.TriggerMode.SOFTWARE)
        device.set_frame_settings({"PointCloud": True, "ConfidenceMap": True})
        device.start_acquisition()
        info = device.info()
        data = {"settings": read, "profile": self._settings.profile, "preset": self._settings.preset}
        blind = (f"the camera does not tell its coordinate space: see that {_CAMERA_SPACE} is set in PhoXi Control",) if _SPACE in unreadable else ()
        return CameraInfo(
            adapter="photoneo",
            vendor="Photoneo",
            model=str(info.get("type", "")) or None,
            serial=self._settings.serial,
            firmware=str(info.get("firmware_version", "")) or None,
            settings_digest=settings_digest(data),
            onboard_correction=self._settings.onboard_correction,
            notes=blind,
        )


def check_space(space: object) -> None:
    """Nothing, for clouds in the camera's own frame, or where the camera does not tell.

    Raises:
        CameraMisconfigured: clouds in a marker's, a robot's or a custom space.
    """
    if space is not None and str(space) != _CAMERA_SPACE:
        remedy = f"Set the coordinate space to {_CAMERA_SPACE} in PhoXi Control."
        raise CameraMisconfigured(f"a transform is active: clouds are in {space}", remedy=remedy)


def frame_scan(frame: Any, frame_id: int) -> VendorScan:
    """A frame of the library as a scan; holes are (0, 0, 0).

    Raises:
        IncompleteFrame: the camera says that the frame did not succeed, or gave no cloud.
    """
    messages = [str(message.get("text", "")) for message in frame.Messages or [] if int(message.get("severity", 0)) > 0]
    if not frame.Successful or frame.PointCloud is None:
        raise IncompleteFrame(f"frame {frame_id} did not succeed ({'; '.join(messages) or 'no reason told'})", remedy="See PhoXi Control's log.")
    diagnostics: dict[str, float | int | str] = {"frame_id": frame_id}
    if messages:
        diagnostics["messages"] = "; ".join(messages)
    confidence = None if frame.ConfidenceMap is None else np.asarray(frame.ConfidenceMap)
    return VendorScan(frame.PointCloud, confidence, None if confidence is None else "confidence", diagnostics=diagnostics)
