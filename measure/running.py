"""A capture run with its session around it: what the command line and the demo share.

The run itself is `acquire.capture`; here are the folder that it fills, the watcher that sees its events, and the record of
what a real robot has driven (`measure.running_record`).
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from acquire.capture import CaptureSettings, run_capture, settings_of
from acquire.capture_states import RunState
from acquire.cell import Cell, devices_of, robot_model_of
from acquire.events import Command, Event, Finished, Moved
from acquire.identity import identity_of_new_session
from acquire.plan import Plan, plan_text
from acquire.session import SessionWriter
from acquire.session_folder import check_free, check_same_cell
from drivers.protocols import Devices
from measure.running_record import RunRecord, append_run, motion_digest, now_utc, runs_path

Watcher = Callable[[Event], Command | None]
"""Sees every event of a run and may answer with a command."""


@dataclass(frozen=True, slots=True)
class CaptureResult:
    """What a session holds when the run has ended."""

    out: Path
    n_shots: int
    """Good shots of the session, those of earlier runs included."""
    n_failed: int
    n_skipped: int
    state: Literal["complete", "enough", "stopped"]
    """Enough: what was wanted was reached before the last pose."""

    def to_json_dict(self) -> Mapping[str, object]:
        """What `spherecal capture --json` prints."""
        return {"n_shots": self.n_shots, "n_failed": self.n_failed, "n_skipped": self.n_skipped, "state": self.state, "out": self.out}


def moves_a_real_robot(cell: Cell) -> bool:
    """Whether a run in this cell may hurt somebody: any driver but a replay, or a simulation on a clock of its own."""
    instant = cell.robot.settings.get("instant", True) is True
    return not (cell.robot.driver == "recorded" or (cell.robot.driver == "simulated" and instant))


def capture_session(
    cell: Cell, plan: Plan, out: Path, *, watcher: Watcher, resume: bool = False, settings: CaptureSettings | None = None, stepped: bool = False
) -> CaptureResult:
    """Run a plan in a cell and record it; a session that holds no shot when the run fails is taken away again.

    What a real robot has driven is added to the runs of the cell, however the run ends.

    Args:
        cell: whose devices are used.
        plan: the poses.
        out: the session's folder.
        watcher: sees every event.
        resume: go on with the session.
        settings: `settings_of(cell)` if None.
        stepped: whether somebody lets the robot go to every single pose.

    Raises:
        RobotError: as `acquire.capture.run_capture`; the robot is stopped.
        CameraError: likewise.
        DataError: a sphere is missing or the camera drifts, and nobody answered.
        FileError: the session or the cell's runs cannot be written, or the folder is not empty and not to be resumed.
        SettingsError: the devices cannot be made, are others than the cell file says, or `resume` with another cell, robot or camera.
        KeyboardInterrupt: somebody or something wants the run to end now; the robot is stopped.
    """
    devices, how = devices_of(cell), settings or settings_of(cell)
    if resume:  # before a robot is even connected
        check_same_cell(out, cell)
    else:
        check_free(out)
    with devices, _session(cell, plan, out, devices.identity, resume) as writer, _recorded(cell, plan, out, how, stepped) as diary:

        def watch(event: Event) -> Command | None:
            diary.note(event)
            return watcher(event)

        finished = _drive(devices, cell, plan, writer, watch, how)
        shots = [shot for shot in writer.shots if not any(later.replaces == shot.index for later in writer.shots)]
    counts = {status: sum(shot.status == status for shot in shots) for status in ("ok", "failed", "skipped")}
    return CaptureResult(out, counts["ok"], counts["failed"], counts["skipped"], _ending(finished))


def _ending(finished: Finished) -> Literal["complete", "enough", "stopped"]:
    return "stopped" if finished.stopped else "enough" if finished.n_left else "complete"


def _drive(devices: Devices, cell: Cell, plan: Plan, writer: SessionWriter, watcher: Watcher, settings: CaptureSettings) -> Finished:
    """Feed the watcher's commands to the run. However this ends, the generator is closed and so the robot stopped."""
    with closing(run_capture(devices, cell, plan, writer, settings, model=robot_model_of(cell))) as run:
        event = next(run)
        while not isinstance(event, Finished):
            event = run.send(watcher(event))
        watcher(event)
        return event


class _Diary:
    """What a run reached."""

    def __init__(self) -> None:
        self.state = RunState.FAILED
        self.driven: dict[str, None] = {}

    def note(self, event: Event) -> None:
        """Take one event."""
        if isinstance(event, Moved):
            self.driven[event.pose_id] = None
        if isinstance(event, Finished):
            self.state = event.state


@contextmanager
def _recorded(cell: Cell, plan: Plan, out: Path, settings: CaptureSettings, stepped: bool) -> Iterator[_Diary]:
    diary = _Diary()
    try:
        yield diary
    finally:
        if diary.driven and moves_a_real_robot(cell):
            session, speed = str(out.absolute()), settings.motion.speed_rad_s
            append_run(
                runs_path(cell),
                RunRecord(now_utc(), motion_digest(plan), cell.sha256, session, stepped, speed, tuple(diary.driven), diary.state.value),
            )


def _begun(cell: Cell, plan: Plan, out: Path, told: Mapping[str, str]) -> SessionWriter:
    identity = identity_of_new_session(cell, told)
    return SessionWriter.create(out, purpose=plan.purpose, cell=cell, plan_text=plan_text(plan), identity=identity)


@contextmanager
def _session(cell: Cell, plan: Plan, out: Path, told: Mapping[str, str], resume: bool) -> Iterator[SessionWriter]:
    was_there = out.exists()
    writer = SessionWriter.resume(out, cell=cell, told=told) if resume else _begun(cell, plan, out, told)
    try:
        with writer:
            yield writer
    except BaseException:
        if not resume and not writer.shots:
            shutil.rmtree(out, ignore_errors=True)
            if was_there:
                out.mkdir()
        raise
