"""The simulated robot: what its controller would say, and motions on the cell's clock.

The controller knows only the nominal model: it reports the commanded axis angles (with encoder noise, where set) and
their nominal flange pose, never the true one. Not modelled: braking distance, blending, collisions, safety stops.
"""

from __future__ import annotations

import numpy as np

from drivers.errors import MotionRefused, RobotNotReached
from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import RobotInfo, RobotState
from drivers.simulated.cell import SimulatedCell

_READING_S = 0.002


class SimulatedRobot:
    """A robot of the `Robot` protocol on a simulated cell."""

    def __init__(self, cell: SimulatedCell) -> None:
        self._cell = cell
        self._opened = False

    def open(self) -> RobotInfo:
        """Identity: nothing in it comes from the truth."""
        self._opened = True
        return RobotInfo(adapter="simulated", model=self._cell.model.name, controller="simulated cell")

    def read_state(self) -> RobotState:
        """Axis angles, nominal flange pose and whether it moves, now; a reading takes 2 ms.

        Raises:
            RobotNotReached: before `open` or after `close`.
        """
        self._check_open()
        self._cell.advance(_READING_S)
        joints = self._cell.read_joints_rad()
        flange = mdh.base_from_flange(self._cell.model, joints)
        return RobotState(joints_rad=joints, base_from_flange=flange, time_s=self._cell.clock_s, moving=self._cell.moving())

    def start_move(self, joints_rad: FloatArray, *, speed_rad_s: float) -> None:
        """Start a motion in which the fastest axis keeps `speed_rad_s`; the axes arrive together.

        Raises:
            MotionRefused: a target that is not n finite numbers within all limits, a speed that is not positive, or a
                motion still under way.
            RobotNotReached: before `open` or after `close`.
        """
        self._check_open()
        target = _checked_target(self._cell.model, joints_rad)
        if not (np.isfinite(speed_rad_s) and speed_rad_s > 0):
            raise MotionRefused(f"a speed of {speed_rad_s} rad/s", remedy="Give a positive speed.")
        if self._cell.moving():
            raise MotionRefused("a motion is still under way", remedy="Wait until the robot stands, or stop it first.")
        self._cell.start_motion(target, speed_rad_s=float(speed_rad_s))

    def stop(self) -> None:
        """Stand still where the axes are now; without effect when they stand."""
        self._cell.stop_motion()

    def wait(self, seconds: float) -> None:
        """Let time pass on the cell's clock."""
        self._cell.advance(seconds)

    def close(self) -> None:
        """Release the robot; a motion under way goes on, as with a real controller."""
        self._opened = False

    def _check_open(self) -> None:
        if not self._opened:
            raise RobotNotReached("the simulated robot is not open", remedy="Open it first, e.g. in a `with devices:` block.")


def _checked_target(model: RobotModel, joints_rad: FloatArray) -> FloatArray:
    target = np.asarray(joints_rad, dtype=np.float64)
    if target.shape != (model.n_joints,):
        raise MotionRefused(f"a target of shape {target.shape}", remedy=f"The robot {model.name} has {model.n_joints} axes.")
    if not np.isfinite(target).all():
        raise MotionRefused("the target has values that are not finite", remedy="Give every axis angle in rad.")
    if not bool(mdh.within_limits(model, target, -1e-9)):
        raise MotionRefused(f"the target is outside the limits: {_broken_limit(model, target)}", remedy="Plan again within the limits.")
    return target


def _broken_limit(model: RobotModel, target: FloatArray) -> str:
    for i, (value, (low, high)) in enumerate(zip(target, model.joint_limits_rad, strict=True)):
        if not low <= value <= high:
            return f"axis {i + 1} at {value:.4f} rad, allowed {low:.4f} to {high:.4f}"
    for limit in model.linear_limits:
        value = float(target @ limit.row)
        if not limit.lower_rad <= value <= limit.upper_rad:
            return f"linear limit {limit.row.tolist()} at {value:.4f} rad, allowed {limit.lower_rad:.4f} to {limit.upper_rad:.4f}"
    return "unknown"
