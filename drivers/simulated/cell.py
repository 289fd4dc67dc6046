"""One simulated cell: the truth, a clock, and where the robot's axes stand. Robot and camera drivers share it.

In instant mode nothing sleeps: the clock moves by `wait`, by exposures and a little with every reading, so that a
program that polls sees time pass. Otherwise the clock is the computer's own.

Random numbers depend on the seed, the run, the count of the motion or frame and the place it belongs to, never on how
often the robot was read: two programs that do the same see the same, and another pose sees other noise.
"""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.errors import FileError
from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.robot_physics import StopNoise, check_axes, draw_stop_noise, no_noise, true_base_from_flange
from drivers.simulated.scene import Mesh, mesh_of
from drivers.simulated.truth import Truth, mesh_path

_STREAM_STOP, _STREAM_ENCODER, _STREAM_FRAME = 1, 2, 3
_STILL_RAD = 1e-12
_NAME_A_MESH = "Name a mesh file in mm, `stepped_block` or `machined_part`."


@dataclass(frozen=True, slots=True)
class Axes:
    """Where the axes of a cell stand or move, as plain numbers that go over a wire unchanged."""

    clock_s: float
    start_rad: tuple[float, ...]
    target_rad: tuple[float, ...]
    start_s: float
    duration_s: float
    ramp_s: float
    approach: tuple[float, ...]
    n_motions: int
    asked_rad: tuple[float, ...]
    """Target that the last motion was started with: its stop noise hangs on it."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A synchronous motion of all axes with a trapezoid of speed."""

    start_rad: FloatArray
    target_rad: FloatArray
    start_s: float
    duration_s: float
    ramp_s: float

    @classmethod
    def between(cls, start_rad: FloatArray, target_rad: FloatArray, *, start_s: float, speed_rad_s: float, acceleration_rad_s2: float) -> Motion:
        """The quickest motion whose fastest axis keeps to speed and acceleration."""
        distance = float(np.abs(target_rad - start_rad).max())
        ramp_s = min(speed_rad_s / acceleration_rad_s2, float(np.sqrt(distance / acceleration_rad_s2)))
        cruise = acceleration_rad_s2 * ramp_s
        duration_s = distance / cruise + ramp_s if cruise > 0 else 0.0
        return cls(start_rad, target_rad, start_s, duration_s, ramp_s)

    def joints_rad(self, time_s: float) -> FloatArray:
        """Commanded axis angles (n,) at a time of the clock."""
        if not self.running(time_s):
            return self.target_rad
        total, ramp, t = self.duration_s, self.ramp_s, max(time_s - self.start_s, 0.0)
        # distance over cruising speed: parabola, line, parabola
        if t < ramp:
            way = t * t / (2 * ramp)
        elif t > total - ramp:
            way = (total - ramp) - (total - t) ** 2 / (2 * ramp)
        else:
            way = t - ramp / 2
        return np.asarray(self.start_rad + (self.target_rad - self.start_rad) * (way / (total - ramp)))

    def running(self, time_s: float) -> bool:
        """Whether the target is still ahead."""
        return time_s < self.start_s + self.duration_s


class SimulatedCell:
    """Truth, clock and axes; makes no file access before the first frame that needs a workpiece mesh.

    Args:
        truth: The hidden truth.
        model: The nominal robot, which the controller and everybody else believes in.
        folder: Where a workpiece's mesh file is looked for.
        instant: Whether time passes on a clock of its own instead of the computer's.
        run: Another number gives other noise with the same systematic errors.
        clock_start_s: The clock's first reading; drift goes by the clock.

    Raises:
        SettingsError: the truth was made for another number of axes.
    """

    def __init__(
        self,
        truth: Truth,
        model: RobotModel,
        *,
        folder: Path | None = None,
        instant: bool = True,
        run: int = 0,
        clock_start_s: float = 0.0,
    ) -> None:
        check_axes(model, truth.robot)
        self.truth, self.model = truth, model
        self._folder, self._instant, self._run = folder or Path(), instant, run
        self._clock_s = clock_start_s
        self._real_start_s = time.monotonic()
        self._mesh: Mesh | None = None
        self.reset()

    def reset(self) -> None:
        """Put the axes where they stood at first, as if the robot had never moved; the clock goes on."""
        home = _home(self.truth, self.model)
        self._motion = Motion(home, home, self.clock_s, 0.0, 0.0)
        self._approach = np.zeros(self.model.n_joints)
        self._n_motions = 0
        self._n_readings = 0
        self._asked = home
        self._noise: StopNoise = no_noise(self.model)

    @property
    def clock_s(self) -> float:
        """Now, on the cell's clock."""
        return self._clock_s if self._instant else self._clock_s + time.monotonic() - self._real_start_s

    @property
    def hours(self) -> float:
        """Now, in hours, for everything that drifts."""
        return self.clock_s / 3600.0

    @property
    def approach(self) -> FloatArray:
        """(n,) sign of the last motion of each axis, 0 where it never moved."""
        return self._approach.copy()

    def advance(self, seconds: float) -> None:
        """Let time pass: on the clock alone in instant mode, by sleeping otherwise."""
        if self._instant:
            self._clock_s += max(seconds, 0.0)
        elif seconds > 0:
            time.sleep(seconds)

    def joints_rad(self) -> FloatArray:
        """(n,) commanded axis angles now."""
        return self._motion.joints_rad(self.clock_s).copy()

    def read_joints_rad(self) -> FloatArray:
        """(n,) axis angles as the encoders give them now; every reading is a fresh one."""
        self._n_readings += 1
        noise = self.truth.robot.encoder_noise_rad
        rng = self.rng(_STREAM_ENCODER, self._n_readings)
        return np.asarray(self.joints_rad() + noise * rng.standard_normal(self.model.n_joints))

    def moving(self) -> bool:
        """Whether a motion is under way now."""
        return self._motion.running(self.clock_s)

    def start_motion(self, target_rad: ArrayLike, *, speed_rad_s: float) -> None:
        """Begin a motion from where the axes are now; limits are the robot driver's business."""
        target = np.array(target_rad, dtype=np.float64)
        now = self.joints_rad()
        way = target - now
        self._approach = np.where(np.abs(way) > _STILL_RAD, np.sign(way), self._approach)
        self._motion = Motion.between(
            now, target, start_s=self.clock_s, speed_rad_s=speed_rad_s, acceleration_rad_s2=self.truth.robot.acceleration_rad_s2
        )
        self._n_motions += 1
        self._asked = target
        self._noise = self._stop_noise()

    def stop_motion(self) -> None:
        """Stand still at once, where the axes are."""
        now = self.joints_rad()
        self._motion = Motion(now, now, self.clock_s, 0.0, 0.0)

    def axes(self) -> Axes:
        """What another process needs to show the same robot."""
        motion = self._motion
        start, target, approach, asked = (tuple(row.tolist()) for row in (motion.start_rad, motion.target_rad, self._approach, self._asked))
        return Axes(self.clock_s, start, target, motion.start_s, motion.duration_s, motion.ramp_s, approach, self._n_motions, asked)

    def take_axes(self, axes: Axes) -> None:
        """Let the axes, and in instant mode the clock, be those of another cell with the same truth and model."""
        if self._instant:
            self._clock_s = axes.clock_s
        start, target = np.array(axes.start_rad), np.array(axes.target_rad)
        self._motion = Motion(start, target, self.clock_s - axes.clock_s + axes.start_s, axes.duration_s, axes.ramp_s)
        self._approach, self._asked, self._n_motions = np.array(axes.approach), np.array(axes.asked_rad), axes.n_motions
        self._noise = self._stop_noise() if axes.n_motions else no_noise(self.model)

    def _stop_noise(self) -> StopNoise:
        return draw_stop_noise(self.model, self.truth.robot, self.rng(_STREAM_STOP, self._n_motions, self._asked))

    def true_base_from_flange(self) -> FloatArray:
        """(4, 4) where the flange truly is now."""
        return true_base_from_flange(self.model, self.truth.robot, self.joints_rad(), approach=self._approach, hours=self.hours, noise=self._noise)

    def true_base_from_camera(self) -> FloatArray:
        """(4, 4) where the camera truly is now."""
        return np.asarray(self.true_base_from_flange() @ np.array(self.truth.camera.flange_from_camera))

    def mesh(self) -> Mesh | None:
        """The workpiece, loaded at the first call.

        Raises:
            FileError: its mesh file is missing or no mesh.
        """
        if self._mesh is None and self.truth.workpiece is not None:
            self._mesh = mesh_of(*_mesh_data(self.truth, self._folder))
        return self._mesh

    def frame_rng(self, sequence: int) -> np.random.Generator:
        """The random numbers of one exposure from where the robot stands."""
        return self.rng(_STREAM_FRAME, sequence, self.joints_rad())

    def rng(self, stream: int, count: int, place: FloatArray | None = None) -> np.random.Generator:
        """A generator of its own for one event: seed, run, kind and count of the event, and its place."""
        digest = hashlib.sha256(b"" if place is None else np.round(place, 9).tobytes()).digest()
        return np.random.default_rng([self.truth.seed, self._run, stream, count, int.from_bytes(digest[:8], "little")])


def _home(truth: Truth, model: RobotModel) -> FloatArray:
    if truth.robot.home_rad:
        return np.array(truth.robot.home_rad)
    zero = np.zeros(model.n_joints)
    limits = np.nan_to_num(model.joint_limits_rad, posinf=0.0, neginf=0.0)
    return zero if bool(mdh.within_limits(model, zero)) else np.asarray(limits.mean(axis=1))


def _mesh_data(truth: Truth, folder: Path) -> tuple[FloatArray, NDArray[np.int32]]:
    from drivers.simulated.workpiece import stepped_block
    from drivers.simulated.workpiece_machined import MachinedPart

    if truth.workpiece is None or truth.workpiece.mesh == "stepped_block":
        return stepped_block()
    if truth.workpiece.mesh == "machined_part":
        return MachinedPart().mesh()
    import trimesh

    path = mesh_path(truth.workpiece, folder)
    try:
        mesh = trimesh.load_mesh(path)
        vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int32)
    except (OSError, ValueError, AttributeError, NotImplementedError) as error:
        raise FileError(f"cannot be read as a mesh ({error})", file=path, remedy=_NAME_A_MESH) from error
    if len(faces) == 0:
        raise FileError("holds no mesh", file=path, remedy=_NAME_A_MESH)
    return vertices, faces
