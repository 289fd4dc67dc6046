"""The capture run: a generator that tells events and takes commands. It knows no screen and no solver.

    run = run_capture(devices, cell, plan, writer)
    event = next(run)
    while True:
        event = run.send(command or None)          # StopIteration after Finished

None means that nobody said anything. However the run ends, by its last pose, a Stop, an error, Ctrl-C or because the
caller lets go of the generator, the robot has been told to stop if it may be moving.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from acquire.capture_settings import CaptureSettings, planned_seconds, settings_of
from acquire.cell import Cell, robot_model_of
from acquire.events import (
    Append,
    Captured,
    Command,
    Continue,
    Event,
    Failed,
    Finished,
    Moved,
    Moving,
    Pause,
    Paused,
    PoseStarted,
    Redo,
    Retried,
    RunStarted,
    Settled,
    Skip,
    Skipped,
    Stop,
)
from acquire.exposure import Exposure, average, expose
from acquire.motion import RobotUnsettled, Stillness, change_rad, halt, measured_joints, move, read_safely, remaining_rad, settle, unsettled
from acquire.plan import Plan, PlannedPose
from acquire.session import SessionWriter
from acquire.sighting import base_from_flange_of, look_for, predicted_centre_in_camera_mm, prediction_error_mm
from acquire.sphere import SphereNotFound
from acquire.way import Way
from drivers.errors import CameraError, MotionRefused, SettingsError, SpherecalError
from drivers.files.shots import Shot
from drivers.kinematics.mdh import RobotModel
from drivers.protocols import Devices, Robot, RobotState

__all__ = ["CaptureSettings", "RobotUnsettled", "planned_seconds", "run_capture", "settings_of"]

FloatArray = NDArray[np.float64]
Steps = Generator[Event, Command | None, None]

_NO_MOTION_RAD = 1e-4


def run_capture(
    devices: Devices, cell: Cell, plan: Plan, writer: SessionWriter, settings: CaptureSettings | None = None, *, model: RobotModel | None = None
) -> Steps:
    """Take the poses of a plan; poses that the session holds with status ok are left out.

    Args:
        devices: opened; the run neither opens nor closes them.
        cell: spheres, first guess of the hand-eye, kind of camera.
        plan: the poses, in this order.
        writer: the session.
        settings: `settings_of(cell)` if None.
        model: the nominal robot, to predict where a sphere will be seen; the cell's if None.

    Raises:
        RobotError: the robot is late, stands elsewhere, is in a safety stop or gone (it was stopped as far as possible).
        CameraError: the camera is gone, set wrongly, or failed at several poses in a row.
        FileError: the session cannot be written.
        SettingsError: a pose looks at a sphere that the cell has not.
    """
    run = _Run(devices, cell, model or robot_model_of(cell), plan, writer, settings or settings_of(cell))
    try:
        yield from run.steps()
    except BaseException as error:
        _stop(devices.robot, error)
        raise


def _stop(robot: Robot, error: BaseException) -> None:
    """Stop a robot after an error, which stays the one that is told."""
    try:
        robot.stop()
    except SpherecalError as second:
        error.add_note(f"and the robot could not be stopped: {second}")


class _Interrupted(Exception):
    """No error: it unwinds a pose in hand."""

    def __init__(self, command: Pause | Skip | Stop) -> None:
        super().__init__()
        self.command = command


def _check_sphere(pose: PlannedPose, cell: Cell) -> None:
    if pose.sphere is not None and pose.sphere not in cell.spheres:
        known = ", ".join(cell.spheres) or "none"
        raise SettingsError(f"pose {pose.id} looks at sphere {pose.sphere!r}, which the cell has not", remedy=f"Spheres of the cell: {known}.")


class _Run:
    """State of one run."""

    def __init__(
        self, devices: Devices, cell: Cell, model: RobotModel | None, plan: Plan, writer: SessionWriter, settings: CaptureSettings
    ) -> None:
        for pose in plan.poses:
            _check_sphere(pose, cell)
        self._robot, self._camera = devices.robot, devices.camera
        self._cell, self._model, self._writer, self._settings = cell, model, writer, settings
        self._last_by_id: dict[str, Shot] = {shot.pose_id: shot for shot in writer.shots if shot.pose_id is not None}
        self._poses = {pose.id: pose for pose in plan.poses}
        self._queue = deque(pose for pose in plan.poses if not self._is_done(pose))
        self._n_begun = len(plan.poses) - len(self._queue)
        self._way = Way(plan.poses)
        self._in_hand: PlannedPose | None = None
        self._last_taken: PlannedPose | None = None
        self._approach: FloatArray | None = None
        self._errors_in_a_row = 0
        self._sequence = -1
        self._counts = {"ok": 0, "failed": 0, "skipped": 0}

    def steps(self) -> Steps:
        """The run, from RunStarted to Finished."""
        command = yield from self._guarded(self._begin())
        while not isinstance(command, Stop):
            if isinstance(command, Pause):
                halt(self._robot, self._settings.motion)
                command = yield from self._guarded(self._pause())
            elif isinstance(command, Skip):
                halt(self._robot, self._settings.motion)
                command = yield from self._guarded(self._skip())
            elif self._queue:
                command = yield from self._guarded(self._take(self._queue.popleft()))
            else:
                break
        halt(self._robot, self._settings.motion)
        yield Finished(self._counts["ok"], self._counts["failed"], self._counts["skipped"], stopped=isinstance(command, Stop))

    def _guarded(self, steps: Steps) -> Generator[Event, Command | None, Pause | Skip | Stop | None]:
        try:
            yield from steps
        except _Interrupted as interrupted:
            return interrupted.command
        return None

    def _tell(self, event: Event) -> Steps:
        self._obey((yield event))

    def _obey(self, command: Command | None) -> None:
        match command:
            case Append(pose):
                self._append(pose)
            case Redo():
                if self._last_taken is not None and self._last_taken not in self._queue:
                    self._queue.appendleft(self._last_taken)
            case Pause() | Skip() | Stop():
                raise _Interrupted(command)
            case Continue() | None:
                pass

    def _append(self, pose: PlannedPose) -> None:
        _check_sphere(pose, self._cell)
        if pose.id not in self._poses:
            self._way.add(pose)
        self._poses.setdefault(pose.id, pose)
        self._queue.append(self._poses[pose.id])

    def _is_done(self, pose: PlannedPose) -> bool:
        shot = self._last_by_id.get(pose.id)
        return shot is not None and shot.status == "ok"

    def _begin(self) -> Steps:
        state = read_safely(self._robot)
        self._way.locate(state.joints_rad, self._settings.motion.arrival_tolerance_rad)
        yield from self._tell(RunStarted(n_poses=len(self._poses), n_done=self._n_begun))

    def _pause(self) -> Steps:
        while True:
            command = yield Paused(None if self._in_hand is None else self._in_hand.id)
            if isinstance(command, Continue):
                break
            if not isinstance(command, Pause):
                self._obey(command)
            self._robot.wait(self._settings.motion.poll_s)
        if self._in_hand is not None:
            self._queue.appendleft(self._in_hand)
            self._in_hand = None
            self._n_begun -= 1

    def _skip(self) -> Steps:
        pose, self._in_hand = self._in_hand, None
        if pose is None:
            return
        shot = self._record(pose, status="skipped", reason="skipped by the operator")
        yield from self._tell(Skipped(pose.id, shot))

    def _take(self, pose: PlannedPose) -> Steps:
        """One pose: move, settle, expose, record, judge."""
        self._in_hand = pose
        self._n_begun += 1
        yield from self._tell(PoseStarted(pose, self._n_begun, self._n_begun + len(self._queue)))
        try:
            yield from self._go(pose)
            stillness = settle(self._robot, self._settings.motion)
            if not stillness.settled:
                raise unsettled(stillness)
            yield from self._tell(Settled(pose.id, stillness.stillness_rad, stillness.seconds))
            exposure = yield from self._expose(pose)
        except (MotionRefused, RobotUnsettled, CameraError) as error:
            self._errors_in_a_row += 1
            if self._errors_in_a_row >= self._settings.most_errors_in_a_row or not _is_of_the_pose(error):
                raise
            yield from self._fail(pose, str(error))
            return
        self._errors_in_a_row = 0
        yield from self._judge(pose, stillness, exposure)

    def _go(self, pose: PlannedPose) -> Steps:
        begin = last = read_safely(self._robot)
        for target in self._way.to(pose):
            self._note_approach(last, target)
            for state in move(self._robot, target, self._settings.motion):
                last = state
                yield from self._tell(Moving(pose.id, state.joints_rad, remaining_rad(state, target)))
        yield from self._tell(Moved(pose.id, last.joints_rad, last.time_s - begin.time_s))

    def _note_approach(self, state: RobotState, target_rad: FloatArray) -> None:
        """From which side each axis comes: what backlash depends on."""
        if state.joints_rad is None:
            return
        before = np.zeros(len(target_rad)) if self._approach is None else self._approach
        distance = target_rad - state.joints_rad
        self._approach = np.where(np.abs(distance) > _NO_MOTION_RAD, np.sign(distance), before)

    def _expose(self, pose: PlannedPose) -> Generator[Event, Command | None, Exposure]:
        exposure = Exposure()
        while len(exposure.frames) < self._settings.frames:
            try:
                exposure = expose(self._camera, exposure, after=self._sequence, timeout_s=self._settings.frame_timeout_s)
            except CameraError as error:
                if not error.retryable or exposure.retried:
                    raise
                exposure = exposure.with_retry()
                yield from self._tell(Retried(pose.id, str(error)))
            else:
                self._sequence = exposure.frames[-1].sequence
        return exposure

    def _judge(self, pose: PlannedPose, before: Stillness, exposure: Exposure) -> Steps:
        """Look for the sphere and record the shot, good or not."""
        after = read_safely(self._robot)
        xyz_mm = average(exposure.frames)
        joints_rad = measured_joints(before, after)
        moved = change_rad(after, before.last)
        if moved > self._settings.motion.still_tolerance_rad or after.moving:
            yield from self._fail(pose, f"the robot moved by {moved:.2g} rad during the exposure", before, exposure, xyz_mm)
            return
        flange = base_from_flange_of(self._model, joints_rad, before.last.base_from_flange)
        predicted = predicted_centre_in_camera_mm(self._cell, pose.sphere, flange)
        try:
            finding = None if pose.sphere is None else look_for(self._cell, pose.sphere, xyz_mm, predicted, self._settings.sphere)
        except SphereNotFound as error:
            yield from self._fail(pose, f"{error.reason}: {error}", before, exposure, xyz_mm)
            return
        shot = self._record(pose, before=before, joints_rad=joints_rad, exposure=exposure, xyz_mm=xyz_mm)
        yield from self._tell(Captured(pose.id, shot, xyz_mm, finding, prediction_error_mm(finding, predicted)))

    def _fail(
        self,
        pose: PlannedPose,
        reason: str,
        before: Stillness | None = None,
        exposure: Exposure | None = None,
        xyz_mm: NDArray[np.float32] | None = None,
    ) -> Steps:
        joints = None if before is None else before.joints_rad
        shot = self._record(pose, status="failed", reason=reason, before=before, joints_rad=joints, exposure=exposure, xyz_mm=xyz_mm)
        yield from self._tell(Failed(pose.id, reason, shot, xyz_mm))

    def _record(
        self,
        pose: PlannedPose,
        *,
        status: str = "ok",
        reason: str | None = None,
        before: Stillness | None = None,
        joints_rad: FloatArray | None = None,
        exposure: Exposure | None = None,
        xyz_mm: NDArray[np.float32] | None = None,
    ) -> Shot:
        """Put the pose's shot on disk. It takes the place of an earlier one, but no failure that of a good shot."""
        earlier = self._last_by_id.get(pose.id)
        if earlier is not None and earlier.status == "ok" and status != "ok":
            earlier = None
        frames = () if exposure is None else exposure.frames
        shot = self._writer.append(
            sphere=pose.sphere,
            joints_rad=joints_rad,
            base_from_flange=None if before is None else before.last.base_from_flange,
            xyz_mm=xyz_mm,
            intensity=frames[0].intensity if len(frames) == 1 else None,
            frames_xyz_mm=[frame.xyz_mm for frame in frames] if len(frames) > 1 else (),
            status=status,
            reason=reason,
            pose_id=pose.id,
            replaces=None if earlier is None else earlier.index,
            target_joints_rad=pose.joints_rad,
            stillness_rad=None if before is None else before.stillness_rad,
            temperatures_c=frames[-1].temperatures_c if frames else None,
            approach=None if before is None else self._approach,
        )
        if status == "ok" or not self._is_done(pose):
            self._last_by_id[pose.id] = shot
        self._counts[status] += 1
        self._in_hand, self._last_taken = None, pose
        return shot


def _is_of_the_pose(error: MotionRefused | RobotUnsettled | CameraError) -> bool:
    """Whether another pose may well go better."""
    return not isinstance(error, CameraError) or error.retryable
