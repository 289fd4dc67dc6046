"""Sockets with a deadline on everything, the name's look-up included."""

from __future__ import annotations

import socket
import time
from dataclasses import dataclass

from drivers.errors import RobotNotReached, RobotTimeout
from drivers.transport import addresses_of

RTDE_PORT, DASHBOARD_PORT, PRIMARY_PORT = 30004, 29999, 30001
_CHUNK = 4096


@dataclass(frozen=True, slots=True)
class Deadline:
    """A moment by which something has to be over."""

    end_s: float

    @classmethod
    def after(cls, seconds: float) -> Deadline:
        """The moment that many seconds from now."""
        return cls(time.monotonic() + seconds)

    @property
    def left_s(self) -> float:
        """Seconds until then, never negative."""
        return max(self.end_s - time.monotonic(), 0.0)

    def within(self, seconds: float) -> Deadline:
        """The sooner of this and that many seconds from now."""
        return Deadline(min(self.end_s, time.monotonic() + seconds))


def address_of(host: str, deadline: Deadline) -> str:
    """The IPv4 address of a name; ur_rtde knows no other.

    Raises:
        RobotNotReached: there is none, or the name server is silent.
    """
    return addresses_of(host, deadline.left_s, socket.AF_INET)[0]


def connect(host: str, port: int, deadline: Deadline) -> socket.socket:
    """A connection.

    Raises:
        RobotNotReached: refused, unreachable, or nobody answered in time.
    """
    try:
        link = socket.create_connection((host, port), max(deadline.left_s, 0.001))
    except TimeoutError as error:
        remedy = "Is the controller on, the cable in, the address right and in this computer's network?"
        raise RobotNotReached("nobody answers", file=f"{host}:{port}", remedy=remedy) from error
    except OSError as error:
        text = error.strerror or str(error)
        raise RobotNotReached(text[:1].lower() + text[1:], file=f"{host}:{port}", remedy=_remedy(port)) from error
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return link


def receive(link: socket.socket, deadline: Deadline) -> bytes:
    """The next bytes.

    Raises:
        RobotTimeout: none came in time.
        RobotNotReached: the other end has closed.
    """
    place = _place(link)
    try:
        link.settimeout(max(deadline.left_s, 0.001))
        data = link.recv(_CHUNK)
    except TimeoutError as error:
        raise RobotTimeout("accepts connections and says nothing", file=place, remedy="Restart the controller; is it still booting?") from error
    except OSError as error:
        raise RobotNotReached(f"cut the connection ({error.strerror})", file=place, remedy="Is the controller restarting?") from error
    if not data:
        raise RobotNotReached("closed the connection", file=place, remedy="Is the controller restarting, or are too many clients connected?")
    return data


def send(link: socket.socket, data: bytes, deadline: Deadline) -> None:
    """Send all bytes.

    Raises:
        RobotTimeout: they were not taken in time.
        RobotNotReached: the other end has closed.
    """
    try:
        link.settimeout(max(deadline.left_s, 0.001))
        link.sendall(data)
    except TimeoutError as error:
        raise RobotTimeout("takes no more bytes", file=_place(link), remedy="Restart the controller.") from error
    except OSError as error:
        raise RobotNotReached(f"cut the connection ({error.strerror})", file=_place(link), remedy="Is the controller restarting?") from error


def _place(link: socket.socket) -> str:
    try:
        host, port = link.getpeername()[:2]
    except OSError:
        return "robot"
    return f"{host}:{port}"


def _remedy(port: int) -> str:
    services = {RTDE_PORT: "RTDE", DASHBOARD_PORT: "the dashboard server", PRIMARY_PORT: "the primary client interface"}
    what = services.get(port, "the port")
    return f"Is this a UR controller that has booted, and is {what} enabled (Settings, Security, Services)?"
