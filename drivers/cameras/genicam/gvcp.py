"""One question of the GigE Vision control protocol: a register of the camera at an address (GigE Vision 2.0, 16.3).

Asked before Aravis connects, because Aravis needs 2.5 s to say that nobody answers or that another client has control.
"""

from __future__ import annotations

import socket
import struct

from drivers.errors import CameraNotReached

PORT = 3956
CONTROL = 0x0A00
"""Control Channel Privilege: not 0 while an application controls the camera."""
_READ, _READ_ANSWER = 0x0080, 0x0081
_TRIES, _WAIT_S = 3, 0.4


def read_register(address: str, register: int) -> int:
    """The value of a register, within 1.2 s; one datagram to this one address a try.

    Raises:
        CameraNotReached: nobody answers, or somebody does who speaks another protocol.
    """
    why = "nobody answers"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
        channel.settimeout(_WAIT_S)
        for number in range(1, _TRIES + 1):
            try:
                channel.connect((address, PORT))
                channel.send(struct.pack(">BBHHHI", 0x42, 1, _READ, 4, number, register))
                value = _value(channel.recv(1024), number)
            except TimeoutError:
                continue
            except OSError as error:
                why = error.strerror or str(error)
                break
            if value is not None:
                return value
            why = "what answers is no GigE Vision camera"
    remedy = "Check cable, power and address; see that the camera answers `ping`."
    raise CameraNotReached(f"no GigE Vision camera at {address}: {why}", where="camera.address", remedy=remedy)


def _value(answer: bytes, number: int) -> int | None:
    if len(answer) < 12:
        return None
    status, command, _, answered, value = struct.unpack(">HHHHI", answer[:12])
    return int(value) if (status, command, answered) == (0, _READ_ANSWER, number) else None
