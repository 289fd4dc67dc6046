"""One pose of a capture run: go there, settle, expose, look for the sphere, record."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from acquire.capture_settings import CaptureSettings
from acquire.capture_shots import ShotBook, Take
from acquire.capture_vigil import Vigil
from acquire.cell import Cell
from acquire.events import Captured, Command, Event, Failed, Moved, Moving, Retried, Settled
from acquire.exposure import Exposure, average, expose
from acquire.motion import MotionSettings, Stillness, change_rad, measured_joints, move, read_safely, remaining_rad, settle, unsettled
from acquire.plan import PlannedPose
from acquire.sighting import base_from_flange_of, look_for, predicted_centre_in_camera_mm, prediction_error_mm
from acquire.sphere import SphereNotFound
from acquire.way import Way
from drivers.errors import CameraError
from drivers.files.shots import Shot
from drivers.kinematics.mdh import RobotModel
from drivers.protocols import Devices, RobotState

FloatArray = NDArray[np.float64]
Steps = Generator[Event, Command | None, None]
Tell = Callable[[Event], Steps]
"""Tells an event and obeys the answer, which may raise."""

_NO_MOTION_RAD = 1e-4


class PoseTaker:
    """Takes one pose after the other, from wherever the robot stands."""

    def __init__(
        self, devices: Devices, cell: Cell, model: RobotModel | None, way: Way, book: ShotBook, vigil: Vigil, settings: CaptureSettings, tell: Tell
    ) -> None:
        self._robot, self._camera = devices.robot, devices.camera
        self._cell, self._model, self._way, self._book, self._vigil = cell, model, way, book, vigil
        self._settings, self._tell = settings, tell
        self._approach: FloatArray | None = None
        self._sequence = -1

    def reach_and_expose(self, pose: PlannedPose, *, slowly: bool) -> Generator[Event, Command | None, tuple[Stillness, Exposure]]:
        """Everything that needs robot and camera.

        Raises:
            RobotError: as `acquire.motion` does, RobotUnsettled too.
            CameraError: the exposure failed, twice where it could be repeated.
        """
        yield from self._go(pose, self._motion(slowly))
        stillness = settle(self._robot, self._settings.motion)
        if not stillness.settled:
            raise unsettled(stillness)
        yield from self._tell(Settled(pose.id, stillness.stillness_rad, stillness.seconds))
        exposure = yield from self._expose(pose)
        return stillness, exposure

    def judge(self, pose: PlannedPose, before: Stillness, exposure: Exposure) -> Steps:
        """Look for the sphere and record the shot, good or not."""
        after = read_safely(self._robot)
        xyz_mm = average(exposure.frames)
        take = Take(before, measured_joints(before, after), exposure, xyz_mm, self._approach)
        moved = change_rad(after, before.last)
        if moved > self._settings.motion.still_tolerance_rad or after.moving:
            yield from self._fail(pose, f"the robot moved by {moved:.2g} rad during the exposure", replace(take, joints_rad=before.joints_rad))
            return
        flange = base_from_flange_of(self._model, take.joints_rad, before.last.base_from_flange)
        predicted = predicted_centre_in_camera_mm(self._cell, pose.sphere, flange)
        try:
            finding = None if pose.sphere is None else look_for(self._cell, pose.sphere, xyz_mm, predicted, self._settings.sphere)
        except SphereNotFound as error:
            self._vigil.note_missing(pose)
            yield from self._fail(pose, f"{error.reason}: {error}", replace(take, joints_rad=before.joints_rad))
            return
        shot = self._book.record(pose, take)
        self._vigil.note_good(pose, shot.temperatures_c or {})
        yield from self._tell(Captured(pose.id, shot, xyz_mm, finding, prediction_error_mm(finding, predicted)))

    def fail(self, pose: PlannedPose, reason: str) -> Steps:
        """Record a pose of which there is nothing."""
        yield from self._fail(pose, reason, Take())

    def skip(self, pose: PlannedPose) -> Shot:
        """Record a pose that somebody skipped."""
        return self._book.record(pose, Take(), status="skipped", reason="skipped by the operator")

    def _fail(self, pose: PlannedPose, reason: str, take: Take) -> Steps:
        shot = self._book.record(pose, take, status="failed", reason=reason)
        yield from self._tell(Failed(pose.id, reason, shot, take.xyz_mm))

    def _motion(self, slowly: bool) -> MotionSettings:
        motion = self._settings.motion
        return replace(motion, speed_rad_s=min(motion.speed_rad_s, self._settings.first_speed_rad_s)) if slowly else motion

    def _go(self, pose: PlannedPose, motion: MotionSettings) -> Steps:
        begin = last = read_safely(self._robot)
        for target in self._way.to(pose, begin.joints_rad):
            self._note_approach(last, target)
            for state in move(self._robot, target, motion):
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

    def camera_opened_anew(self) -> None:
        """Its frames are counted from the beginning again."""
        self._sequence = -1
