"""The line protocol between spherecal and an ABB controller: requests, replies, numbers and checksum (docs/abb_protocol.md).

    0017 GO 12 0016 17.1887 3.00*B4            request: number, verb, arguments, checksum
    0017 G 12 0016 4.21*5C                     its reply, with the same number

A line is at most 79 printable ASCII characters and a line feed, because a RAPID string holds 80. The side that speaks
first numbers its requests; the other answers each, and answers a repeated one with the same words and without doing
anything again. Axis angles are degrees as the controller counts them, lengths mm, quaternions w, x, y, z.

`spherecal.mod` holds the same tables; a test compares them.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import IntEnum, StrEnum

from drivers.errors import RobotError

VERSION = 1
LONGEST = 79
"""Characters of a line without its line feed."""
LAST_NUMBER = 9999
LAST_EPOCH = 999
ANGLE_DECIMALS, ANGLE_WIDTH = 5, 9
LENGTH_DECIMALS = 3
QUATERNION_DECIMALS = 6
TOKEN_LIFE_S = 5.0
"""How long a target may be started after it was given."""
FASTEST_DEG_S = 60.0
"""The program refuses faster motions."""
N_AXES = 6


class Verb(StrEnum):
    """What the computer asks of the controller."""

    HELLO = "HELLO"
    INFO = "INFO"
    TOOL = "TOOL"
    STATE = "J"
    POSE = "POSE"
    TARGET = "TARGET"
    GO = "GO"
    LAST = "LAST"
    STOP = "STOP"
    TRIGGER = "TRIG"
    RESULT = "RESULT"


class Code(StrEnum):
    """What an answer is."""

    HELLO = "H"
    INFO = "I"
    TOOL = "W"
    STATE = "J"
    POSE = "P"
    TARGET = "T"
    GO = "G"
    LAST = "L"
    STOP = "S"
    TRIGGER = "C"
    RESULT = "R"
    ERROR = "E"


ANSWERS: dict[Verb, Code] = {verb: Code[verb.name] for verb in Verb}
MASTER_VERBS = (Verb.HELLO, Verb.TRIGGER, Verb.RESULT)
"""What the controller asks of the computer where its own program owns the motion."""
ARGUMENTS: dict[Verb, int] = {
    Verb.HELLO: 0,
    Verb.INFO: 1,
    Verb.TOOL: 0,
    Verb.STATE: 0,
    Verb.POSE: 0,
    Verb.TARGET: 6,
    Verb.GO: 4,
    Verb.LAST: 0,
    Verb.STOP: 0,
    Verb.TRIGGER: 7,
    Verb.RESULT: 1,
}


class Fault(IntEnum):
    """Why a request is answered by an error."""

    CHECKSUM = 1
    SYNTAX = 2
    VERB = 3
    EPOCH = 4
    TOKEN = 5
    EXPIRED = 6
    BUSY = 7
    SPEED = 8
    NUMBER = 9
    NOT_READY = 10


class Outcome(IntEnum):
    """How the last motion ended."""

    NONE = 0
    RUNNING = 1
    REACHED = 2
    STOPPED = 3
    LINK_LOST = 4
    SILENCE = 5
    HELD = 6


OUTCOME_TEXTS = {
    Outcome.NONE: "its program has started no motion",
    Outcome.RUNNING: "the motion is under way",
    Outcome.REACHED: "the target was reached",
    Outcome.STOPPED: "the motion was stopped by a request",
    Outcome.LINK_LOST: "the motion was given up because the connection was lost",
    Outcome.SILENCE: "the motion was given up because the computer said nothing",
    Outcome.HELD: "the motion was given up because the program was held (emergency stop, stop button, motors off) and started again",
}


class BadLine(RobotError):
    """A line that is none of this protocol's: too long, not ASCII, a wrong checksum, a number that is none."""


@dataclass(frozen=True, slots=True)
class Line:
    """A whole line with a right checksum."""

    number: int
    """1 to 9999; 0 where the other side could not read ours."""
    word: str
    """A verb or a code."""
    arguments: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The last argument where it is free text: all of them."""
        return " ".join(self.arguments)


@dataclass(frozen=True, slots=True)
class StateReply:
    """What `J` tells."""

    epoch: int
    joints_deg: tuple[float, ...]
    motion: str
    """R ready, no motion since the program started; M moving; D done; X interrupted."""
    mode: str
    """A automatic, R manual reduced, F manual full speed, U unknown."""
    motors: str
    """1 on, 0 off, - unknown."""
    stop: str
    """N none, E emergency stop, G guard stop, P program error, - unknown."""


_LINE = re.compile(r"([0-9]{4}) ([A-Z]{1,6})((?: [!-)+-~]+)*)\*([0-9A-F]{2})")
_NUMBER = re.compile(r"-?[0-9]{1,5}(?:\.[0-9]{0,7})?")
_FLAGS = re.compile(r"[RMDX][ARFU][01-][NEGP-]")


def checksum(body: str) -> str:
    """Two hexadecimal digits over the characters before the asterisk.

    c <- (31 c + code) mod 251: finds every wrong character and every pair of exchanged neighbours, and RAPID can
    calculate it exactly in its single-precision numbers.
    """
    value = 0
    for character in body:
        value = (31 * value + ord(character)) % 251
    return f"{value:02X}"


def encode(number: int, word: str, *arguments: str) -> bytes:
    """The bytes of a line.

    Raises:
        BadLine: longer than a RAPID string holds, or characters that a line may not have.
    """
    body = " ".join((f"{number:04d}", word, *arguments))
    line = f"{body}*{checksum(body)}"
    if len(line) > LONGEST or not _LINE.fullmatch(line):
        raise BadLine(f"{body!r} cannot be sent as a line", remedy=f"A line has at most {LONGEST} printable characters, none an asterisk.")
    return line.encode("ascii") + b"\n"


def decode(data: bytes) -> Line:
    """The line in bytes without their line feed; a carriage return at the end is nothing.

    Raises:
        BadLine: anything that `encode` does not make.
    """
    text = data.removesuffix(b"\r").decode("latin-1")
    if len(text) > LONGEST:
        raise BadLine(f"a line of {len(text)} characters", remedy=f"At most {LONGEST} are allowed.")
    match = _LINE.fullmatch(text)
    if match is None:
        raise BadLine(f"{text[:40]!r} is no line of the protocol", remedy="What answers at this address?")
    if match[4] != checksum(text[:-3]):
        raise BadLine(f"the checksum of {text[:40]!r} is wrong", remedy="Is the cable or the baud rate bad?")
    return Line(int(match[1]), match[2], tuple(match[3].split()))


def angle_text(degrees: float) -> str:
    """An axis angle in at most nine characters: five decimals where they fit, else four.

    Raises:
        BadLine: not finite, or 1000 degrees and more.
    """
    if not (math.isfinite(degrees) and abs(degrees) < 999.9999):
        raise BadLine(f"an axis angle of {degrees} degrees", remedy="Angles are finite and below 1000 degrees.")
    text = _fixed(degrees, ANGLE_DECIMALS)
    return text if len(text) <= ANGLE_WIDTH else _fixed(degrees, ANGLE_DECIMALS - 1)


def number_text(value: float, decimals: int) -> str:
    """A number with a fixed count of decimals.

    Raises:
        BadLine: not finite, or 100 000 and more.
    """
    if not (math.isfinite(value) and abs(value) < 99999):
        raise BadLine(f"{value} cannot be sent", remedy="Give a finite number below 99999.")
    return _fixed(value, decimals)


def _fixed(value: float, decimals: int) -> str:
    text = f"{value:.{decimals}f}"
    return text[1:] if float(text) == 0.0 and text.startswith("-") else text


def numbers(arguments: tuple[str, ...], count: int) -> tuple[float, ...]:
    """That many numbers.

    Raises:
        BadLine: another count, or something that is no plain decimal number.
    """
    if len(arguments) != count:
        raise BadLine(f"{len(arguments)} values where {count} belong", remedy="Do both sides speak the same version?")
    for text in arguments:
        if not _NUMBER.fullmatch(text):
            raise BadLine(f"{text[:20]!r} is no number", remedy="Numbers are plain decimals.")
    return tuple(float(text) for text in arguments)


def whole(text: str, last: int) -> int:
    """A whole number from 0 to `last`.

    Raises:
        BadLine: something else.
    """
    if not (text.isascii() and text.isdigit() and len(text) <= 5 and int(text) <= last):
        raise BadLine(f"{text[:20]!r} is no whole number up to {last}", remedy="Do both sides speak the same version?")
    return int(text)


def state_arguments(state: StateReply) -> tuple[str, ...]:
    """The arguments of a `J` reply."""
    return str(state.epoch), *(angle_text(angle) for angle in state.joints_deg), state.motion + state.mode + state.motors + state.stop


def parse_state(line: Line) -> StateReply:
    """What a `J` reply tells.

    Raises:
        BadLine: it is none.
    """
    if line.word != Code.STATE or len(line.arguments) != N_AXES + 2 or not _FLAGS.fullmatch(line.arguments[-1]):
        raise BadLine(f"{line.word} {line.text[:40]!r} is no state", remedy="Do both sides speak the same version?")
    flags = line.arguments[-1]
    return StateReply(whole(line.arguments[0], LAST_EPOCH), numbers(line.arguments[1:-1], N_AXES), flags[0], flags[1], flags[2], flags[3])


class LineBuffer:
    """Cuts what comes into lines; what is too long for one is thrown away up to its end."""

    def __init__(self) -> None:
        self._rest = b""
        self._overlong = False

    def feed(self, data: bytes) -> list[bytes]:
        """The lines that are whole now, without their line feeds; an overlong one comes as its beginning."""
        *whole_lines, rest = (self._rest + data).split(b"\n")
        lines = []
        for line in whole_lines:
            if not self._overlong:
                lines.append(line)
            self._overlong = False
        if len(rest) > LONGEST + 1:
            if not self._overlong:
                lines.append(rest[: LONGEST + 2])  # so that whoever reads it finds it too long
            rest, self._overlong = b"", True
        self._rest = rest
        return lines

    def clear(self) -> None:
        """Forget the beginning of a line."""
        self._rest, self._overlong = b"", False
