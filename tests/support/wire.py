"""Wire transcripts of a line protocol: a link that must be used exactly as recorded, and one that records.

A transcript is text: `> ` before a line that our side writes, `< ` before one that it reads; `...` is a wait until the
reader's time is up. Lines that begin with # are comments.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from drivers.transport import Link


class Transcript:
    """A link that plays a transcript; anything else than the recorded bytes, in the recorded order, fails."""

    def __init__(self, text: str) -> None:
        self.steps = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
        self.name = "transcript"

    def open(self, timeout_s: float) -> None:
        del timeout_s

    def write(self, data: bytes, timeout_s: float) -> None:
        del timeout_s
        expected = self.steps.pop(0) if self.steps else "nothing more"
        assert expected == "> " + data.decode("ascii").removesuffix("\n")

    def read(self, timeout_s: float) -> bytes:
        assert self.steps, "read at the end of the transcript"
        step = self.steps.pop(0)
        if step == "...":
            time.sleep(timeout_s)
            return b""
        assert step.startswith("< "), f"read where {step!r} is expected"
        return step[2:].encode("latin-1") + b"\n"

    def close(self) -> None: ...


@contextmanager
def played(path: Path) -> Iterator[Transcript]:
    """A transcript that must be consumed to its end."""
    transcript = Transcript(path.read_text(encoding="ascii"))
    yield transcript
    assert not transcript.steps, f"not consumed: {transcript.steps[0]}"


class Recorder:
    """Writes down what goes over another link."""

    def __init__(self, link: Link) -> None:
        self.link, self.lines = link, list[str]()
        self._rest = b""

    @property
    def name(self) -> str:
        return self.link.name

    def open(self, timeout_s: float) -> None:
        self.link.open(timeout_s)

    def write(self, data: bytes, timeout_s: float) -> None:
        self.lines.append("> " + data.decode("ascii").removesuffix("\n"))
        self.link.write(data, timeout_s)

    def read(self, timeout_s: float) -> bytes:
        data = self.link.read(timeout_s)
        *whole, self._rest = (self._rest + data).split(b"\n")
        self.lines += ["< " + line.decode("ascii") for line in whole]
        if not data:
            self.lines.append("...")
        return data

    def close(self) -> None:
        self.link.close()


