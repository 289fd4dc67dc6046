"""Bytes to and from a controller over TCP or a serial port, with a deadline on everything.

TCP is our own: pyserial's `socket://` waits 5 s for a connection, sleeps 0.3 s in `close` and cannot be told otherwise.
A serial port is pyserial's. Both give the same three errors: RobotNotReached while opening, LinkLost when the other end
has gone, RobotTimeout when it takes no more bytes. Neither ever opens again by itself.
"""

from __future__ import annotations

import queue
import select
import socket
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from drivers.errors import LinkLost, RobotError, RobotNotReached, RobotTimeout

if TYPE_CHECKING:
    from serial import Serial

_CHUNK = 4096
_WIRE = "Is it switched on, is the cable in, and is the address right?"
_PROGRAM = "Look at the controller: did its program stop or restart? Then continue with --resume."


def addresses_of(host: str, timeout_s: float, family: socket.AddressFamily = socket.AF_UNSPEC) -> list[str]:
    """The numeric addresses of a name, in the system's order; its resolver knows no deadline, so it runs in a thread of its own.

    Raises:
        RobotNotReached: there is none, or the name server is silent.
    """
    found: queue.SimpleQueue[list[str] | OSError] = queue.SimpleQueue()

    def look_up() -> None:
        try:
            known = socket.getaddrinfo(host, None, family, socket.SOCK_STREAM)
            found.put(list(dict.fromkeys(str(address[0]) for *_, address in known)))
        except (OSError, UnicodeError) as error:
            found.put(error if isinstance(error, OSError) else OSError(str(error)))

    threading.Thread(target=look_up, name="look-up", daemon=True).start()
    try:
        result = found.get(timeout=max(timeout_s, 0.0))
    except queue.Empty:
        result = OSError("the name server does not answer")
    if isinstance(result, OSError):
        what = "IPv4" if family is socket.AF_INET else "IP"
        raise RobotNotReached(f"{host!r} has no address: {result}", where="robot.host", remedy=f"Write the robot's {what} address.") from result
    return result


class Link(Protocol):
    """A way for bytes; one thread owns it."""

    @property
    def name(self) -> str:
        """What a person calls the other end, e.g. `192.168.125.1:5000`."""
        ...

    def open(self, timeout_s: float) -> None:
        """Connect. Raises RobotNotReached or RobotTimeout within `timeout_s`."""
        ...

    def write(self, data: bytes, timeout_s: float) -> None:
        """Send all of it. Raises LinkLost or RobotTimeout."""
        ...

    def read(self, timeout_s: float) -> bytes:
        """What has come, at once if there is any; empty after `timeout_s`. Raises LinkLost."""
        ...

    def close(self) -> None:
        """Let go; safe to call twice."""
        ...


@dataclass(slots=True)
class TcpLink:
    """A TCP connection."""

    host: str
    port: int
    _socket: socket.socket | None = field(default=None, init=False, repr=False)

    @property
    def name(self) -> str:
        """host:port."""
        return f"{self.host}:{self.port}"

    def open(self, timeout_s: float) -> None:
        """Connect; the addresses of a name share the time.

        Raises:
            RobotTimeout: nobody answers in time, as from a black hole.
            RobotNotReached: refused, or no such host.
        """
        self.close()
        end_s = time.monotonic() + timeout_s
        addresses = addresses_of(self.host, timeout_s)
        for i, address in enumerate(addresses, start=1):
            try:
                self._socket = self._connected(address, (end_s - time.monotonic()) / (len(addresses) + 1 - i))
            except RobotError:
                if i == len(addresses):
                    raise
            else:
                return

    def _connected(self, address: str, seconds: float) -> socket.socket:
        try:
            connection = socket.create_connection((address, self.port), timeout=max(seconds, 0.001))
        except TimeoutError as error:
            raise RobotTimeout(f"nothing answers within {seconds:.1f} s", where=self.name, remedy=_WIRE) from error
        except ConnectionRefusedError as error:
            remedy = "Is the program running on the controller, and does it listen on this port?"
            raise RobotNotReached("the connection was refused", where=self.name, remedy=remedy) from error
        except OSError as error:
            raise RobotNotReached(f"cannot be connected to ({error.strerror or error})", where=self.name, remedy=_WIRE) from error
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection.setblocking(False)
        return connection

    def write(self, data: bytes, timeout_s: float) -> None:
        """Send all of it.

        Raises:
            LinkLost: the other end has closed.
            RobotTimeout: it takes no more.
        """
        connection, rest = self._open_socket(), memoryview(data)
        end_s = time.monotonic() + timeout_s
        while rest:
            try:
                rest = rest[connection.send(rest) :]
            except BlockingIOError:
                left_s = end_s - time.monotonic()
                if left_s <= 0 or not select.select([], [connection], [], left_s)[1]:
                    raise RobotTimeout("takes no more data", where=self.name, remedy=_PROGRAM) from None
            except OSError as error:
                raise self._lost(error) from error

    def read(self, timeout_s: float) -> bytes:
        """What has come, empty after `timeout_s`.

        Raises:
            LinkLost: the other end has closed.
        """
        connection = self._open_socket()
        try:
            if not select.select([connection], [], [], max(timeout_s, 0.0))[0]:
                return b""
            data = connection.recv(_CHUNK)
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as error:  # ValueError: closed by another thread
            raise self._lost(error) from error
        if not data:
            raise self._lost(None)
        return data

    def close(self) -> None:
        """Let go of the socket."""
        connection, self._socket = self._socket, None
        if connection is not None:
            connection.close()

    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise self._lost(None)
        return self._socket

    def _lost(self, error: Exception | None) -> LinkLost:
        self.close()
        why = "closed" if error is None else str(getattr(error, "strerror", None) or error).lower()
        return LinkLost(f"the connection is gone ({why})", where=self.name, remedy=_PROGRAM)


@dataclass(slots=True)
class SerialLink:
    """A serial port, 8 data bits, no parity, 1 stop bit, no handshake; or one end of a pty."""

    port: str
    baud: int
    _serial: Serial | None = field(default=None, init=False, repr=False)

    @property
    def name(self) -> str:
        """The port."""
        return self.port

    def open(self, timeout_s: float) -> None:
        """Open the port and throw away what lies in it; a serial line has no other end to wait for.

        Raises:
            RobotNotReached: no such port, or another program has it.
        """
        from serial import Serial, SerialException

        del timeout_s
        self.close()
        try:
            self._serial = Serial(self.port, self.baud, timeout=0, write_timeout=0.5, exclusive=True)
            self._serial.reset_input_buffer()
        except (SerialException, OSError, ValueError, TypeError) as error:
            remedy = "Name an existing port that no other program uses, e.g. /dev/ttyUSB0; may you read and write it?"
            raise RobotNotReached(f"the serial port cannot be opened ({error})", where=self.port, remedy=remedy) from error

    def write(self, data: bytes, timeout_s: float) -> None:
        """Send all of it.

        Raises:
            LinkLost: the port is gone (unplugged).
            RobotTimeout: it takes no more.
        """
        from serial import SerialException, SerialTimeoutException

        port = self._open_port()
        try:
            port.write_timeout = timeout_s
            port.write(data)
        except SerialTimeoutException as error:
            raise RobotTimeout("takes no more data", where=self.port, remedy=_PROGRAM) from error
        except (SerialException, OSError, TypeError) as error:
            raise self._lost(error) from error

    def read(self, timeout_s: float) -> bytes:
        """What has come, empty after `timeout_s`.

        Raises:
            LinkLost: the port is gone; pyserial tells that in three ways, OSError EIO among them.
        """
        from serial import SerialException

        port = self._open_port()
        try:
            if not select.select([port.fileno()], [], [], max(timeout_s, 0.0))[0]:
                return b""
            data = port.read(_CHUNK)  # timeout 0: what there is
        except (SerialException, OSError, TypeError, ValueError) as error:
            raise self._lost(error) from error
        return bytes(data)

    def close(self) -> None:
        """Let go of the port."""
        port, self._serial = self._serial, None
        if port is not None:
            try:
                port.close()
            except OSError:
                return  # unplugged: there is nothing left to close

    def _open_port(self) -> Serial:
        if self._serial is None:
            raise self._lost(None)
        return self._serial

    def _lost(self, error: Exception | None) -> LinkLost:
        self.close()
        why = "closed" if error is None else str(error)
        return LinkLost(f"the serial port is gone ({why})", where=self.port, remedy="Is its plug in? Then continue with --resume.")
