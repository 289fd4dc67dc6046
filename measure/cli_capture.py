"""`spherecal capture`: the run, watched by a person or by nobody."""

from __future__ import annotations

import sys
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_run import EXIT_INTERRUPTED, EXIT_NOT_GOOD, AsJson, Debug, Quiet, command, stopped_by_signals

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import RenderableType

    from acquire.cell import Cell
    from acquire.events import Command, Event
    from acquire.plan import Plan
    from measure.console import Console

MOTION_WORD = "move"


def capture(
    cell: Annotated[Path, typer.Argument(help="The cell file.")],
    plan: Annotated[Path, typer.Argument(help="The plan, as `plan` writes it.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The session folder to write.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a session that was interrupted.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before the robot moves.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List the poses and the time they take; touch nothing.")] = False,
    step: Annotated[bool, typer.Option("--step", help="Ask before every pose.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Drive the robot through a plan and record a session. Ctrl-C ends after the shot in hand, twice stops at once."""
    with command(as_json, debug, quiet) as run:
        from acquire.cell import load_cell, robot_model_of
        from acquire.plan import load_plan
        from measure.running import StopOnInterrupt, capture_session

        loaded = load_cell(cell)
        poses = load_plan(plan, loaded, robot_model_of(loaded))
        if dry_run:
            run.finish(_dry_run(run.console, loaded, poses))
            return
        if step:
            _require_person("--step asks before every pose")
        elif not yes:
            confirm_motion(loaded, poses)
        interrupt = StopOnInterrupt(run.console.note)
        with run.console.live() as draw, stopped_by_signals(), interrupt.watching():
            table = RunTable(run.console.note, draw)

            def watch(event: Event) -> Command | None:
                table.show(event)
                return interrupt.command_at(event) or (ask_step(event) if step else None)

            result = capture_session(loaded, poses, out, watcher=watch, resume=resume)
        run.console.say(f"{result.n_shots} shots in {out}, {result.n_failed} failed, {result.n_skipped} skipped: {result.state}")
        if result.state == "stopped":
            run.console.note(f"go on with: spherecal capture {cell} {plan} -o {out} --resume")
        run.finish(result.to_json_dict())
        run.exit_code = EXIT_INTERRUPTED if interrupt.asked else 0 if result.n_shots else EXIT_NOT_GOOD


def _dry_run(console: Console, cell: Cell, plan: Plan) -> dict[str, object]:
    import numpy as np

    from acquire.capture import planned_seconds, settings_of

    rows = [[pose.id, pose.sphere or "-", "  ".join(f"{angle:7.1f}" for angle in np.degrees(pose.joints_rad))] for pose in plan.poses]
    seconds = planned_seconds(plan.poses, settings_of(cell))
    console.table("", ["pose", "sphere", "axes, degrees"], rows)
    console.say(f"{len(plan.poses)} poses, about {seconds / 60:.0f} min at {cell.motion.speed_rad_s:g} rad/s; nothing was moved")
    return {"n_shots": 0, "n_failed": 0, "state": "dry_run", "n_poses": len(plan.poses), "seconds": seconds}


def confirm_motion(cell: Cell, plan: Plan) -> None:
    """Ask the one question before a real robot moves.

    Raises:
        SettingsError: nobody is there to answer, or the answer is no.
    """
    from drivers.errors import SettingsError
    from measure.running import moves_a_real_robot

    if not moves_a_real_robot(cell):
        return
    _require_person("the robot is about to move")
    speed = f"{cell.motion.speed_rad_s:g} rad/s"
    sys.stderr.write(f"The robot of {cell.name!r} will move through {len(plan.poses)} poses at up to {speed}. Type '{MOTION_WORD}' to start: ")
    sys.stderr.flush()
    if sys.stdin.readline().strip() != MOTION_WORD:
        raise SettingsError("the motion was not confirmed", remedy=f"Type '{MOTION_WORD}', or use --yes.")


def _require_person(why: str) -> None:
    from drivers.errors import SettingsError

    if not sys.stdin.isatty():
        raise SettingsError(f"{why} and there is no terminal to answer at", remedy="Confirm with --yes, or run it at a terminal.")


def ask_step(event: Event) -> Command | None:
    """Before each pose: go, skip it, or end the run."""
    from acquire.events import PoseStarted, Skip, Stop

    if not isinstance(event, PoseStarted):
        return None
    sys.stderr.write(f"pose {event.pose.id}: Enter goes there, s skips it, q ends the run: ")
    sys.stderr.flush()
    answer = sys.stdin.readline()
    if not answer or answer.strip().lower() == "q":
        return Stop()
    return Skip() if answer.strip().lower() == "s" else None


class RunTable:
    """What an operator sees: the last shots as a table on a terminal, one line a shot elsewhere."""

    LAST = 12

    def __init__(self, note: Callable[[str], None], draw: Callable[[RenderableType], None] | None) -> None:
        self._note, self._draw = note, draw
        self._rows: deque[tuple[str, str, str, str, str]] = deque(maxlen=self.LAST)
        self._place = ""
        self._doing = ""
        self._began = time.monotonic()
        self._n_begun = 0

    def show(self, event: Event) -> None:
        """Take one event."""
        from acquire import events as e

        match event:
            case e.RunStarted(n_poses=n, n_done=done) if done:
                self._note(f"{done} of {n} poses are done already")
            case e.PoseStarted(pose=pose, number=number, n_poses=n):
                self._n_begun += 1
                self._place = f"{number}/{n}"
                self._doing = f"pose {pose.id} ({number} of {n}{self._left(n - number + 1)}): moving"
            case e.Settled():
                self._doing = self._doing.replace("moving", "exposing")
            case e.Retried(reason=reason):
                self._doing = f"exposing again: {reason}"
            case e.Captured() | e.Failed() | e.Skipped():
                self._row(shot_row(event))
            case e.Paused():
                self._doing = "paused"
            case _:
                return
        if self._draw is not None:
            self._draw(self._table())

    def _row(self, row: tuple[str, str, str, str, str]) -> None:
        self._rows.append(row)
        if self._draw is None:
            pose, sphere, points, rms, remark = row
            figures = f"{points} points, rms {rms} mm" if rms != "-" else f"{points} points" if points != "-" else ""
            parts = [part for part in (figures, remark) if part]
            line = f"{self._place} pose {pose}{'' if sphere == '-' else f' sphere {sphere}'}: {', '.join(parts)}"
            self._note(line if len(line) <= 80 else line[:77] + "...")

    def _left(self, n_left: int) -> str:
        taken = self._n_begun - 1
        return f", about {(time.monotonic() - self._began) / taken * n_left / 60:.0f} min left" if taken else ""

    def _table(self) -> RenderableType:
        from rich.box import SIMPLE_HEAD
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        table = Table(box=SIMPLE_HEAD, pad_edge=False)
        for i, column in enumerate(("pose", "sphere", "points", "rms mm", "remark")):
            table.add_column(column, justify="right" if i in (2, 3) else "left")
        for row in self._rows:
            table.add_row(*row)
        return Group(table, Text(self._doing))


def shot_row(event: Event) -> tuple[str, str, str, str, str]:
    """Pose, sphere, points on it, rms of the fit, and what is to be remarked, for a finished pose."""
    from acquire.events import Captured, Failed, Skipped

    match event:
        case Captured(pose_id=pose, shot=shot, finding=None, xyz_mm=xyz):
            n_points = int((xyz[..., 2] == xyz[..., 2]).sum())  # without the NaN of the holes
            return pose, shot.sphere or "-", str(n_points), "-", ""
        case Captured(pose_id=pose, shot=shot, finding=finding, prediction_error_mm=error) if finding is not None:
            remark = "" if error is None else f"{error:.1f} mm from its predicted place"
            return pose, shot.sphere or "-", str(finding.n_points), f"{finding.rms_mm:.3f}", remark
        case Failed(pose_id=pose, shot=shot, reason=reason):
            return pose, shot.sphere or "-", "-", "-", f"failed: {reason}"
        case Skipped(pose_id=pose, shot=shot):
            return pose, shot.sphere or "-", "-", "-", "skipped"
        case _:
            return "", "", "", "", ""
