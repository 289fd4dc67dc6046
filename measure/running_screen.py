"""What an operator sees of a run: a picture that is drawn again and again on a terminal, one line a shot elsewhere."""

from __future__ import annotations

import shutil
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from acquire import events as e
from acquire.capture_warmup import drift_text
from measure.running_coverage import Coverage
from measure.running_operator import KEYS, state_name

if TYPE_CHECKING:
    from rich.console import RenderableType

Row = tuple[str, str, str, str, str]

NO_SAFETY = "software stop: NO safety function, keep the emergency stop in reach"
_MOST_ROWS, _FEWEST_ROWS = 12, 3
_OTHER_LINES = 14
_WIDTH = 80


class Screen:
    """Takes events, questions and remarks; draws, or writes lines."""

    def __init__(
        self,
        note: Callable[[str], None],
        ask: Callable[[str], None],
        draw: Callable[[RenderableType], None] | None,
        coverage: Coverage,
        *,
        keys: bool,
    ) -> None:
        self._note, self._ask, self._draw, self._coverage, self._has_keys = note, ask, draw, coverage, keys
        self._rows: deque[Row] = deque(maxlen=_MOST_ROWS)
        self._place = self._doing = self._remark = self._state = ""
        self._solve: tuple[str, ...] = ()
        self._question: str | None = None
        self._began = time.monotonic()
        self._n_begun = 0

    def show(self, event: e.Event) -> None:
        """Take one event."""
        match event:
            case e.Moving():
                if self._state == state_name(event.state):
                    return
            case e.RunStarted(n_poses=n, n_done=done) if done:
                self.tell(f"{done} of {n} poses are done already")
            case e.WarmingUp(seconds=seconds):
                self._doing = f"warming up for {seconds / 60:.1f} min: {drift_text(event)}"
            case e.PoseStarted(pose=pose, number=number, n_poses=n):
                self._n_begun += 1
                self._place = f"{number}/{n}"
                self._doing = f"pose {pose.id} ({number} of {n}{self._left(n - number + 1)})"
            case e.Retried(reason=reason):
                self.tell(f"exposing again: {reason}")
            case e.Captured() | e.Failed() | e.Skipped():
                self._finish(event)
            case e.Suspended(cause=cause, error=error):
                self._suspended(f"{cause}: {error}")
            case _:
                pass
        self._state = state_name(event.state)
        self._redraw()

    def tell(self, text: str) -> None:
        """A remark that stays until the next."""
        if self._draw is None:
            self._note(text)
        elif text != self._remark:
            self._remark = text
            self._redraw()

    def solved(self, lines: tuple[str, ...]) -> None:
        """What the running solve says."""
        if lines == self._solve:
            return
        self._solve = lines
        if self._draw is None:
            for line in lines:
                self._note(line)
        self._redraw()

    def prompt(self, question: str | None) -> None:
        """Put a question, or take it away."""
        self._question = question
        if self._draw is None and question is not None:
            self._ask(question)
        self._redraw()

    def _suspended(self, text: str) -> None:
        if self._has_keys:  # otherwise nobody answers, and the run ends with this error
            self.tell(text)

    def _finish(self, event: e.Captured | e.Failed | e.Skipped) -> None:
        if isinstance(event, e.Captured):
            self._coverage.add(event)
        row = shot_row(event)
        self._rows.append(row)
        if self._draw is None:
            self._note(shot_line(self._place, row))

    def _left(self, n_left: int) -> str:
        taken = self._n_begun - 1
        if not taken:
            return ""
        seconds = (time.monotonic() - self._began) / taken * n_left
        return f", about {seconds:.0f} s left" if seconds < 100 else f", about {seconds / 60:.0f} min left"

    def _redraw(self) -> None:
        if self._draw is not None:
            self._draw(self._picture())

    def _picture(self) -> RenderableType:
        from rich.console import Group
        from rich.text import Text

        lines = [*self._coverage.lines(), *self._solve, self._remark, f"{self._state:9} {self._doing}", self._question or "", NO_SAFETY]
        if self._has_keys:
            lines.append(KEYS)
        return Group(self._table(), *(Text(line, no_wrap=len(line) <= _WIDTH) for line in lines if line))

    def _table(self) -> RenderableType:
        from rich.box import SIMPLE_HEAD
        from rich.table import Table

        n_rows = max(_FEWEST_ROWS, min(_MOST_ROWS, shutil.get_terminal_size().lines - _OTHER_LINES))
        table = Table(box=SIMPLE_HEAD, pad_edge=False)
        for i, column in enumerate(("pose", "sphere", "points", "rms mm", "remark")):
            table.add_column(column, justify="right" if i in (2, 3) else "left", no_wrap=True, overflow="ellipsis")
        for row in list(self._rows)[-n_rows:]:
            table.add_row(*row)
        return table


def shot_line(place: str, row: Row) -> str:
    """A finished pose in one line of at most 80 characters."""
    pose, sphere, points, rms, remark = row
    figures = f"{points} points, rms {rms} mm" if rms != "-" else f"{points} points" if points != "-" else ""
    parts = [part for part in (figures, remark) if part]
    line = f"{place} pose {pose}{'' if sphere == '-' else f' sphere {sphere}'}: {', '.join(parts)}"
    return line if len(line) <= _WIDTH else line[: _WIDTH - 3] + "..."


def shot_row(event: e.Event) -> Row:
    """Pose, sphere, points on it, rms of the fit, and what is to be remarked, for a finished pose."""
    match event:
        case e.Captured(pose_id=pose, shot=shot, finding=None, xyz_mm=xyz):
            n_points = int((xyz[..., 2] == xyz[..., 2]).sum())  # without the NaN of the holes
            return pose, shot.sphere or "-", str(n_points), "-", ""
        case e.Captured(pose_id=pose, shot=shot, finding=finding, prediction_error_mm=error) if finding is not None:
            remark = "" if error is None else f"{error:.1f} mm from its predicted place"
            return pose, shot.sphere or "-", str(finding.n_points), f"{finding.rms_mm:.3f}", remark
        case e.Failed(pose_id=pose, shot=shot, reason=reason):
            return pose, shot.sphere or "-", "-", "-", f"failed: {reason}"
        case e.Skipped(pose_id=pose, shot=shot):
            return pose, shot.sphere or "-", "-", "-", "skipped"
        case _:
            return "", "", "", "", ""
