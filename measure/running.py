"""A capture run with its session around it: what the command line and the demo share.

The run itself is `acquire.capture`; here are the folder that it fills, the watcher that sees its events, and Ctrl-C.
"""

from __future__ import annotations

import shutil
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Literal

from acquire.capture import run_capture
from acquire.cell import Cell, devices_of, robot_model_of
from acquire.events import Captured, Command, Event, Failed, Finished, PoseStarted, Skipped, Stop
from acquire.plan import Plan, plan_text
from acquire.session import SessionWriter
from acquire.session_folder import check_free
from drivers.protocols import Devices

Watcher = Callable[[Event], Command | None]
"""Sees every event of a run and may answer with a command."""

_DONE_WITH_A_POSE = (Captured, Failed, Skipped, PoseStarted)


@dataclass(frozen=True, slots=True)
class CaptureResult:
    """What a session holds when the run has ended."""

    out: Path
    n_shots: int
    """Good shots of the session, those of earlier runs included."""
    n_failed: int
    n_skipped: int
    state: Literal["complete", "stopped"]

    def to_json_dict(self) -> Mapping[str, object]:
        """What `spherecal capture --json` prints."""
        return {"n_shots": self.n_shots, "n_failed": self.n_failed, "n_skipped": self.n_skipped, "state": self.state, "out": self.out}


def moves_a_real_robot(cell: Cell) -> bool:
    """Whether a run in this cell may hurt somebody: any driver but a replay, or a simulation on a clock of its own."""
    instant = cell.robot.settings.get("instant", True) is True
    return not (cell.robot.driver == "recorded" or (cell.robot.driver == "simulated" and instant))


def capture_session(cell: Cell, plan: Plan, out: Path, *, watcher: Watcher, resume: bool = False) -> CaptureResult:
    """Run a plan in a cell and record it; a session that holds no shot when the run fails is taken away again.

    Raises:
        RobotError: as `acquire.capture.run_capture`; the robot is stopped.
        CameraError: likewise.
        FileError: the session cannot be written, or is not empty and not to be resumed.
        SettingsError: the devices cannot be made, or `resume` with another cell.
        KeyboardInterrupt: somebody or something wants the run to end now; the robot is stopped.
    """
    devices = devices_of(cell)
    if not resume:
        check_free(out)  # before a robot is even connected
    with devices, _session(cell, plan, out, resume) as writer:
        finished = _drive(devices, cell, plan, writer, watcher)
        shots = [shot for shot in writer.shots if not any(later.replaces == shot.index for later in writer.shots)]
    counts = {status: sum(shot.status == status for shot in shots) for status in ("ok", "failed", "skipped")}
    return CaptureResult(out, counts["ok"], counts["failed"], counts["skipped"], "stopped" if finished.stopped else "complete")


def _drive(devices: Devices, cell: Cell, plan: Plan, writer: SessionWriter, watcher: Watcher) -> Finished:
    """Feed the watcher's commands to the run. However this ends, the generator is closed and so the robot stopped."""
    with closing(run_capture(devices, cell, plan, writer, model=robot_model_of(cell))) as run:
        event = next(run)
        while not isinstance(event, Finished):
            event = run.send(watcher(event))
        watcher(event)
        return event


@contextmanager
def _session(cell: Cell, plan: Plan, out: Path, resume: bool) -> Iterator[SessionWriter]:
    was_there = out.exists()
    writer = SessionWriter.resume(out, cell=cell) if resume else SessionWriter.create(out, purpose=plan.purpose, cell=cell, plan_text=plan_text(plan))
    try:
        with writer:
            yield writer
    except BaseException:
        if not resume and not writer.shots:
            shutil.rmtree(out, ignore_errors=True)
            if was_there:
                out.mkdir()
        raise


class StopOnInterrupt:
    """Ctrl-C once: the run ends when the shot in hand is on disk. Twice: KeyboardInterrupt, and the robot stops now."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self.asked = False
        self._tell = tell

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Take SIGINT while the block runs."""
        former = signal.signal(signal.SIGINT, self._interrupted)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, former)

    def command_at(self, event: Event) -> Command | None:
        """A Stop, once asked for, as soon as no pose is in hand."""
        return Stop() if self.asked and isinstance(event, _DONE_WITH_A_POSE) else None

    def _interrupted(self, _number: int, _frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        self._tell("Ctrl-C: the run ends after this shot; once more stops the robot now")
