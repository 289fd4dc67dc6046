"""Any GenTL producer (USB3 Vision, GigE Vision, CoaXPress, vendors' own) through the library harvesters.

A producer finds its cameras by enumerating its interfaces, and one for GigE Vision broadcasts on the network to do so.
That is refused unless the cell file allows it: `address` (Aravis) needs no enumeration.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from drivers.cameras.genicam.decode import Part
from drivers.cameras.genicam.transport import DeviceIdentity, Payload
from drivers.errors import CameraBusy, CameraLost, CameraMisconfigured, CameraNotReached, CameraSdkMissing

_UPDATE_MS = 2000
_BROADCASTS = "GEV"
# The library's exceptions have no common base, and an absent feature raises as well: hence `except Exception` here.
_READABLE = "Look the feature up in the camera's manual."


class GentlTransport:
    """One camera of a producer. Satisfies `drivers.cameras.genicam.transport.Transport`.

    Args:
        producer: the producer's file, NAME.cti.
        serial: of the camera.
        may_broadcast: whether a GigE Vision producer may enumerate.
    """

    def __init__(self, producer: Path, serial: str, *, may_broadcast: bool = False) -> None:
        self._producer, self._serial, self._may_broadcast = producer, serial, may_broadcast
        self._harvester: Any = None
        self._acquirer: Any = None
        self._nodes: Any = None

    def open(self) -> DeviceIdentity:
        """Load the producer and create the one camera with the serial number."""
        try:
            from genicam import gentl
            from harvesters.core import Harvester
        except ImportError as error:
            raise CameraSdkMissing(f"harvesters cannot be loaded ({error})", remedy="pip install 'spherecal[genicam]'") from error
        if not self._producer.is_file():
            remedy = "Install the camera maker's producer and name its .cti file."
            raise CameraNotReached("no such GenTL producer", file=self._producer, remedy=remedy)
        try:
            self._check_interfaces(gentl)
            self._harvester = Harvester()
            self._harvester.add_file(str(self._producer), check_existence=True, check_validity=True)
            self._harvester.update()
            return self._create(gentl)
        except BaseException:
            self.close()
            raise

    def get(self, feature: str) -> str | None:
        """The value of a feature as text; floats with all their digits."""
        try:
            value = self._nodes.get_node(feature).value if self._nodes is not None else None
        except Exception:
            return None
        return None if value is None else str(value)

    def put(self, feature: str, value: str) -> None:
        """Set a feature."""
        node = self._feature(feature)
        try:
            node.from_string(value)
        except Exception as error:
            if self.get(feature) == value or (self.get(feature) or "").lower() == value.lower():
                return  # a constant that is right, e.g. a component that is always on
            raise CameraMisconfigured(f"{feature} does not take {value!r} ({error})", remedy=_READABLE) from error

    def execute(self, command: str) -> None:
        """Run a command feature."""
        node = self._feature(command)
        try:
            node.execute()
        except Exception as error:
            raise CameraLost(f"{command} fails ({error})", remedy="Check cable and power, and open the camera anew.") from error

    def start(self) -> None:
        """Let the camera send."""
        try:
            self._acquirer.start()
        except Exception as error:
            raise CameraLost(f"the acquisition does not start ({error})", remedy="Check cable and power, and open the camera anew.") from error

    def stop(self) -> None:
        """End the stream and forget its frames."""
        if self._acquirer is not None:
            with suppress(Exception):
                self._acquirer.stop()

    def drain(self) -> int:
        """Give every filled buffer back."""
        count = 0
        while self._acquirer.num_holding_filled_buffers or count == 0:
            buffer = self._acquirer.try_fetch(timeout=0.001)
            if buffer is None:
                break
            buffer.queue()
            count += 1
        return count

    def fetch(self, timeout_s: float) -> Payload | None:
        """The next frame, copied before its buffer goes back."""
        end_s = time.monotonic() + timeout_s
        buffer = self._acquirer.try_fetch(timeout=max(timeout_s, 0.001))
        if buffer is None:
            # the library returns early, and with nothing, where a frame was not complete
            return Payload((), -1, None, "lacks packets") if time.monotonic() < end_s - 0.005 else None
        try:
            parts = tuple(_part(component) for component in buffer.payload.components)
            return Payload(parts, int(buffer.module.frame_id), _timestamp(buffer), None)
        finally:
            buffer.queue()

    def statistics(self) -> Mapping[str, float | int | str]:
        """Frames since the camera was opened."""
        return {} if self._acquirer is None else {"frames": int(self._acquirer.statistics.num_images)}

    def close(self) -> None:
        """Destroy the camera and unload the producer."""
        if self._acquirer is not None:
            with suppress(Exception):
                self._acquirer.destroy()
        if self._harvester is not None:
            with suppress(Exception):
                self._harvester.reset()
        self._acquirer = self._harvester = self._nodes = None

    def _check_interfaces(self, gentl: Any) -> None:
        """Refuse a producer that would broadcast, before its interfaces are asked for devices."""
        producer = gentl.GenTLProducer.create_producer()
        producer.open(str(self._producer))
        system = producer.create_system()
        system.open()
        system.update_interface_info_list(_UPDATE_MS)
        kinds = {str(interface.tl_type) for interface in system.interface_info_list}
        system.close()
        producer.close()
        if _BROADCASTS in kinds and not self._may_broadcast:
            remedy = "Name the camera by `address` (Aravis), or allow it by `producer_may_broadcast: true`."
            raise CameraMisconfigured("this producer looks for cameras by broadcast on the network", file=self._producer, remedy=remedy)

    def _create(self, gentl: Any) -> DeviceIdentity:
        known = {str(device.serial_number): device for device in self._harvester.device_info_list}
        device = known.get(self._serial)
        if device is None:
            remedy = f"Serial numbers that it knows: {', '.join(known) or 'none'}."
            raise CameraNotReached(f"the producer knows no camera with the serial number {self._serial}", file=self._producer, remedy=remedy)
        try:
            with _interrupts_kept():
                self._acquirer = self._harvester.create({"serial_number": self._serial})
        except gentl.GenericException as error:
            if "ACCESS_DENIED" in str(error).upper() or "IN_USE" in str(error).upper():
                remedy = "Close the vendor's viewer, or whatever holds it."
                raise CameraBusy(f"another client holds the camera {self._serial} ({error})", remedy=remedy) from error
            raise CameraNotReached(f"the camera {self._serial} cannot be opened ({error})", remedy="Check cable and power.") from error
        self._nodes = self._acquirer.remote_device.node_map
        library = f"harvesters with {self._producer.name}"
        return DeviceIdentity(device.vendor, device.model, str(device.serial_number), self.get("DeviceFirmwareVersion"), library)

    def _feature(self, name: str) -> Any:
        node = None
        if self._nodes is not None:
            with suppress(Exception):
                node = self._nodes.get_node(name)
        if node is None:
            raise CameraMisconfigured(f"the camera has no feature {name}", remedy=_READABLE)
        return node


def _part(component: Any) -> Part:
    data = np.array(component.data, copy=True).reshape(-1).view(np.uint8)
    # the library hands out elements without a row's padding only where there is none
    return Part(str(component.data_format), int(component.width), int(component.height), data, int(component.x_padding or 0))


@contextmanager
def _interrupts_kept() -> Iterator[None]:
    """The library takes Ctrl-C for itself and never gives it back; it is the run's, which stops the robot by it."""
    former = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, former)


def _timestamp(buffer: Any) -> int | None:
    try:
        return int(buffer.timestamp_ns)
    except Exception:
        return None
