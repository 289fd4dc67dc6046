"""What makes a reading unfit, and a target: shared by the adapters and by `acquire.motion`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drivers.errors import EmergencyStop, MotionRefused, ProtectiveStop, SafeguardStop, SafetyStop, StaleReading
from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import MAX_AGE_S, RobotState, Safety

_STOPS: dict[Safety, type[SafetyStop]] = {
    Safety.PROTECTIVE_STOP: ProtectiveStop,
    Safety.SAFEGUARD_STOP: SafeguardStop,
    Safety.EMERGENCY_STOP: EmergencyStop,
    Safety.FAULT: SafetyStop,
}


def check_safety(state: RobotState) -> None:
    """Nothing, if the robot may move.

    Raises:
        ProtectiveStop: or
        SafeguardStop: or
        EmergencyStop: or
        SafetyStop: with the controller's own reason.
    """
    kind = _STOPS.get(state.safety)
    if kind is None:
        return
    said = "" if state.reason is None else f": {state.reason}"
    remedy = "Find the cause, clear it at the pendant, then continue with --resume."
    raise kind(f"the robot is in {state.safety.value.replace('_', ' ')}{said}", remedy=remedy)


def check_age(state: RobotState) -> None:
    """Nothing, if the reading is fresh enough to be recorded.

    Raises:
        StaleReading: it is older than `MAX_AGE_S`.
    """
    if not state.age_s <= MAX_AGE_S:
        raise StaleReading(
            f"a reading of the robot is {state.age_s * 1000:.0f} ms old, allowed {MAX_AGE_S * 1000:.0f} ms",
            remedy="Is the network or this computer overloaded? Use a cable of its own for the robot, then continue with --resume.",
        )


def checked_target(model: RobotModel, joints_rad: ArrayLike, *, speed_rad_s: float, name: str | None = None) -> FloatArray:
    """The axis angles (n,) of a motion that may be sent.

    Args:
        model: whose number of axes and limits hold.
        joints_rad: the angles asked for.
        speed_rad_s: the speed asked for.
        name: what the robot is called in errors; the model's name if None.

    Raises:
        MotionRefused: not n finite numbers within all limits, or a speed that is not positive and finite.
    """
    target = np.asarray(joints_rad, dtype=np.float64)
    if target.shape != (model.n_joints,):
        raise MotionRefused(f"a target of shape {target.shape}", remedy=f"The robot {name or model.name} has {model.n_joints} axes.")
    if not np.isfinite(target).all():
        raise MotionRefused("the target has values that are not finite", remedy="Give every axis angle in rad.")
    if not bool(mdh.within_limits(model, target, -1e-9)):
        raise MotionRefused(f"the target is outside the limits: {broken_limit(model, target)}", remedy="Plan again within the limits.")
    if not (np.isfinite(speed_rad_s) and speed_rad_s > 0):
        raise MotionRefused(f"a speed of {speed_rad_s} rad/s", remedy="Give a positive speed.")
    return target.copy()


def broken_limit(model: RobotModel, target: FloatArray) -> str:
    """Which limit a target (n,) breaks, in words."""
    for i, (value, (low, high)) in enumerate(zip(target, model.joint_limits_rad, strict=True)):
        if not low <= value <= high:
            return f"axis {i + 1} at {value:.4f} rad, allowed {low:.4f} to {high:.4f}"
    for limit in model.linear_limits:
        value = float(target @ limit.row)
        if not limit.lower_rad <= value <= limit.upper_rad:
            return f"linear limit {limit.row.tolist()} at {value:.4f} rad, allowed {limit.lower_rad:.4f} to {limit.upper_rad:.4f}"
    return "unknown"
