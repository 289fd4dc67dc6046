"""Wire transcripts: what an adapter and its controller said to each other once, and must say again to the last byte.

A transcript is text. `> ` stands before a line that our side writes, `< ` before one that it reads, both without their
line feed; `>x ` and `<x ` before bytes in hexadecimal, for protocols that are no lines of text. `...` is a wait until the
reader's time is up. Lines that begin with # are comments, and say where the transcript comes from.

    with played(path) as link:          # for adapters over `drivers.transport.Link`
    with serving(path) as (host, port): # for all that open a TCP connection of their own
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from drivers.contract.checks import ContractBroken, require
from drivers.transport import Link

_TIMEOUT_S = 5.0


def steps_of(text: str) -> list[str]:
    """The steps of a transcript, without comments."""
    return [line for line in text.splitlines() if line.strip() and not line.startswith("#")]


def bytes_of(step: str) -> bytes:
    """What a step puts on the wire."""
    kind, _, content = step.partition(" ")
    return bytes.fromhex(content) if kind.endswith("x") else content.encode("latin-1") + b"\n"


class Transcript:
    """A link that plays a transcript; anything else than the recorded bytes, in the recorded order, is a broken contract."""

    name = "transcript"

    def __init__(self, text: str) -> None:
        self.steps = steps_of(text)

    def open(self, timeout_s: float) -> None:
        """Nothing is to be opened."""

    def write(self, data: bytes, timeout_s: float) -> None:
        """The next step must be these bytes, written by our side."""
        expected = self.steps.pop(0) if self.steps else ""
        require(expected.startswith(">") and bytes_of(expected) == data, f"wrote {data!r} where {expected or 'nothing more'!r} was recorded")

    def read(self, timeout_s: float) -> bytes:
        """What was read here."""
        step = self.steps.pop(0) if self.steps else ""
        if step == "...":
            time.sleep(timeout_s)
            return b""
        require(step.startswith("<"), f"reads where {step or 'nothing more'!r} was recorded")
        return bytes_of(step)

    def close(self) -> None:
        """Nothing is to be closed."""


@contextmanager
def played(path: Path) -> Iterator[Transcript]:
    """A link that must be used to the transcript's end.

    Raises:
        ContractBroken: other bytes, another order, or steps that are left.
    """
    transcript = Transcript(path.read_text(encoding="ascii"))
    yield transcript
    require(not transcript.steps, f"not consumed: {transcript.steps[:1]}")


@contextmanager
def serving(path: Path, host: str = "127.0.0.1", port: int = 0) -> Iterator[tuple[str, int]]:
    """A TCP server for one connection that hears and says exactly what was recorded; gives its address.

    Raises:
        ContractBroken: the client wrote other bytes, or left steps.
    """
    steps, broken = steps_of(path.read_text(encoding="ascii")), list[str]()
    with socket.create_server((host, port)) as listening:
        listening.settimeout(_TIMEOUT_S)
        thread = threading.Thread(target=_serve, args=(listening, steps, broken), daemon=True)
        thread.start()
        found = listening.getsockname()
        yield found[0], found[1]
        thread.join(2 * _TIMEOUT_S)
    if broken or steps:
        raise ContractBroken("; ".join(broken) or f"not consumed: {steps[0]}")


def _serve(listening: socket.socket, steps: list[str], broken: list[str]) -> None:
    try:
        link, _ = listening.accept()
        with link:
            link.settimeout(_TIMEOUT_S)
            while steps:
                data = bytes_of(steps[0])
                if steps[0].startswith("<"):
                    link.sendall(data)
                elif (heard := _exactly(link, len(data))) != data:
                    broken.append(f"wrote {heard!r} where {steps[0]!r} was recorded")
                    return
                del steps[0]
            if more := link.recv(1):
                broken.append(f"wrote {more!r} and more after the end of the transcript")
    except OSError as error:
        broken.append(f"{error} at {steps[0] if steps else 'the end'}")


def _exactly(link: socket.socket, size: int) -> bytes:
    heard = b""
    while len(heard) < size and (data := link.recv(size - len(heard))):
        heard += data
    return heard


class Recorder:
    """Writes down what goes over another link, as a transcript."""

    def __init__(self, link: Link) -> None:
        self.link, self.lines = link, list[str]()
        self._rest = b""

    @property
    def name(self) -> str:
        """That of the link."""
        return self.link.name

    def open(self, timeout_s: float) -> None:
        """Open the link."""
        self.link.open(timeout_s)

    def write(self, data: bytes, timeout_s: float) -> None:
        """Write, and note it."""
        self.lines.append("> " + data.decode("latin-1").removesuffix("\n"))
        self.link.write(data, timeout_s)

    def read(self, timeout_s: float) -> bytes:
        """Read, and note it."""
        data = self.link.read(timeout_s)
        *whole, self._rest = (self._rest + data).split(b"\n")
        self.lines += ["< " + line.decode("latin-1") for line in whole]
        if not data:
            self.lines.append("...")
        return data

    def close(self) -> None:
        """Close the link."""
        self.link.close()
