"""The GenICam adapter: settings, checks, trigger and freshness; the transport moves bytes, the decoder makes points."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import asdict

from drivers.cameras.frames import require_plausible, require_serial, settings_digest
from drivers.cameras.genicam.decode import decode
from drivers.cameras.genicam.scan3d import Scan3d, device_temperatures_c, problems, read_scan3d
from drivers.cameras.genicam.settings import GenicamSettings
from drivers.cameras.genicam.transport import DeviceIdentity, Payload, Transport
from drivers.cameras.points import parse_axes
from drivers.errors import CameraLost, CameraMisconfigured, CameraNotReached, CameraTimeout, IncompleteFrame, StaleFrame
from drivers.protocols import CameraHealth, CameraInfo, Frame3D

_COMPONENTS = ("Range", "Confidence", "Intensity")


class GenicamCamera:
    """A camera behind a transport. Satisfies `drivers.protocols.Camera3D`.

    Args:
        transport: not opened.
        settings: what is set, and how a frame is triggered.
    """

    def __init__(self, transport: Transport, settings: GenicamSettings) -> None:
        self._transport, self._settings = transport, settings
        self._axes = parse_axes(settings.axes)
        self._scan3d = Scan3d()
        self._opened = self._streaming = False
        self._sequence = 0
        self._last_id: int | None = None
        self._lost: str | None = None

    def open(self) -> CameraInfo:
        """Connect, load and set everything, and read back what the coordinates mean.

        Raises:
            CameraNotReached: nobody answers, or (CameraBusy) another client controls it.
            CameraMisconfigured: another serial number, a feature that is not taken, a transform that is active, a unit or an
                output mode that cannot be used.
            CameraSdkMissing: the transport's library is not installed.
        """
        self.close()
        who = self._transport.open()
        try:
            require_serial(who.serial, self._settings.serial)
            self._apply()
            self._scan3d = read_scan3d(self._transport.get, self._put_selector)
            self._check()
            info = self._info(who)
        except BaseException:
            self._transport.close()
            raise
        self._opened = True
        return info

    def capture(self, *, timeout_s: float) -> Frame3D:
        """Trigger, and the frame that follows.

        After any failure the stream is built anew: a frame of an earlier trigger then has nowhere to arrive.

        Raises:
            CameraNotReached: not open; CameraLost: the camera does not answer any more (within 3 s, whatever `timeout_s`).
            CameraTimeout: no frame came in time.
            IncompleteFrame: packets are missing.
            StaleFrame: the frame before came again.
            CameraMisconfigured: the frame holds no coordinates, or they are implausible.
        """
        if self._lost is not None:
            raise CameraLost(self._lost, remedy="Open the camera anew: its settings may be gone.")
        if not self._opened:
            raise CameraNotReached("the camera is not open", remedy="Open it first.")
        try:
            return self._capture(timeout_s)
        except CameraLost as error:
            self._lost = error.message
            self._end_stream()
            raise
        except BaseException:
            self._end_stream()
            raise

    def health(self) -> CameraHealth:
        """Its temperature, where it has the feature DeviceTemperature, and the counters of the stream.

        Raises:
            CameraNotReached: not open, or (CameraLost) it does not answer any more.
        """
        if self._lost is not None or not self._opened:
            raise CameraNotReached(self._lost or "the camera is not open", remedy="Open it first.")
        return CameraHealth(device_temperatures_c(self._transport.get), dict(self._transport.statistics()))

    def close(self) -> None:
        """End the stream and give the camera back."""
        self._end_stream()
        self._opened, self._lost = False, None
        self._transport.close()

    def _apply(self) -> None:
        transport, said = self._transport, self._settings
        if said.user_set is not None:
            transport.put("UserSetSelector", said.user_set)
            transport.execute("UserSetLoad")
        for name, value in said.features.items():
            transport.put(name, str(value).lower() if isinstance(value, bool) else str(value))
        self._enable_components()
        if said.pixel_format is not None:
            transport.put("PixelFormat", said.pixel_format)
        if said.trigger == "software":
            transport.put("TriggerMode", "On")
            transport.put("TriggerSource", "Software")

    def _enable_components(self) -> None:
        if self._transport.get("ComponentSelector") is None:
            return
        for name in reversed(_COMPONENTS):  # Range stays selected
            try:
                self._transport.put("ComponentSelector", name)
                self._transport.put("ComponentEnable", "true")
            except CameraMisconfigured:
                if name == "Range":
                    raise

    def _put_selector(self, name: str, value: str) -> None:
        with suppress(CameraMisconfigured):
            self._transport.put(name, value)

    def _check(self) -> None:
        found = problems(self._scan3d)
        if found:
            said, _, remedy = found[0].partition(". ")
            raise CameraMisconfigured(f"the camera cannot be used as it is set: {said}", remedy=remedy)

    def _info(self, who: DeviceIdentity) -> CameraInfo:
        said = self._settings
        data = {
            "scan3d": asdict(self._scan3d),
            "axes": self._axes.tolist(),
            "features": dict(said.features),
            "user_set": said.user_set,
            "pixel_format": self._transport.get("PixelFormat"),
            "preset": said.preset,
        }
        return CameraInfo(
            adapter="genicam",
            model=who.model or said.model,
            serial=who.serial,
            firmware=who.firmware,
            settings_digest=settings_digest(data),
            onboard_correction=said.onboard_correction,
            vendor=who.vendor,
            sdk_version=who.library,
            notes=who.notes,
        )

    def _capture(self, timeout_s: float) -> Frame3D:
        end_s = time.monotonic() + timeout_s
        triggered_s = self._trigger()
        payload = self._transport.fetch(max(0.0, end_s - time.monotonic()))
        done_s = time.monotonic()
        if payload is None:
            raise self._too_late(timeout_s)
        self._check_payload(payload)
        frame = self._frame(payload, triggered_s, done_s)
        if self._settings.trigger == "start":
            self._end_stream()
        return frame

    def _trigger(self) -> float:
        """Begin an exposure; the time at which it could begin at the earliest."""
        if self._settings.trigger == "start":
            triggered_s = time.monotonic()
            self._begin_stream()
            return triggered_s
        self._begin_stream()
        self._transport.drain()
        triggered_s = time.monotonic()
        self._transport.execute("TriggerSoftware")
        return triggered_s

    def _begin_stream(self) -> None:
        if not self._streaming:
            self._streaming, self._last_id = True, None
            self._transport.start()

    def _end_stream(self) -> None:
        if self._streaming:
            self._streaming = False
            self._transport.stop()

    def _counted(self) -> str:
        counts = ", ".join(f"{name} {value}" for name, value in self._transport.statistics().items())
        return f" ({counts})" if counts else ""

    def _too_late(self, timeout_s: float) -> CameraTimeout:
        counts = self._transport.statistics()
        remedy = "Allow more time; check trigger, exposure and, for GigE Vision, firewall and packet size."
        if counts.get("packets_ignored"):
            remedy = "Packets came that belong to no frame: let no other program use the camera or this port, and try again."
        return CameraTimeout(f"no frame came within {timeout_s:g} s of the {self._settings.trigger} trigger{self._counted()}", remedy=remedy)

    def _check_payload(self, payload: Payload) -> None:
        if payload.fault is not None:
            remedy = "Raise packet_delay_ns, use jumbo frames on every switch between, and raise the socket buffer (net.core.rmem_max)."
            raise IncompleteFrame(f"frame {payload.frame_id} {payload.fault}{self._counted()}", remedy=remedy)
        if payload.frame_id == self._last_id:
            raise StaleFrame(f"frame {payload.frame_id} came again", remedy="Use triggered exposures only.")

    def _frame(self, payload: Payload, triggered_s: float, done_s: float) -> Frame3D:
        decoded = decode(payload.parts, self._scan3d, self._axes)
        require_plausible(decoded.xyz_mm, "the camera's frame")
        self._last_id = payload.frame_id
        self._sequence += 1
        return Frame3D(
            xyz_mm=decoded.xyz_mm,
            sequence=self._sequence,
            time_s=triggered_s,
            temperatures_c=device_temperatures_c(self._transport.get),
            intensity=decoded.intensity,
            quality=decoded.confidence,
            quality_kind=None if decoded.confidence is None else "confidence",
            done_s=done_s,
            device_time_ns=payload.timestamp_ns,
            diagnostics={"frame_id": payload.frame_id, **self._transport.statistics()},
        )
