"""The clients of the simulated UR controller, one class for each kind of port."""

from __future__ import annotations

import asyncio
import random
import re
from typing import TYPE_CHECKING

from drivers.simulated.controllers.ur import dashboard, primary
from drivers.simulated.controllers.ur.program import program_of
from drivers.simulated.controllers.ur.rtde import RtdeSession
from drivers.ur.wire import WireError

if TYPE_CHECKING:
    from drivers.simulated.controllers.ur.server import UrController

_BETWEEN_PIECES_S = 0.002
_MOST_UNREAD = 1 << 16
_LONGEST_SCRIPT = 1 << 20
_HEAD = 4
"""Bytes of size, type and recipe of a data package."""


class Connection(asyncio.Protocol):
    """One client at one port."""

    def __init__(self, controller: UrController) -> None:
        self.controller = controller
        self.transport: asyncio.Transport | None = None
        self._rest = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Called by asyncio: the client is there."""
        if isinstance(transport, asyncio.Transport):
            self.transport = transport
            self.controller.connections.add(self)
            self.begin()

    def connection_lost(self, exc: Exception | None) -> None:
        """Called by asyncio: it has gone."""
        del exc
        self.controller.connections.discard(self)

    def begin(self) -> None:
        """The client is there."""

    def answer(self, data: bytes) -> None:
        """Send bytes as fast, late or incomplete as the line is now."""
        line = self.controller.line
        if self.transport is None or self.transport.is_closing() or line.silent:
            return
        if self.transport.get_write_buffer_size() > _MOST_UNREAD:
            return
        late_s = max(line.lag_s, line.slow_s)
        if late_s > 0:
            asyncio.get_running_loop().call_later(late_s, self._write, data)
        elif self._rest:
            self._rest += data
        elif line.fragments and len(data) > 1:
            self._rest = data[len(data) // 2 :]
            self._write(data[: len(data) // 2])
            asyncio.get_running_loop().call_later(_BETWEEN_PIECES_S, self._write_rest)
        else:
            self._write(data)

    def _write_rest(self) -> None:
        rest, self._rest = self._rest, b""
        self._write(rest)

    def _write(self, data: bytes) -> None:
        if self.transport is not None and not self.transport.is_closing():
            self.transport.write(data)


class RtdeConnection(Connection):
    """Port 30004."""

    def begin(self) -> None:
        """Greet it, and make ready."""
        self.session = RtdeSession(self.controller.machine, self.answer, self.controller.claimed)

    def data_received(self, data: bytes) -> None:
        """Called by asyncio: it said something."""
        try:
            self.session.receive(data)
        except WireError:
            self.drop()

    def connection_lost(self, exc: Exception | None) -> None:
        """Called by asyncio: it has gone."""
        super().connection_lost(exc)
        self.session.release()

    def drop(self) -> None:
        """Cut the line."""
        if self.transport is not None:
            self.transport.abort()

    def send_data(self, now_s: float) -> None:
        """A data package, when one is due."""
        line = self.controller.line
        if not self.session.started or now_s < self.session.due_s:
            return
        self.session.due_s = max(self.session.due_s + self.session.period_s, now_s - self.session.period_s) + line.slow_s
        self.session.frozen_s = (self.session.frozen_s or self.controller.machine.timestamp_s) if line.stale else None
        data = self.session.data()
        if line.garbage:
            data = data[:_HEAD] + random.randbytes(len(data) - _HEAD)
        elif line.noise:
            data = random.randbytes(len(data))
        self.answer(data[: len(data) // 2] if line.half else data)


class DashboardConnection(Connection):
    """Port 29999."""

    def begin(self) -> None:
        """Greet it, and make ready."""
        self.buffer = b""
        self.answer(dashboard.GREETING.encode() + b"\n")

    def data_received(self, data: bytes) -> None:
        """Called by asyncio: it said something."""
        *lines, self.buffer = (self.buffer + data).split(b"\n")
        for line in lines:
            if self.controller.line.silent:
                return
            reply = dashboard.answer(self.controller.machine, line.decode("utf-8", "replace"))
            self.answer(reply.encode() + b"\n")
            if reply == dashboard.GOODBYE and self.transport is not None:
                self.transport.close()


class ScriptConnection(Connection):
    """Port 30003."""

    def begin(self) -> None:
        """Greet it, and make ready."""
        self.text = ""

    def data_received(self, data: bytes) -> None:
        """Called by asyncio: it said something."""
        self.text = (self.text + data.decode("utf-8", "replace"))[-_LONGEST_SCRIPT:]
        while (match := re.search(r"^end[ \t]*\r?\n", self.text, re.MULTILINE)) is not None:
            program, self.text = self.text[: match.end()], self.text[match.end() :]
            machine = self.controller.machine
            if not self.controller.line.silent and machine.can_move:
                machine.run(program_of(program, machine))


class PrimaryConnection(ScriptConnection):
    """Ports 30001 and 30002."""

    def begin(self) -> None:
        """Greet it, and make ready."""
        super().begin()
        self.answer(primary.version_message())
