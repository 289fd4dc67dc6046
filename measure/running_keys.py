"""Single keys of a terminal, without waiting for Enter. What was typed before a question never answers it."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Self, TextIO, TypeVar

Answer = TypeVar("Answer")

_POLL_S = 0.1


class Keyboard:
    """A terminal that gives keys while a `with` block runs; Ctrl-C stays a signal."""

    def __init__(self, stream: TextIO) -> None:
        self._descriptor = stream.fileno()

    @classmethod
    @contextmanager
    def opened(cls, stream: TextIO | None = None) -> Iterator[Self | None]:
        """A keyboard on stdin; None where that is no terminal."""
        source = sys.stdin if stream is None else stream
        if not source.isatty():
            yield None
            return
        keyboard = cls(source)
        former = termios.tcgetattr(source.fileno())
        try:
            tty.setcbreak(source.fileno(), termios.TCSADRAIN)
            yield keyboard
        finally:
            termios.tcsetattr(source.fileno(), termios.TCSADRAIN, former)

    def pressed(self, wait_s: float = 0.0) -> str | None:
        """The next key in lower case; None where nobody has pressed one, "q" where the terminal is gone."""
        if not select.select([self._descriptor], [], [], wait_s)[0]:
            return None
        try:
            data = os.read(self._descriptor, 1)
        except OSError:
            data = b""
        return data.decode(errors="replace").lower() if data else "q"

    def forget(self) -> None:
        """Drop what was typed; to be called before a question is shown, so that no hasty key answers it."""
        termios.tcflush(self._descriptor, termios.TCIFLUSH)

    def ask(self, answers: Mapping[str, Answer], until: Callable[[], Answer | None]) -> Answer:
        """Wait for one of some keys; `until` may end the wait with an answer of its own."""
        while True:
            given = until()
            if given is not None:
                return given
            key = self.pressed(_POLL_S)
            if key is not None and key in answers:
                return answers[key]
