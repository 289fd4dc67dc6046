"""Inverse kinematics: every way in which a robot reaches a flange pose, within its axis and linear limits.

The nominal chain is solved in closed form (`closed_form.py`) and polished by Newton steps on the analytic Jacobian; a corrected
robot (with link twists) starts from the nominal solutions. At a singular pose a continuum of solutions exists; one representative
per branch is returned.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.errors import DataError, SettingsError
from drivers.kinematics import mdh, se3
from drivers.kinematics.closed_form import arm_geometry, solve
from drivers.kinematics.jacobian import joint_jacobian
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

TOLERANCE_MM = 1e-9
TOLERANCE_RAD = 1e-11
# Closed forms lose half their digits where two branches meet; anything worse than this is no solution, but a clamped cosine.
_POLISHABLE_MM = 1.0
_POLISHABLE_RAD = 1e-3
# A double root is known to the root of the tolerance only, so nearer solutions are the same one.
_SAME_RAD = 1e-6
# Rounding at the very end of an axis range: such solutions are kept and clipped onto the limit.
_LIMIT_ROUNDING_RAD = 1e-12
# Corrected axis angles differ from nominal ones by some mrad; starts may lie this far outside the limits.
_START_MARGIN_RAD = 0.05
_POLISH_STEPS = 8
_NEWTON_STEPS = 50
_LARGEST_STEP_RAD = 0.3
# One rad of rotation weighs as much as this length, so that both rows of the Jacobian have one size.
_LENGTH_PER_RAD_MM = 500.0


@dataclass(frozen=True, slots=True, eq=False)
class Branches:
    """Solutions for many targets."""

    target: NDArray[np.intp]
    """(k,) index of the target that a row solves, rising."""
    joints_rad: FloatArray
    """(k, n)."""
    reachable: NDArray[np.bool_]
    """(m,) whether the arm reaches the target at all, limits set aside."""


def all_branches(model: RobotModel, base_from_flange: ArrayLike) -> FloatArray:
    """Every axis-angle solution (k, n) of one flange pose (4, 4) within axis and linear limits, whole turns included; k may be 0.

    Raises:
        SettingsError: the arm has no closed form, or the target is no rigid transform.
    """
    target = _checked_target(base_from_flange)
    _, theta = _solutions(model, target[None])
    return _within_limits(model, _with_turns(model, _nearest_to_middle(model, theta)))


def branches_of_many(model: RobotModel, base_from_flange: ArrayLike, *, margin_rad: float = 0.0) -> Branches:
    """Every branch of many flange poses (m, 4, 4), each in the one turn that is nearest to the middle of the limits.

    Args:
        model: the nominal robot.
        base_from_flange: (m, 4, 4) rigid transforms.
        margin_rad: distance kept from every axis and linear limit.

    Raises:
        SettingsError: the arm has no closed form.
    """
    targets = _exactly_rigid(np.asarray(base_from_flange, dtype=np.float64).reshape(-1, 4, 4))
    index, theta = _solutions(model, targets)
    reachable = np.zeros(len(targets), dtype=np.bool_)
    reachable[index] = True
    joints = _nearest_to_middle(model, theta)
    keep = mdh.within_limits(model, joints, margin_rad)
    return Branches(index[keep], joints[keep], reachable)


def inverse_near(model: RobotModel, base_from_flange: ArrayLike, near_joints_rad: ArrayLike, link_twists: ArrayLike | None = None) -> FloatArray:
    """The axis angles (n,) within limits that reach a flange pose (4, 4) with the least largest axis motion from `near_joints_rad`.

    With link twists (n, 6) the corrected robot reaches the pose. Arms without a closed form are solved from the near pose alone.

    Raises:
        DataError: the pose is out of reach, or outside the limits.
    """
    target, near = _checked_target(base_from_flange), np.asarray(near_joints_rad, dtype=np.float64)
    starts = np.concatenate([near[None], _nominal_starts(model, target)])
    found, good = _newton(model, starts, np.broadcast_to(target, (len(starts), 4, 4)), link_twists, steps=_NEWTON_STEPS)
    if not good.any():
        raise DataError("the robot cannot reach the flange pose", where=_pose_text(target), remedy="Choose a pose nearer to the robot.")
    inside = _within_limits(model, found[good])
    if not len(inside):
        raise DataError("the flange pose needs axis angles outside the limits", where=_pose_text(target), remedy="Choose another tilt or roll.")
    return np.asarray(inside[np.argmin(np.abs(inside - near).max(axis=-1))])


def _solutions(model: RobotModel, targets: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    """Target indices (k,) and MDH angles (k, n) of all distinct solutions, limits and turns set aside."""
    theta = solve(arm_geometry(model), targets)
    joints = mdh.joints_from_link_angles_rad(model, theta)
    index = np.repeat(np.arange(len(targets)), theta.shape[1])
    rows = joints.reshape(-1, model.n_joints)
    joints, good = _newton(model, rows, targets[index], None, steps=_POLISH_STEPS, worth_mm=_POLISHABLE_MM, worth_rad=_POLISHABLE_RAD)
    theta = mdh.link_angles_rad(model, joints).reshape(theta.shape)
    good = _distinct(theta, good.reshape(theta.shape[:2])).reshape(-1)
    return index[good], theta.reshape(-1, model.n_joints)[good]


def _distinct(theta: FloatArray, good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the solutions theta (m, b, n) are good (m, b) and not the same, whole turns apart, as an earlier good one."""
    apart = theta[:, :, None] - theta[:, None]
    same = (np.abs(apart - 2 * np.pi * np.round(apart / (2 * np.pi))) < _SAME_RAD).all(axis=-1)
    earlier = np.tri(theta.shape[1], k=-1, dtype=np.bool_)
    return np.asarray(good & ~(same & earlier & good[:, None, :]).any(axis=-1))


def _newton(
    model: RobotModel,
    joints_rad: FloatArray,
    targets: FloatArray,
    link_twists: ArrayLike | None,
    *,
    steps: int,
    worth_mm: float = np.inf,
    worth_rad: float = np.inf,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Axis angles (k, n) after Newton steps towards targets (k, 4, 4), and whether each one arrived (k,).

    Starts that miss by more than `worth_mm` or `worth_rad` are left alone.
    """
    joints = joints_rad.copy()
    miss = _misses(model, joints, targets, link_twists)
    active = np.flatnonzero(~_arrived(miss) & _smaller(miss, worth_mm, worth_rad))
    for _ in range(steps):
        if not len(active):
            break
        joints[active] += _newton_step(model, joints[active], miss[active], link_twists)
        miss[active] = _misses(model, joints[active], targets[active], link_twists)
        active = active[~_arrived(miss[active])]
    return joints, _arrived(miss)


def _newton_step(model: RobotModel, joints_rad: FloatArray, miss: FloatArray, link_twists: ArrayLike | None) -> FloatArray:
    """Least-norm steps (k, n): directions that a singular pose does not know are left alone, long steps are shortened."""
    jacobian = joint_jacobian(model, joints_rad, link_twists)
    flange_mm = mdh.base_from_flange(model, joints_rad, link_twists)[..., :3, 3]
    jacobian[..., :3, :] += np.cross(jacobian[..., 3:, :], flange_mm[..., None], axis=-2)
    weight = np.array([1.0, 1, 1, _LENGTH_PER_RAD_MM, _LENGTH_PER_RAD_MM, _LENGTH_PER_RAD_MM])
    step = (np.linalg.pinv(jacobian * weight[:, None], rcond=1e-8) @ (miss * weight)[..., None])[..., 0]
    largest = np.abs(step).max(axis=-1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, _LARGEST_STEP_RAD / np.maximum(largest, 1e-300)))


def _misses(model: RobotModel, joints_rad: FloatArray, targets: FloatArray, link_twists: ArrayLike | None) -> FloatArray:
    """What the flange still has to do (k, 6): shift of its origin in mm, then rotation vector about it, in the base frame."""
    flange = mdh.base_from_flange(model, joints_rad, link_twists)
    turn = se3.log_so3(targets[..., :3, :3] @ np.swapaxes(flange[..., :3, :3], -1, -2))
    return np.concatenate([targets[..., :3, 3] - flange[..., :3, 3], turn], axis=-1)


def _arrived(miss: FloatArray) -> NDArray[np.bool_]:
    return _smaller(miss, TOLERANCE_MM, TOLERANCE_RAD)


def _smaller(miss: FloatArray, length_mm: float, angle_rad: float) -> NDArray[np.bool_]:
    return np.asarray((np.linalg.norm(miss[..., :3], axis=-1) < length_mm) & (np.linalg.norm(miss[..., 3:], axis=-1) < angle_rad))


def _nominal_starts(model: RobotModel, target: FloatArray) -> FloatArray:
    try:
        _, theta = _solutions(model, target[None])
    except SettingsError:
        return np.zeros((0, model.n_joints))
    joints = _with_turns(model, _nearest_to_middle(model, theta))
    return np.asarray(joints[mdh.within_limits(model, joints, -_START_MARGIN_RAD)])


def _nearest_to_middle(model: RobotModel, theta_rad: FloatArray) -> FloatArray:
    """Axis angles (k, n) of MDH angles (k, n), each angle in the turn nearest to the middle of its range."""
    limited = np.isfinite(model.joint_limits_rad).all(axis=-1, keepdims=True)
    middle = np.where(limited, model.joint_limits_rad, 0.0).mean(axis=-1)
    theta_middle = mdh.link_angles_rad(model, middle)
    turns = np.round((theta_middle - theta_rad) / (2 * np.pi))
    return mdh.joints_from_link_angles_rad(model, theta_rad + 2 * np.pi * turns)


def _with_turns(model: RobotModel, joints_rad: FloatArray) -> FloatArray:
    """Axis angles (k * t, n): all whole turns of the MDH angles that could lie within the axis limits.

    An axis without limits keeps its one turn.
    """
    width = model.joint_limits_rad[:, 1] - model.joint_limits_rad[:, 0]
    limited = np.isfinite(width)
    half_span = 0.5 * np.abs(model.coupling) @ np.where(limited, width, 0.0)
    unlimited = ((model.coupling != 0) & ~limited).any(axis=-1)
    most = np.where(unlimited, 0, np.floor((half_span + np.pi) / (2 * np.pi) + 1e-9)).astype(int)
    counts = [range(-n, n + 1) for n in most]
    turns = np.array(list(product(*counts)), dtype=np.float64) * 2 * np.pi
    shifts = turns @ np.linalg.inv(model.coupling).T
    return np.asarray((joints_rad[:, None] + shifts).reshape(-1, model.n_joints))


def _within_limits(model: RobotModel, joints_rad: FloatArray) -> FloatArray:
    """The rows of (k, n) inside the limits; rounding at the end of an axis range is clipped away."""
    inside = joints_rad[mdh.within_limits(model, joints_rad, -_LIMIT_ROUNDING_RAD)]
    return np.asarray(np.clip(inside, model.joint_limits_rad[:, 0], model.joint_limits_rad[:, 1]))


def _checked_target(base_from_flange: ArrayLike) -> FloatArray:
    target = np.asarray(base_from_flange, dtype=np.float64)
    if not se3.is_rigid(target):
        raise SettingsError("the target is no rigid transform", where="base_from_flange", remedy="Give a finite (4, 4) pose in mm.")
    return _exactly_rigid(target)


def _exactly_rigid(targets: FloatArray) -> FloatArray:
    """Poses read from files carry rounded rotations, which no chain reproduces to the tolerance."""
    return se3.from_rotation_translation(se3.nearest_rotation(targets[..., :3, :3]), targets[..., :3, 3])


def _pose_text(target: FloatArray) -> str:
    x, y, z = target[:3, 3]
    return f"flange at ({x:.1f}, {y:.1f}, {z:.1f}) mm"
