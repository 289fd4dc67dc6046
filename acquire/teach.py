"""Poses taught by a person who leads the arm by hand, or jogs it: a generator that tells what it sees and takes commands.

    run = run_teach(devices, cell, settings)
    event = next(run)
    while True:
        event = run.send(command or None)          # StopIteration after Taught

The arm is soft only while nothing else is done: it is held again before a pose is recorded or the arm is jogged, and
however the run ends, by Finish, an error, Ctrl-C or because the caller lets go of the generator.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field

import numpy as np

from acquire.cell import Cell, robot_model_of
from acquire.collision import CollisionCheck, cell_collisions
from acquire.exposure import Exposure, expose
from acquire.motion import MotionSettings, Stillness, halt, move, read_safely, settle
from acquire.plan import PlannedPose
from acquire.sighting import base_from_flange_of, look_for, predicted_centre_in_camera_mm
from acquire.sphere import ArcFinding, SphereFinding, SphereNotFound, SphereSettings
from acquire.sweep import swept_ways
from acquire.teach_events import Finish, Guide, Jog, Looked, NextSphere, Record, Recorded, Taught, TeachCommand, TeachEvent, Told, Via
from drivers.errors import CameraTimeout, InvalidFrame, MotionRefused, SafetyStop, SettingsError
from drivers.kinematics.mdh import RobotModel, within_limits
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import Devices, HandGuided, RobotState

_ALIKE_RAD = np.radians(4.0)


@dataclass(frozen=True, slots=True)
class TeachSettings:
    """How poses are taught."""

    guided: bool = True
    """Lead the arm by hand, where the robot can; otherwise it is jogged, at its pendant or by `Jog`."""
    motion: MotionSettings = field(default_factory=lambda: MotionSettings(speed_rad_s=0.1))
    """Of jogging, and how long the arm has to stand before a pose is recorded."""
    frame_timeout_s: float = 10.0
    sphere: SphereSettings = field(default_factory=SphereSettings)
    sphere_name: str | None = None
    """The sphere to look at first; None: the one that the camera looks at, as far as the cell file tells."""


Lesson = Generator[TeachEvent, "TeachCommand | None", None]


def run_teach(devices: Devices, cell: Cell, settings: TeachSettings, *, model: RobotModel | None = None) -> Lesson:
    """Teach poses; every command is answered by at least one event.

    Args:
        devices: opened.
        cell: spheres, hand-eye guess, obstacles.
        settings: how.
        model: the nominal robot; the cell's if None.

    Raises:
        SettingsError: the robot cannot be led by hand though that was asked for, there is no such sphere, or the robot
            does not report axis angles, of which plans are made.
        RobotError: the robot is gone, or does not stop.
        CameraError: the camera is gone or set wrongly.
    """
    lesson = _Lesson(devices, cell, settings, model or robot_model_of(cell))
    try:
        yield from lesson.steps()
    finally:
        lesson.hold()


def aimed_sphere(cell: Cell, base_from_flange: FloatArray | None) -> str | None:
    """The sphere nearest to the middle of the view by the cell's places and first guess; the first one where they are unknown."""
    angles: dict[str, float] = {}
    for name in cell.spheres:
        centre = predicted_centre_in_camera_mm(cell, name, base_from_flange)
        if centre is not None:
            angles[name] = float(np.arctan2(np.hypot(centre[0], centre[1]), centre[2]))
    return min(angles, key=lambda name: angles[name]) if angles else next(iter(cell.spheres), None)


class _Lesson:
    """State of one lesson."""

    def __init__(self, devices: Devices, cell: Cell, settings: TeachSettings, model: RobotModel | None) -> None:
        self._robot, self._camera = devices.robot, devices.camera
        self._cell, self._settings, self._model = cell, settings, model
        self._blocked: CollisionCheck | None = None if model is None else cell_collisions(cell, model)
        self._guided = False
        self._chosen = settings.sphere_name
        if self._chosen is not None and self._chosen not in cell.spheres:
            raise SettingsError(f"there is no sphere {self._chosen!r}", where="--sphere", remedy=f"Spheres of the cell: {', '.join(cell.spheres)}.")
        self._poses: list[PlannedPose] = []
        self._via: list[FloatArray] = []
        self._sequence = -1

    def steps(self) -> Lesson:
        if self._settings.guided:
            self._guide()
        while True:
            command = yield self._look()
            if isinstance(command, Finish):
                yield Taught(tuple(self._poses))
                return
            if command is not None:
                yield self._answer(command)

    def hold(self) -> None:
        """Make the arm stiff; a second time where the first was interrupted."""
        if not self._guided or not isinstance(self._robot, HandGuided):
            return
        try:
            self._robot.end_freedrive()
        except BaseException:
            self._robot.end_freedrive()
            raise
        finally:
            self._guided = False

    def _guide(self) -> None:
        if not isinstance(self._robot, HandGuided):
            message = "this robot cannot be led by hand through its driver"
            raise SettingsError(message, where="robot.driver", remedy="Jog it: at its pendant with --held, or with --jog.")
        # set first: an interrupt while the arm is going soft must make it stiff again
        self._guided = True
        self._robot.start_freedrive()

    def _look(self) -> Looked:
        """The robot's and the camera's word now; trouble that may pass is told, not raised."""
        joints = sphere = None
        try:
            state = read_safely(self._robot)
            joints = state.joints_rad
            sphere = self._sphere(state)
            finding, reason = self._find(state, sphere)
        except SafetyStop as stop:
            # the controller holds the arm by itself
            self.hold()
            finding, reason = None, f"the robot is stopped: {stop.message}"
        alike = None if joints is None else next((p.id for p in self._poses if np.abs(p.joints_rad - joints).max() < _ALIKE_RAD), None)
        return Looked(joints, sphere, finding, reason, self._guided, alike, tuple(self._poses), len(self._via))

    def _sphere(self, state: RobotState) -> str | None:
        return self._chosen or aimed_sphere(self._cell, base_from_flange_of(self._model, state.joints_rad, state.base_from_flange))

    def _find(self, state: RobotState, sphere: str | None) -> tuple[SphereFinding | ArcFinding | None, str | None]:
        try:
            exposure = expose(self._camera, Exposure(), after=self._sequence, timeout_s=self._settings.frame_timeout_s)
        except (CameraTimeout, InvalidFrame) as error:
            return None, f"no picture: {error.message}"
        frame = exposure.frames[-1]
        self._sequence = frame.sequence
        if sphere is None:
            return None, "the cell has no sphere"
        pose = base_from_flange_of(self._model, state.joints_rad, state.base_from_flange)
        predicted = predicted_centre_in_camera_mm(self._cell, sphere, pose)
        try:
            return look_for(self._cell, sphere, frame.xyz_mm, predicted, self._settings.sphere), None
        except SphereNotFound as error:
            return None, error.message

    def _answer(self, command: TeachCommand) -> TeachEvent:
        match command:
            case Record(anyway=anyway):
                return self._held(lambda: self._record(anyway))
            case Via():
                return self._held(self._keep_via)
            case Jog(axis=axis, by_rad=by_rad):
                return self._held(lambda: self._jog(axis, by_rad))
            case Guide(on=on):
                return self._switch(on)
            case NextSphere():
                return self._next_sphere()
            case _:
                return self._undo()

    def _held(self, act: Callable[[], TeachEvent]) -> TeachEvent:
        """Do something with the arm held, then let it be led again; a stop or a refusal is told."""
        was_guided = self._guided
        self.hold()
        try:
            event = act()
        except (SafetyStop, MotionRefused) as error:
            return Told(f"{error.message}. {error.remedy or ''}".rstrip())
        if was_guided:
            self._guide()
        return event

    def _switch(self, on: bool) -> TeachEvent:
        self.hold()
        if not on:
            return Told("the arm is held")
        try:
            self._guide()
        except (SafetyStop, MotionRefused, SettingsError) as error:
            self.hold()
            return Told(f"{error.message}. {error.remedy or ''}".rstrip())
        return Told("the arm can be led by hand")

    def _record(self, anyway: bool) -> TeachEvent:
        stillness = settle(self._robot, self._settings.motion)
        refusal = self._refusal(stillness)
        if refusal is not None or stillness.joints_rad is None:
            return Told(f"not kept: {refusal}")
        sphere = self._sphere(stillness.last)
        finding, reason = self._find(stillness.last, sphere)
        if finding is None and not anyway:
            return Told(f"not kept: {reason} (f keeps it anyway)")
        pose = PlannedPose(self._next_id(), sphere, stillness.joints_rad.round(6), tuple(self._via))
        touches = self._touches(pose)
        self._poses.append(pose)
        self._via = []
        return Recorded(pose, finding, touches)

    def _keep_via(self) -> TeachEvent:
        stillness = settle(self._robot, self._settings.motion)
        refusal = self._refusal(stillness)
        if refusal is not None or stillness.joints_rad is None:
            return Told(f"not kept: {refusal}")
        self._via.append(stillness.joints_rad.round(6))
        return Told(f"point {len(self._via)} on the way to the next pose is kept")

    def _refusal(self, stillness: Stillness) -> str | None:
        """Why these readings make no pose of a plan."""
        if not stillness.settled:
            return f"the arm still moves by {stillness.stillness_rad:.2g} rad"
        if stillness.joints_rad is None:
            raise SettingsError("the robot does not report axis angles, of which plans are made", remedy="Plan poses in another way, or import them.")
        if self._model is not None and not within_limits(self._model, stillness.joints_rad):
            return f"an axis is outside the limits of {self._model.name}"
        return None

    def _next_id(self) -> str:
        taken = {pose.id for pose in self._poses}
        return next(name for i in range(1, len(taken) + 2) if (name := f"t{i:03d}") not in taken)

    def _touches(self, pose: PlannedPose) -> bool:
        """Whether the straight lines in axis angles from the pose before, which a run drives, touch something known."""
        if self._blocked is None:
            return False
        return any(way.touches.any() for way in swept_ways([*self._poses[-1:], pose], self._blocked)[-1:])

    def _undo(self) -> TeachEvent:
        if self._via:
            self._via.pop()
            return Told("the last point of the way is forgotten")
        if not self._poses:
            return Told("there is nothing to undo")
        pose = self._poses.pop()
        self._via = list(pose.via_rad)
        return Told(f"pose {pose.id} is forgotten")

    def _next_sphere(self) -> TeachEvent:
        names = list(self._cell.spheres)
        if not names:
            return Told("the cell has no sphere")
        now = names.index(self._chosen) if self._chosen in names else -1
        self._chosen = names[(now + 1) % len(names)]
        return Told(f"looking for sphere {self._chosen}")

    def _jog(self, axis: int, by_rad: float) -> TeachEvent:
        """Move one axis at low speed; the arm is stopped however this ends early."""
        state = read_safely(self._robot)
        if state.joints_rad is None or not 0 <= axis < len(state.joints_rad):
            return Told(f"the robot has no axis {axis + 1} that can be moved")
        target = state.joints_rad + by_rad * np.eye(len(state.joints_rad))[axis]
        if self._model is not None and not within_limits(self._model, target):
            return Told(f"axis {axis + 1} would leave the limits of {self._model.name}")
        if self._blocked is not None and self._blocked(target[None])[0] and not self._blocked(state.joints_rad[None])[0]:
            return Told(f"not moved: at {np.degrees(target[axis]):.1f} degrees of axis {axis + 1} something would touch")
        try:
            for _ in move(self._robot, target, self._settings.motion):
                pass
        except BaseException:
            halt(self._robot, self._settings.motion)
            raise
        return Told(f"axis {axis + 1} at {np.degrees(target[axis]):.2f} degrees")
