"""GigE Vision through the library Aravis, by explicit address: nothing is ever sent to anybody else."""

from __future__ import annotations

import ctypes
import socket
import threading
from collections.abc import Mapping
from contextlib import suppress
from ctypes import byref, c_int, c_size_t, c_uint64
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

import numpy as np

from drivers.cameras.genicam import gvcp
from drivers.cameras.genicam.aravis_library import NOT_CONTROLLER, TRANSPORT_CODES, AravisError, AravisLibrary, load
from drivers.cameras.genicam.decode import Part
from drivers.cameras.genicam.pfnc import name_of
from drivers.cameras.genicam.receive_buffer import make_room
from drivers.cameras.genicam.transport import DeviceIdentity, Payload
from drivers.errors import CameraBusy, CameraError, CameraLost, CameraMisconfigured, CameraNotReached

_N_BUFFERS = 4
_SUCCESS = 0
_RMEM_MAX = Path("/proc/sys/net/core/rmem_max")
_WANTED_BUFFER = 8 * 1024 * 1024
_STATUS = {1: "is empty", 2: "lacks packets", 3: "lacks packets", 4: "has packets out of order", 5: "does not fit its buffer", 7: "was aborted"}
_ROOM = 2
"""Of the payload: the kernel counts a packet of 1400 bytes as 2304."""
_COUNTERS = (b"n_received_packets", b"n_ignored_packets")
_NO_PACKET_SOCKET = 1
"""ARV_GV_STREAM_OPTION_PACKET_SOCKET_DISABLED."""
_REMEDY = "Check cable, power and address; see that the camera answers `ping`."


class AravisTransport:
    """One GigE Vision camera. Satisfies `drivers.cameras.genicam.transport.Transport`.

    Args:
        address: IPv4 address of the camera.
        packet_size: bytes of a stream packet, None for the camera's own.
        packet_delay_ns: pause between packets, None for the camera's own.
    """

    def __init__(self, address: str, *, packet_size: int | None = None, packet_delay_ns: int | None = None) -> None:
        self._address, self._packet_size, self._packet_delay_ns = address, packet_size, packet_delay_ns
        self._library: AravisLibrary | None = None
        self._device: int | None = None
        self._camera: int | None = None
        self._stream: int | None = None
        self._lost = False

    def open(self) -> DeviceIdentity:
        """Connect and take control."""
        library = self._library = load()
        interface = local_address(self._address)
        if gvcp.read_register(self._address, gvcp.CONTROL):
            raise self._busy()
        self._lost = False
        self._device = self._connect(library, interface)
        try:
            if not library.call("arv_gv_device_is_controller", self._device):
                self._lost = True  # whoever has no control cannot give it back
                raise self._busy()
            # For root Aravis would read a packet socket, which takes whatever passes on the computer until its filter is set;
            # the first of these packets then decides which frame numbers count as late, and all of ours may be thrown away.
            library.call("arv_gv_device_set_stream_options", self._device, _NO_PACKET_SOCKET)
            self._camera = self._ask("arv_camera_new_with_device", self._device)
            self._set_packets()
            names = ("DeviceVendorName", "DeviceModelName", "DeviceFirmwareVersion")
            vendor, model, firmware = (self.get(name) for name in names)
            serial = self.get("DeviceSerialNumber") or self.get("DeviceID")
        except BaseException:
            self.close()
            raise
        version = firmware or self.get("DeviceVersion")
        return DeviceIdentity(vendor, model, serial, version, f"Aravis {library.version}", network_notes(_RMEM_MAX))

    def get(self, feature: str) -> str | None:
        """The value of a feature as text."""
        node = self._node(feature)
        if node is None:
            return None
        try:
            value = self._call("arv_gc_feature_node_get_value_as_string", node)
        except AravisError as error:
            self._raise_if_lost(error)
            return None
        return None if value is None else str(value.decode("utf-8", errors="replace"))

    def put(self, feature: str, value: str) -> None:
        """Set a feature."""
        node = self._node(feature)
        if node is None:
            raise CameraMisconfigured(f"the camera has no feature {feature}", remedy="Look the feature up in the camera's manual.")
        try:
            self._call("arv_gc_feature_node_set_value_from_string", node, value.encode())
        except AravisError as error:
            self._raise_if_lost(error)
            raise CameraMisconfigured(f"{feature} does not take {value!r} ({error})", remedy="Look the feature up in the camera's manual.") from error

    def execute(self, command: str) -> None:
        """Run a command feature."""
        self._ask("arv_device_execute_command", self._device, command.encode())

    def start(self) -> None:
        """A new stream at a new port, its buffers, and the camera sends."""
        size = self._ask("arv_camera_get_payload", self._camera)
        self._stream = self._ask("arv_device_create_stream", self._device, None, None)
        make_room(self._call("arv_gv_stream_get_port", self._stream), _ROOM * size)
        for _ in range(_N_BUFFERS):
            self._call("arv_stream_push_buffer", self._stream, self._call("arv_buffer_new_allocate", size))
        self._ask("arv_camera_start_acquisition", self._camera)

    def stop(self) -> None:
        """End the stream; late packets then go to a port that nobody listens to."""
        if self._stream is None:
            return
        if not self._lost:
            with suppress(AravisError, CameraError):
                self._ask("arv_camera_stop_acquisition", self._camera)
        self._forget(self._stream)
        self._stream = None

    def _forget(self, *handles: int | None) -> None:
        """Let go of objects. Those of a lost camera still try to tell it, for seconds: a thread of their own waits for that."""
        library = self._library
        if library is None:
            return

        def let_go() -> None:
            for handle in handles:
                if handle is not None:
                    library.call("g_object_unref", handle)

        if self._lost:
            threading.Thread(target=let_go, name="aravis-lost-camera", daemon=True).start()
        else:
            let_go()

    def drain(self) -> int:
        """Give every frame in the queue back to the stream."""
        count = 0
        while self._stream is not None and (buffer := self._call("arv_stream_try_pop_buffer", self._stream)):
            self._call("arv_stream_push_buffer", self._stream, buffer)
            count += 1
        return count

    def fetch(self, timeout_s: float) -> Payload | None:
        """The next frame, copied before its buffer goes back."""
        if self._stream is None:
            return None
        buffer = self._call("arv_stream_timeout_pop_buffer", self._stream, max(1, int(timeout_s * 1e6)))
        if not buffer:
            return None
        try:
            return self._payload(buffer)
        finally:
            self._call("arv_stream_push_buffer", self._stream, buffer)

    def statistics(self) -> Mapping[str, float | int | str]:
        """Frames and packets of the stream since it began."""
        if self._stream is None:
            return {}
        resent, missing = c_uint64(), c_uint64()
        completed, failures, underruns = c_uint64(), c_uint64(), c_uint64()
        self._call("arv_gv_stream_get_statistics", self._stream, byref(resent), byref(missing))
        self._call("arv_stream_get_statistics", self._stream, byref(completed), byref(failures), byref(underruns))
        received, ignored = (self._call("arv_stream_get_info_uint64_by_name", self._stream, name) for name in _COUNTERS)
        return {
            "packet_size": int(self._ask("arv_gv_device_get_packet_size", self._device)),
            "packets_received": received,
            "packets_ignored": ignored,
            "packets_resent": resent.value,
            "packets_missing": missing.value,
            "frames_failed": failures.value,
            "frames_dropped": underruns.value,
        }

    def close(self) -> None:
        """Give up control."""
        self.stop()
        self._forget(self._camera, self._device)
        self._camera = self._device = None

    def _busy(self) -> CameraBusy:
        return CameraBusy(f"another client controls the camera at {self._address}", remedy="Close the vendor's viewer, or whatever holds it.")

    def _connect(self, library: AravisLibrary, interface: str) -> int:
        addresses = [library.call("g_inet_address_new_from_string", text.encode()) for text in (interface, self._address)]
        try:
            return int(library.call("arv_gv_device_new", *addresses))
        except AravisError as error:
            raise CameraNotReached(f"no GigE Vision camera answers at {self._address} ({error})", remedy=_REMEDY) from error
        finally:
            for address in addresses:
                library.call("g_object_unref", address)

    def _set_packets(self) -> None:
        if self._packet_size is not None:
            self._ask("arv_gv_device_set_packet_size", self._device, self._packet_size)
        if self._packet_delay_ns is not None:
            self._ask("arv_camera_gv_set_packet_delay", self._camera, self._packet_delay_ns)

    def _payload(self, buffer: int) -> Payload:
        status = self._call("arv_buffer_get_status", buffer)
        frame_id, timestamp_ns = self._call("arv_buffer_get_frame_id", buffer), self._call("arv_buffer_get_timestamp", buffer)
        if status != _SUCCESS:
            return Payload((), frame_id, timestamp_ns, _STATUS.get(status, f"has the status {status}"))
        n_parts = self._call("arv_buffer_get_n_parts", buffer)
        return Payload(tuple(self._part(buffer, i) for i in range(n_parts)), frame_id, timestamp_ns, None)

    def _part(self, buffer: int, index: int) -> Part:
        size, across, down = c_size_t(), c_int(), c_int()
        data = self._call("arv_buffer_get_part_data", buffer, index, byref(size))
        self._call("arv_buffer_get_part_padding", buffer, index, byref(across), byref(down))
        copied = np.zeros(size.value, dtype=np.uint8)
        ctypes.memmove(copied.ctypes.data, data, size.value)
        return Part(
            name_of(self._call("arv_buffer_get_part_pixel_format", buffer, index)),
            self._call("arv_buffer_get_part_width", buffer, index),
            self._call("arv_buffer_get_part_height", buffer, index),
            copied,
            across.value,
        )

    def _node(self, feature: str) -> int | None:
        if not self._ask("arv_device_is_feature_available", self._device, feature.encode()):
            return None
        node = self._call("arv_device_get_feature", self._device, feature.encode())
        return None if node is None else int(node)

    def _call(self, name: str, *arguments: object) -> Any:
        if self._library is None or (arguments and arguments[0] is None):
            raise CameraNotReached(f"the camera at {self._address} is not open", remedy="Open it first.")
        return self._library.call(name, *arguments)

    def _ask(self, name: str, *arguments: object) -> Any:
        """Call what reaches the camera; a failure that is none of the way to it is one of its settings."""
        try:
            return self._call(name, *arguments)
        except AravisError as error:
            self._raise_if_lost(error)
            raise CameraMisconfigured(f"the camera at {self._address} refuses ({error})", remedy="Load its factory settings.") from error

    def _raise_if_lost(self, error: AravisError) -> None:
        if error.code in TRANSPORT_CODES:
            self._lost = True
            raise CameraLost(f"the camera at {self._address} does not answer any more ({error})", remedy=_REMEDY) from error
        if error.code == NOT_CONTROLLER:
            self._lost = True
            remedy = "Close the other client, and open the camera anew."
            raise CameraLost(f"control over the camera at {self._address} is lost", remedy=remedy) from error


def network_notes(rmem_max: Path) -> tuple[str, ...]:
    """What a Linux computer's network settings hold against large frames.

    Args:
        rmem_max: the kernel's file of the largest socket buffer; other systems have none.
    """
    try:
        size = int(rmem_max.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return ()
    if size >= _WANTED_BUFFER:
        return ()
    return (f"socket buffers may be {size // 1024} KiB at most, so packets may be lost: sysctl -w net.core.rmem_max={_WANTED_BUFFER}",)


def local_address(address: str) -> str:
    """The address of this computer on the way to a camera, as the routing table tells; nothing is sent.

    Raises:
        CameraMisconfigured: `address` is no IPv4 address of one device.
        CameraNotReached: there is no way to it.
    """
    try:
        parsed = IPv4Address(address)
    except ValueError as error:
        raise CameraMisconfigured(f"{address!r} is no IPv4 address", where="camera.address", remedy="Give it as in 192.168.0.20.") from error
    if parsed.is_multicast or parsed.is_unspecified or address.endswith(".255"):
        raise CameraMisconfigured(f"{address} is not the address of one camera", where="camera.address", remedy="Give the camera's own address.")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((address, gvcp.PORT))
        except OSError as error:
            raise CameraNotReached(f"there is no way to {address} ({error.strerror})", remedy="Check this computer's network settings.") from error
        return str(probe.getsockname()[0])
