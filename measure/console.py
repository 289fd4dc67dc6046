"""What a command says: tables and lines for a person, one JSON object for a program.

Results go to stdout, everything on the way (notes, progress) to stderr. rich is imported when it is first needed,
and no more than plain text is assumed of the other end: no terminal, no colours, 80 columns and a closed pipe all work.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.console import Console as RichConsole
    from rich.console import RenderableType

Advance = Callable[[int, int], None]
"""Called with (done, total) while something long runs."""

NARROWEST_COLUMNS = 80


def json_text(value: object) -> str:
    """One line of strict JSON: non-finite numbers become null, arrays lists, paths text.

    Raises:
        TypeError: for an object that has no place in JSON.
    """
    return json.dumps(_plain(value), allow_nan=False, ensure_ascii=False)


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    to_list = getattr(value, "tolist", None)  # numpy's arrays and scalars, without importing numpy for `--help`
    if callable(to_list):
        return _plain(to_list())
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def write_line(stream: TextIO, text: str) -> None:
    """Write one line and flush. A reader that has gone away is no reason to stop working, least of all a robot's run."""
    try:
        stream.write(text + "\n")
        stream.flush()
    except BrokenPipeError:
        mute(stream)


def mute(stream: TextIO) -> None:
    """Point a stream whose reader is gone at the null device, so that Python's last flush does not complain either."""
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, stream.fileno())
    finally:
        os.close(null)


@dataclass(frozen=True, slots=True)
class Console:
    """Where a command's words go.

    `as_json` keeps stdout free for the one object; `quiet` leaves errors and that object only.
    """

    as_json: bool = False
    quiet: bool = False

    @property
    def shows_results(self) -> bool:
        """Whether a person reads stdout."""
        return not (self.as_json or self.quiet)

    def error(self, line: str) -> None:
        """One line on stderr, never wrapped, whatever the settings."""
        write_line(sys.stderr, line)

    def note(self, line: str) -> None:
        """One line on stderr for a person who watches."""
        if not self.quiet:
            write_line(sys.stderr, line)

    def say(self, line: str) -> None:
        """One line of the result on stdout."""
        if self.shows_results:
            write_line(sys.stdout, line)

    def table(self, title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """A table of the result on stdout; the first column is text, the others stand to the right."""
        if not self.shows_results:
            return
        from rich.box import SIMPLE_HEAD
        from rich.table import Table

        headed = any(columns)
        box = SIMPLE_HEAD if headed else None
        table = Table(title=title or None, box=box, show_header=headed, title_justify="left", title_style="bold", pad_edge=False)
        for i, column in enumerate(columns):
            table.add_column(column, justify="left" if i == 0 else "right", overflow="fold")
        for row in rows:
            table.add_row(*[_cell(item) for item in row])
        self._rich(sys.stdout).print(table)

    @contextmanager
    def progress(self, what: str) -> Iterator[Advance]:
        """A bar on stderr where that is a terminal and somebody watches; silent otherwise."""
        if self.quiet or not sys.stderr.isatty():
            yield _nothing
            return
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=self._rich(sys.stderr), transient=True) as bar:
            task = bar.add_task(what, total=None)

            def advance(done: int, total: int) -> None:
                bar.update(task, completed=done, total=total)

            yield advance

    @contextmanager
    def live(self) -> Iterator[Callable[[RenderableType], None] | None]:
        """A place on stderr that is drawn again and again; None where that is no terminal or nobody watches."""
        if self.quiet or not sys.stderr.isatty():
            yield None
            return
        from rich.live import Live

        with Live(console=self._rich(sys.stderr), auto_refresh=False) as live:
            yield lambda shown: live.update(shown, refresh=True)

    @staticmethod
    def _rich(stream: TextIO) -> RichConsole:
        from rich.console import Console as Rich

        class PatientConsole(Rich):
            """rich leaves the program when its reader is gone; here the work goes on."""

            def on_broken_pipe(self) -> None:
                mute(stream)

        # without a terminal rich takes its width from COLUMNS or 80; narrower than that and tables fall to pieces
        rich = PatientConsole(file=stream, highlight=False, emoji=False, markup=False)
        rich.width = max(rich.width, NARROWEST_COLUMNS)
        return rich


def _cell(item: object) -> str:
    if item is None:
        return "-"
    if isinstance(item, float):
        return f"{item:.3f}" if math.isfinite(item) else "-"
    return str(item)


def _nothing(_done: int, _total: int) -> None:
    """Progress that nobody watches."""


LOCAL_ONLY = ("--bind", "127.0.0.1")
"""What Rerun's viewer must be told: by itself it listens on every network of the machine."""


def viewer_command(recording: Path) -> str:
    """The command that opens a recording in the viewer of this installation."""
    return " ".join([str(Path(sys.executable).parent / "rerun"), *LOCAL_ONLY, str(recording)])
