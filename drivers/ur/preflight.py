"""Is there an RTDE controller that talks? Asked in pure Python, before any constructor of ur_rtde.

The constructors hold Python's global lock while they wait, two minutes for an unplugged robot (facts: measured).
"""

from __future__ import annotations

import socket
import struct
from contextlib import closing
from dataclasses import dataclass

from drivers.errors import RobotTimeout, WrongController
from drivers.ur import wire
from drivers.ur.net import RTDE_PORT, Deadline, connect, receive, send

REPLY_S = 1.0
_MOST_PACKAGES = 100


@dataclass(frozen=True, slots=True)
class Version:
    """Version of the controller's software."""

    major: int
    minor: int
    bugfix: int
    build: int

    def __str__(self) -> str:
        """E.g. 5.11.1."""
        return f"{self.major}.{self.minor}.{self.bugfix}"


def preflight(host: str, deadline: Deadline, *, port: int = RTDE_PORT) -> Version:
    """Shake hands with an RTDE controller and hang up again.

    Raises:
        RobotNotReached: nobody is there, or it hangs up.
        RobotTimeout: it accepts and says nothing.
        WrongController: it says something that is no RTDE of version 2.
    """
    with closing(connect(host, port, deadline)) as link:
        place, replies = f"{host}:{port}", deadline.within(REPLY_S)
        stream = wire.RtdeStream()
        try:
            accepted = _asked(link, stream, wire.REQUEST_PROTOCOL_VERSION, struct.pack(">H", wire.PROTOCOL_VERSION), replies)
            if accepted != b"\x01":
                raise WrongController("refuses version 2 of RTDE", file=place, remedy="Update the controller: PolyScope 3.3 or later.")
            numbers = _asked(link, stream, wire.GET_URCONTROL_VERSION, b"", replies)
            return Version(*struct.unpack(">4I", numbers))
        except (wire.WireError, struct.error) as error:
            remedy = "Is this the address of a UR controller?"
            raise WrongController(f"what answers does not speak RTDE ({error})", file=place, remedy=remedy) from error


def _asked(link: socket.socket, stream: wire.RtdeStream, kind: int, payload: bytes, deadline: Deadline) -> bytes:
    send(link, wire.package(kind, payload), deadline)
    data = b""  # what came with the answer before
    for _ in range(_MOST_PACKAGES):
        for found, content in stream.feed(data):
            if found == kind:
                return content
            if found != wire.TEXT_MESSAGE:
                msg = f"package type {found} instead of {kind}"
                raise wire.WireError(msg)
        data = receive(link, deadline)
    raise RobotTimeout("sends much and answers nothing", remedy="Is this the address of a UR controller?")
