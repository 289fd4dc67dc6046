"""The ABB adapter and the simulated program joined by a link in memory, on a clock of their own: faults cost no time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

import drivers.abb.adapter
import drivers.abb.line
from drivers.abb.adapter import AbbRobot
from drivers.abb.line import LineClient
from drivers.abb.protocol import LineBuffer
from drivers.abb.settings import AbbSettings
from drivers.errors import LinkLost, RobotNotReached
from drivers.simulated.controllers.abb_program import AbbProgram
from tests.support.abb import abb_cell, abb_model

_TURN_S = 0.004


@dataclass
class VirtualTime:
    """Stands where `time` stands in the modules under test."""

    now_s: float = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return int(self.now_s * 1e9)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


@dataclass
class VirtualLink:
    """A link to a program in memory."""

    program: AbbProgram
    time: VirtualTime
    name: str = "memory"
    is_open: bool = False
    spoil: Callable[[bytes], bytes | None] = field(default=lambda reply: reply)
    """What becomes of a reply; None: it is lost."""
    refuses: bool = False
    _came: bytes = b""
    _buffer: LineBuffer = field(default_factory=LineBuffer)

    def open(self, timeout_s: float) -> None:
        del timeout_s
        if self.refuses:
            raise RobotNotReached("refused")
        self.is_open, self._came = True, b""
        self._buffer.clear()

    def write(self, data: bytes, timeout_s: float) -> None:
        del timeout_s
        self._check()
        for line in self._buffer.feed(data):
            if not self.program.held:
                reply = self.spoil(self.program.answer(line))
                self._came += reply or b""

    def read(self, timeout_s: float) -> bytes:
        self._check()
        data, self._came = self._came, b""
        self.time.now_s += _TURN_S if data else timeout_s
        return data

    def close(self) -> None:
        if self.is_open:
            self.is_open = False
            self.program.link_lost()

    def cut(self) -> None:
        """Somebody pulls the cable."""
        self.close()

    def _check(self) -> None:
        if not self.is_open:
            raise LinkLost("cut")


@dataclass
class VirtualCell:
    """Adapter, link and program."""

    time: VirtualTime
    program: AbbProgram
    link: VirtualLink
    robot: AbbRobot


def virtual_cell(patch: pytest.MonkeyPatch, *, flange_pose: bool = False) -> VirtualCell:
    """A cell whose modules look at a virtual clock."""
    clock = VirtualTime()
    patch.setattr(drivers.abb.line, "time", clock)
    patch.setattr(drivers.abb.adapter, "time", clock)
    program = AbbProgram(abb_cell(), clock.monotonic)
    link = VirtualLink(program, clock)
    robot = AbbRobot(AbbSettings(host="memory", flange_pose=flange_pose), abb_model())
    robot._client = LineClient(link)
    return VirtualCell(clock, program, link, robot)
