"""Requests and replies over a link: numbered, checked, repeated when a reply is lost, and never later than the deadline."""

from __future__ import annotations

import time
from dataclasses import dataclass

from drivers.abb.protocol import ANSWERS, LAST_NUMBER, BadLine, Code, Fault, Line, LineBuffer, Verb, decode, encode
from drivers.errors import LinkLost, RobotError, RobotTimeout, WrongController
from drivers.transport import Link

REPEAT_S = 0.2
"""After so long without a reply the same line is sent again; the other side then repeats its words and does nothing."""
_MOST_FOREIGN_LINES = 3


class Refusal(RobotError):
    """The controller's program answered with an error."""

    def __init__(self, number: int, said: str) -> None:
        super().__init__(f"the program on the controller refuses: {said} ({number})", remedy="See docs/abb_protocol.md for its error numbers.")
        self.number = number
        self.said = said


@dataclass(frozen=True, slots=True)
class Reply:
    """An answer, and how old what it says may be."""

    line: Line
    asked_s: float
    """`time.monotonic()` when the request was first sent: what it tells is not older."""
    came_s: float

    @property
    def age_s(self) -> float:
        """Greatest age of what it tells."""
        return self.came_s - self.asked_s


def first_number() -> int:
    """Where counting begins: not where an earlier connection left off, so that a reply still under way does not fit."""
    return time.monotonic_ns() // 1_000_000 % LAST_NUMBER


class LineClient:
    """The side that asks. One thread owns it; after any error but a Refusal the link is closed."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.is_open = False
        self.n_repeats = 0
        """How often a line had to be sent again since the link was opened."""
        self._buffer = LineBuffer()
        self._number = 0
        self._foreign = 0

    def open(self, timeout_s: float) -> None:
        """Open the link; nothing is asked yet.

        Raises:
            RobotNotReached: nobody is there.
            RobotTimeout: nobody answers in time.
        """
        self.link.open(timeout_s)
        self.is_open = True
        self._buffer.clear()
        self._foreign = self.n_repeats = 0
        self._number = first_number()

    def close(self) -> None:
        """Let go of the link."""
        self.is_open = False
        self.link.close()

    def ask(self, verb: Verb, *arguments: str, timeout_s: float) -> Reply:
        """Send a request and wait for its reply.

        Raises:
            Refusal: the program says no; the link stays open.
            RobotTimeout: no reply within `timeout_s`.
            LinkLost: the link has gone.
            WrongController: what answers speaks another language.
            BadLine: the arguments do not fit into a line.
        """
        if not self.is_open:
            raise LinkLost("the link is closed", where=self.link.name, remedy="Open the robot again.")
        self._number = self._number % LAST_NUMBER + 1
        data = encode(self._number, verb, *arguments)
        try:
            return self._exchange(verb, data, timeout_s)
        except Refusal:
            raise
        except BaseException:
            self.close()
            raise

    def _exchange(self, verb: Verb, data: bytes, timeout_s: float) -> Reply:
        asked_s = time.monotonic()
        end_s = asked_s + timeout_s
        while (now_s := time.monotonic()) < end_s:
            if now_s > asked_s + 1e-3:
                self.n_repeats += 1
            self.link.write(data, end_s - now_s)
            line = self._await_reply(min(end_s, now_s + REPEAT_S))
            if line is not None:
                return Reply(self._checked(line, verb), asked_s, time.monotonic())
        remedy = "An emergency stop, a stop button or motors off hold its program: look at the FlexPendant, then continue with --resume."
        raise RobotTimeout(f"the controller did not answer {verb} within {timeout_s:.1f} s", where=self.link.name, remedy=remedy)

    def _await_reply(self, end_s: float) -> Line | None:
        """Our reply, or None when the same line should be sent again."""
        while (left_s := end_s - time.monotonic()) > 0:
            for data in self._buffer.feed(self.link.read(left_s)):
                line = self._decoded(data)
                if line is not None and line.number == self._number:
                    return line
                if line is not None and line.number == 0 and line.word == Code.ERROR:
                    self._count_foreign("our lines arrive broken there")
                    return None
        return None

    def _decoded(self, data: bytes) -> Line | None:
        try:
            line = decode(data)
        except BadLine as error:
            self._count_foreign(error.message)
            return None
        if line.number != 0:
            self._foreign = 0
        return line

    def _count_foreign(self, found: str) -> None:
        """Disturbed lines are asked for again; a few in a row are no disturbance."""
        self._foreign += 1
        if self._foreign >= _MOST_FOREIGN_LINES:
            remedy = "Is spherecal.mod the program that listens there? On a serial line, is the baud rate the same on both sides?"
            raise WrongController(f"what answers is not the program of spherecal: {found}", where=self.link.name, remedy=remedy)

    def _checked(self, line: Line, verb: Verb) -> Line:
        if line.word == Code.ERROR:
            number = line.arguments[0] if line.arguments else "0"
            raise Refusal(int(number) if number.isascii() and number.isdigit() else 0, " ".join(line.arguments[1:]) or "no reason given")
        if line.word != ANSWERS[verb]:
            raise WrongController(f"{verb} was answered by {line.word}", where=self.link.name, remedy="Do both sides speak the same version?")
        return line


def is_fault(error: Refusal, *faults: Fault) -> bool:
    """Whether a refusal has one of these reasons."""
    return error.number in {int(fault) for fault in faults}
