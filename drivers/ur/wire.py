"""Framing of RTDE and of the primary interface: bytes in, packages out, and nothing that can hang.

RTDE (UR's "RTDE guide"): big endian, uint16 size with its own 3 header bytes, uint8 type, payload.
Primary interface (UR's "client interfaces"): big endian, int32 size with its own 5 header bytes, uint8 type, payload.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

PROTOCOL_VERSION = 2

REQUEST_PROTOCOL_VERSION = ord("V")
GET_URCONTROL_VERSION = ord("v")
TEXT_MESSAGE = ord("M")
DATA_PACKAGE = ord("U")
SETUP_OUTPUTS = ord("O")
SETUP_INPUTS = ord("I")
START = ord("S")
PAUSE = ord("P")

ROBOT_STATE = 16
ROBOT_MODE_DATA = 0
CARTESIAN_INFO = 4
KINEMATICS_INFO = 5

_LARGEST_PRIMARY = 1 << 20


class WireError(ValueError):
    """Bytes that are no package of the protocol."""


def package(kind: int, payload: bytes = b"") -> bytes:
    """One RTDE package."""
    return struct.pack(">HB", 3 + len(payload), kind) + payload


def primary_package(kind: int, payload: bytes = b"") -> bytes:
    """One message or sub-package of the primary interface."""
    return struct.pack(">iB", 5 + len(payload), kind) + payload


class RtdeStream:
    """Cuts a stream of bytes into RTDE packages, however it was chopped."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Type and payload of every package that is complete now.

        Raises:
            WireError: a size that cannot be; the stream is of no further use.
        """
        self._buffer += data
        while len(self._buffer) >= 3:
            size, kind = struct.unpack_from(">HB", self._buffer)
            if size < 3:
                msg = f"a package of {size} bytes, its header alone has 3"
                raise WireError(msg)
            if len(self._buffer) < size:
                return
            payload = bytes(self._buffer[3:size])
            del self._buffer[:size]
            yield kind, payload


class PrimaryStream:
    """The same for messages of the primary interface."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Type and payload of every message that is complete now.

        Raises:
            WireError: a size that cannot be.
        """
        self._buffer += data
        while len(self._buffer) >= 5:
            size, kind = struct.unpack_from(">iB", self._buffer)
            if not 5 <= size <= _LARGEST_PRIMARY:
                msg = f"a message of {size} bytes"
                raise WireError(msg)
            if len(self._buffer) < size:
                return
            payload = bytes(self._buffer[5:size])
            del self._buffer[:size]
            yield kind, payload


def sub_packages(payload: bytes) -> dict[int, bytes]:
    """Payloads of the sub-packages of one robot state message, by type.

    Raises:
        WireError: sizes that do not add up.
    """
    found: dict[int, bytes] = {}
    at = 0
    while at < len(payload):
        if len(payload) - at < 5:
            msg = "a sub-package is cut off"
            raise WireError(msg)
        size, kind = struct.unpack_from(">iB", payload, at)
        if not 5 <= size <= len(payload) - at:
            msg = f"a sub-package of {size} bytes"
            raise WireError(msg)
        found[kind] = payload[at + 5 : at + size]
        at += size
    return found
