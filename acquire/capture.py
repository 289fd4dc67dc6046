"""The capture run: a generator that tells events and takes commands. It knows no screen and no solver.

    run = run_capture(devices, cell, plan, writer)
    event = next(run)
    while True:
        event = run.send(command or None)          # StopIteration after Finished

None means that nobody said anything. `event.state` is the state of the run (`acquire.capture_states`). However the run
ends, by its last pose, a Stop, an error, Ctrl-C or because the caller lets go of the generator, the robot has been told
to stop if it may be moving.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator

from acquire.capture_pose import PoseTaker, Steps
from acquire.capture_settings import CaptureSettings, WarmUpSettings, planned_seconds, settings_of
from acquire.capture_shots import ShotBook
from acquire.capture_states import FOLLOWERS, RunState
from acquire.capture_vigil import SUSPENDING, Vigil, cause_of
from acquire.capture_warmup import warming_up
from acquire.cell import Cell, robot_model_of
from acquire.events import (
    Append,
    Command,
    Continue,
    Event,
    Finish,
    Finished,
    Pause,
    Paused,
    PoseStarted,
    Redo,
    RunStarted,
    Skip,
    Skipped,
    Stop,
    Suspended,
)
from acquire.identity import reopen_camera, reopen_robot
from acquire.motion import RobotUnsettled, halt, read_safely
from acquire.plan import Plan, PlannedPose
from acquire.session import SessionWriter
from acquire.way import way_of
from drivers.errors import (
    CameraError,
    CameraTimeout,
    ChannelTaken,
    MotionRefused,
    MotorsOff,
    NotInRemoteControl,
    RobotError,
    RobotNotReached,
    SettingsError,
    SpherecalError,
)
from drivers.kinematics.mdh import RobotModel
from drivers.protocols import Devices, stop_after

__all__ = ["CaptureSettings", "RobotUnsettled", "planned_seconds", "run_capture", "settings_of"]


def run_capture(
    devices: Devices, cell: Cell, plan: Plan, writer: SessionWriter, settings: CaptureSettings | None = None, *, model: RobotModel | None = None
) -> Steps:
    """Take the poses of a plan; poses that the session holds with status ok are left out.

    Trouble with robot or camera, a sphere that is missing and a camera that drifts suspend the run (`events.Suspended`);
    the errors below come where nobody answers that.

    Args:
        devices: opened; the run does not close them for good, but opens one anew after trouble and a Continue, if it is the same.
        cell: spheres, first guess of the hand-eye, kind of camera.
        plan: the poses, in this order.
        writer: the session.
        settings: `settings_of(cell)` if None.
        model: the nominal robot, to predict where a sphere will be seen; the cell's if None.

    Raises:
        RobotError: the robot is late, stands elsewhere, is in a safety stop or gone (it was stopped as far as possible), or no
            clear way leads from where it stands to the next pose.
        CameraError: the camera is gone, set wrongly, or failed at several poses in a row.
        DataError: a sphere was missed several times in a row, or the camera's temperature drifts.
        FileError: the session cannot be written.
        SettingsError: a pose looks at a sphere that the cell has not.
    """
    run = _Run(devices, cell, model or robot_model_of(cell), plan, writer, settings or settings_of(cell))
    try:
        yield from run.steps()
    except _Unheeded as unheeded:
        raise unheeded.error from unheeded.error.__cause__
    except BaseException as error:
        stop_after(devices.robot, error)
        raise


class _Interrupted(Exception):
    """No error: it unwinds a pose in hand."""

    def __init__(self, command: Pause | Skip | Redo | Stop) -> None:
        super().__init__()
        self.command = command


class _Unheeded(Exception):
    """An error that suspended the run, and nobody answered; the robot was stopped."""

    def __init__(self, error: SpherecalError) -> None:
        super().__init__()
        self.error = error


def _check_sphere(pose: PlannedPose, cell: Cell) -> None:
    if pose.sphere is not None and pose.sphere not in cell.spheres:
        known = ", ".join(cell.spheres) or "none"
        raise SettingsError(f"pose {pose.id} looks at sphere {pose.sphere!r}, which the cell has not", remedy=f"Spheres of the cell: {known}.")


class _Run:
    """State of one run."""

    def __init__(self, devices: Devices, cell: Cell, model: RobotModel | None, plan: Plan, writer: SessionWriter, settings: CaptureSettings) -> None:
        for pose in plan.poses:
            _check_sphere(pose, cell)
        self._devices, self._robot = devices, devices.robot
        self._cell, self._settings = cell, settings
        self._book, self._vigil = ShotBook(writer), Vigil(settings)
        self._poses = {pose.id: pose for pose in plan.poses}
        self._planned = frozenset(self._poses)
        self._queue = deque(pose for pose in plan.poses if not self._book.is_done(pose))
        self._n_begun = len(plan.poses) - len(self._queue)
        self._way = way_of(cell, model, plan.poses)
        self._taker = PoseTaker(devices, cell, model, self._way, self._book, self._vigil, settings, self._tell)
        self._state = RunState.READY
        self._is_located, self._is_cold = False, settings.warm_up is not None
        self._errors_in_a_row = self._n_left = 0

    def steps(self) -> Steps:
        """The run, from RunStarted to Finished."""
        command = yield from self._guarded(self._tell(RunStarted(n_poses=len(self._poses), n_done=self._n_begun)))
        while not isinstance(command, Stop):
            if command is not None:
                command = yield from self._guarded(self._after(command))
            elif self._queue:
                command = yield from self._guarded(self._next())
            else:
                break
        halt(self._robot, self._settings.motion)
        counts = self._book.counts
        n_left = self._n_left + len(self._queue) + (self._book.in_hand is not None)
        yield from self._yield(Finished(counts["ok"], counts["failed"], counts["skipped"], isinstance(command, Stop), n_left))

    def _guarded(self, steps: Steps) -> Generator[Event, Command | None, Pause | Skip | Redo | Stop | None]:
        """Go through steps; give the command that unwound them. An error that somebody may put right suspends the run."""
        while True:
            try:
                yield from steps
            except _Interrupted as interrupted:
                return interrupted.command
            except (RobotError, *SUSPENDING) as error:
                steps = self._suspend(error)
            else:
                return None

    def _yield(self, event: Event) -> Generator[Event, Command | None, Command | None]:
        if event.state not in FOLLOWERS[self._state]:
            msg = f"a run cannot go from {self._state} to {event.state}"
            raise RuntimeError(msg)
        self._state = event.state
        return (yield event)

    def _tell(self, event: Event) -> Steps:
        self._obey((yield from self._yield(event)))

    def _obey(self, command: Command | None) -> None:
        match command:
            case Append(pose):
                self._append(pose)
            case Finish():
                self._n_left += len(self._queue)
                self._queue.clear()
            case Redo() if self._book.last_taken is not None:
                if self._book.in_hand is not None and self._state is RunState.READY:
                    raise _Interrupted(command)
                self._take_next(self._book.last_taken)
            case Pause() | Skip() | Stop():
                raise _Interrupted(command)
            case _:
                pass

    def _append(self, pose: PlannedPose) -> None:
        _check_sphere(pose, self._cell)
        if pose.id not in self._poses:
            self._way.add(pose)
        self._poses.setdefault(pose.id, pose)
        self._queue.append(self._poses[pose.id])

    def _take_next(self, pose: PlannedPose) -> None:
        if pose not in self._queue:
            self._queue.appendleft(pose)

    def _next(self) -> Steps:
        """The next thing to do, of a queue that is not empty."""
        if not self._is_located:
            return self._locate()
        return self._warm_up() if self._is_cold else self._take(self._queue.popleft())

    def _locate(self) -> Steps:
        """Find out where the robot stands; told by nothing."""
        state = read_safely(self._robot)
        self._way.locate(state.joints_rad, self._settings.motion.arrival_tolerance_rad)
        self._is_located = True
        yield from ()

    def _warm_up(self) -> Steps:
        settings = self._settings.warm_up or WarmUpSettings()
        try:
            for event in warming_up(self._devices, settings, frame_timeout_s=self._settings.frame_timeout_s):
                yield from self._tell(event)
        except CameraTimeout:
            self._is_cold = False  # asked once; a Continue begins all the same
            raise
        self._is_cold = False

    def _after(self, command: Pause | Skip | Redo | Stop) -> Steps:
        """What a command asks for, the pose in hand unwound and the robot standing."""
        halt(self._robot, self._settings.motion)
        match command:
            case Pause():
                yield from self._pause()
            case Skip():
                yield from self._skip()
            case Redo() if self._book.last_taken is not None:
                self._put_back()
                self._take_next(self._book.last_taken)

    def _pause(self) -> Steps:
        while True:
            command = yield from self._yield(Paused(self._book.id_in_hand))
            if isinstance(command, Continue | Redo | Finish):
                break
            if not isinstance(command, Pause):
                self._obey(command)
            self._robot.wait(self._settings.motion.poll_s)
        self._go_on(command)

    def _suspend(self, error: SpherecalError) -> Steps:
        """Stop the robot and ask."""
        stop_after(self._robot, error)
        while True:
            command = yield from self._yield(Suspended(self._book.id_in_hand, cause_of(error), error))
            if command is None:
                raise _Unheeded(error)
            if isinstance(command, Continue | Redo | Finish):
                break
            if not isinstance(command, Pause):
                self._obey(command)
            self._robot.wait(self._settings.motion.poll_s)
        if not isinstance(command, Finish):
            self._put_right(error)
        self._go_on(command)

    def _go_on(self, command: Continue | Redo | Finish) -> None:
        """End a pause."""
        self._put_back()
        if not isinstance(command, Continue):
            self._obey(command)

    def _put_right(self, error: SpherecalError) -> None:
        """Somebody says that the trouble is over: open what was lost, see that it is the same, and that the robot may move.

        A camera is opened anew after whatever it was: that sets everything again, and no frame of an earlier trigger is left.
        """
        if isinstance(error, RobotNotReached):
            reopen_robot(self._robot, self._devices.identity)
        if isinstance(error, CameraError):
            reopen_camera(self._devices.camera, self._devices.identity)
            self._taker.camera_opened_anew()
        read_safely(self._robot)
        self._errors_in_a_row = 0
        self._vigil.forgive()

    def _put_back(self) -> None:
        pose = self._book.let_go()
        if pose is not None:
            self._queue.appendleft(pose)
            self._n_begun -= 1

    def _skip(self) -> Steps:
        pose = self._book.in_hand
        if pose is None:
            self._is_cold = False
            return
        shot = self._taker.skip(pose)
        yield from self._tell(Skipped(pose.id, shot))

    def _take(self, pose: PlannedPose) -> Steps:
        """One pose: move, settle, expose, record, judge."""
        self._book.in_hand = pose
        self._n_begun += 1
        yield from self._tell(PoseStarted(pose, self._n_begun, self._n_begun + len(self._queue)))
        try:
            stillness, exposure = yield from self._taker.reach_and_expose(pose, slowly=pose.id not in self._planned)
        except (MotionRefused, RobotUnsettled, CameraError) as error:
            self._errors_in_a_row += 1
            if self._errors_in_a_row >= self._settings.most_errors_in_a_row or not _is_of_the_pose(error):
                raise
            yield from self._taker.fail(pose, str(error))
            return
        self._errors_in_a_row = 0
        yield from self._taker.judge(pose, stillness, exposure)
        self._vigil.check()


def _is_of_the_pose(error: MotionRefused | RobotUnsettled | CameraError) -> bool:
    """Whether another pose may well go better; not where nobody may move the robot at all, or the camera is gone."""
    if isinstance(error, CameraError):
        return error.retryable
    return not isinstance(error, NotInRemoteControl | MotorsOff | ChannelTaken)
