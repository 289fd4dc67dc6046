"""The line of `spherecal serve-cell`: one controller at a time, over TCP or a serial port."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
import time
from collections.abc import Callable, Iterator

from drivers.abb.protocol import LineBuffer
from drivers.errors import LinkLost, RobotError, SettingsError
from drivers.transport import Link, SerialLink
from measure.serve import CellDesk

_TURN_S = 0.1
_SEND_S = 1.0
_REOPEN_S = 1.0


class LineServer:
    """Serves a desk in a thread of its own until the block ends."""

    def __init__(self, desk: CellDesk) -> None:
        self._desk = desk
        self._ends = threading.Event()

    @contextlib.contextmanager
    def over_tcp(self, host: str, port: int) -> Iterator[int]:
        """Listen; gives the port.

        Raises:
            SettingsError: the address is not ours, or the port is taken.
        """
        try:
            listening = socket.create_server((host, port))
        except OSError as error:
            remedy = "Name an address of this computer with --host, and a free port with --port."
            raise SettingsError(f"{host}:{port} cannot be listened on ({error.strerror})", where="--host", remedy=remedy) from error
        with listening, self._thread(lambda: self._accept(listening)):
            yield int(listening.getsockname()[1])

    @contextlib.contextmanager
    def over_serial(self, port: str, baud: int) -> Iterator[None]:
        """Open a serial port.

        Raises:
            RobotNotReached: no such port, or another program has it.
        """
        link = SerialLink(port, baud)
        link.open(_SEND_S)
        with self._thread(lambda: self._serve_again(link)):
            yield
        link.close()

    @contextlib.contextmanager
    def _thread(self, target: Callable[[], None]) -> Iterator[None]:
        thread = threading.Thread(target=target, name="line", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._ends.set()
            thread.join()

    def _accept(self, listening: socket.socket) -> None:
        while not self._ends.is_set():
            if select.select([listening], [], [], _TURN_S)[0]:
                connection, _ = listening.accept()
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._desk.forget()
                with connection, contextlib.suppress(RobotError):
                    self._serve(_Accepted(connection), lambda: bool(select.select([listening], [], [], 0)[0]))

    def _serve_again(self, link: SerialLink) -> None:
        """A port that was unplugged is opened again when it comes back: only pictures hang on it, no motion."""
        while not self._ends.is_set():
            with contextlib.suppress(RobotError):
                self._serve(link, lambda: False)
            if self._ends.wait(_REOPEN_S):
                return
            with contextlib.suppress(RobotError):
                link.open(_SEND_S)

    def _serve(self, link: Link, newcomer_waits: Callable[[], bool]) -> None:
        buffer, heard_s = LineBuffer(), time.monotonic()
        while not self._ends.is_set():
            data = link.read(_TURN_S)
            for line in buffer.feed(data):
                link.write(self._desk.answer(line), _SEND_S)
            if data:
                heard_s = time.monotonic()
            elif time.monotonic() - heard_s > _REOPEN_S and newcomer_waits():
                return  # a controller whose cable was cut connects anew while the old connection still seems to stand


class _Accepted:
    """An accepted connection as a Link."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self.name = "controller"

    def open(self, timeout_s: float) -> None:
        """It is open."""

    def write(self, data: bytes, timeout_s: float) -> None:
        """Send all of it."""
        try:
            self._connection.settimeout(timeout_s)
            self._connection.sendall(data)
        except OSError as error:
            raise LinkLost("the controller has gone") from error

    def read(self, timeout_s: float) -> bytes:
        """What has come; empty after `timeout_s`."""
        try:
            if not select.select([self._connection], [], [], timeout_s)[0]:
                return b""
            data = self._connection.recv(4096)
        except OSError as error:
            raise LinkLost("the controller has gone") from error
        if not data:
            raise LinkLost("the controller has closed the connection")
        return data

    def close(self) -> None:
        """Let go."""
        self._connection.close()
