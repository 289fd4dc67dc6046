"""Closed-form inverse kinematics of the two families of six-axis arms that industry builds.

* spherical wrist: axes 4, 5, 6 meet in one point, axes 2 and 3 are parallel (ABB IRB 1410; any shoulder and elbow offsets);
* three parallel axes: 2, 3, 4 parallel, axes 5 and 6 meet (Universal Robots).

The arm is taken as a product of exponentials of its axes at theta = 0 and split into the canonical subproblems of
Paden and Kahan, as in A. J. Elias, J. T. Wen, "IK-Geo: unified robot inverse kinematics using subproblem
decomposition", Mechanism and Machine Theory 2025 (arXiv:2211.05737). Out-of-reach cosines are clamped, never refused here:
the caller keeps a branch only if the forward kinematics agrees, so a stretched arm is not lost to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivers.errors import SettingsError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_PARALLEL = 1e-9
_TOUCHING_MM = 1e-6
# sin of the angle below which two axes count as aligned, so that only the sum of their angles is determined
_ALIGNED = 1e-12
# Two branches closer than this are held this far apart: it moves the arm by its square only, and keeps the direction in which a
# nearly straight wrist is bent, from which Newton steps can find the rest.
_DOUBLE_ROOT_RAD = 1e-8
_NO_DIRECTION = 1e-22
_N_FREE_SAMPLES = 72


@dataclass(frozen=True, slots=True, eq=False)
class ArmGeometry:
    """The axes of an arm at theta = 0, in the base frame."""

    family: Literal["spherical wrist", "three parallel axes"]
    axis: FloatArray
    """(6, 3) unit directions."""
    point_mm: FloatArray
    """(6, 3) a point on each axis."""
    wrist_mm: FloatArray
    """(3,) where axes 5 and 6 meet."""
    base_from_flange: FloatArray
    """(4, 4) at theta = 0."""


def arm_geometry(model: RobotModel) -> ArmGeometry:
    """The closed-form family of a model.

    Raises:
        SettingsError: when the arm is of neither family.
    """
    frames = mdh.chain(model, mdh.joints_from_link_angles_rad(model, np.zeros(model.n_joints)))
    axis, point = frames[1:, :3, 2], frames[1:, :3, 3]
    if model.n_joints == 6 and _parallel(axis[1], axis[2]) and not _parallel(axis[0], axis[1]):
        wrist = _meeting_point(axis[4], point[4], axis[5], point[5])
        if wrist is not None and _is_on(wrist, axis[3], point[3]) and not _parallel(axis[3], axis[4]):
            return ArmGeometry("spherical wrist", axis, point, wrist, frames[-1])
        if wrist is not None and _parallel(axis[1], axis[3]) and not _parallel(axis[3], axis[4]):
            return ArmGeometry("three parallel axes", axis, point, wrist, frames[-1])
    raise SettingsError(
        f"no closed-form inverse kinematics for the robot model {model.name!r}",
        remedy="Six axes with 2 and 3 parallel and a spherical wrist, or with 2, 3, 4 parallel and 5, 6 meeting are known; teach the poses by hand.",
    )


def solve(arm: ArmGeometry, base_from_flange: FloatArray) -> FloatArray:
    """Eight candidate solutions theta (m, 8, 6) in (-pi, pi] of targets (m, 4, 4); unchecked, some or all may miss the target."""
    motion = base_from_flange @ se3.inverse(arm.base_from_flange)
    theta = _solve_spherical(arm, motion) if arm.family == "spherical wrist" else _solve_parallel(arm, motion)
    return _wrapped(theta.reshape(len(motion), 8, 6))


def _solve_spherical(arm: ArmGeometry, motion: FloatArray) -> FloatArray:
    h1, h2, h3, h4, h5, h6 = arm.axis
    rotation = motion[:, None, None, :3, :3]
    theta1, in_arm = _shoulder(arm, motion)
    theta2, theta3 = _two_links(arm, in_arm, arm.wrist_mm - arm.point_mm[2])
    theta1 = np.broadcast_to(theta1[..., None], theta3.shape)
    wrist = _turn(h3, -theta3) @ _turn(h2, -theta2) @ _turn(h1, -theta1) @ rotation
    theta5 = _angles_to_plane(h4, h5, h6, np.einsum("i,...ij,j->...", h4, wrist, h6))
    wrist = wrist[..., None, :, :]
    axis6 = (_turn(h5, theta5) @ h6[:, None])[..., 0]
    theta4 = _angle_onto(h4, axis6, wrist @ h6)
    across = _perpendicular(h6)
    back = np.swapaxes(_turn(h4, theta4) @ _turn(h5, theta5), -1, -2) @ wrist
    theta6 = _angle_onto(h6, np.broadcast_to(across, back.shape[:-1]), back @ across)
    return np.stack([*(np.broadcast_to(t[..., None], theta5.shape) for t in (theta1, theta2, theta3)), theta4, theta5, theta6], axis=-1)


def _solve_parallel(arm: ArmGeometry, motion: FloatArray) -> FloatArray:
    h1, h2, h3, h4, h5, h6 = arm.axis
    rotation = motion[:, None, None, :3, :3]
    theta1, in_arm = _shoulder(arm, motion)
    arm_rotation = _turn(h1, -theta1)[..., None, :, :] @ rotation
    theta5 = _angles_to_plane(h2, h5, h6, np.einsum("i,...ij,j->...", h2, arm_rotation[..., 0, :, :], h6))
    turned_axis = np.swapaxes(arm_rotation, -1, -2) @ h2
    folded_axis = (np.swapaxes(_turn(h5, theta5), -1, -2) @ h2[:, None])[..., 0]
    theta6 = _free_or(arm, in_arm, arm_rotation, theta5, _angle_onto(-h6, folded_axis, turned_axis))
    sum_rotation = _sum_rotation(arm, arm_rotation, theta5, theta6)
    across = _perpendicular(h2)
    theta_sum = _angle_onto(h2, np.broadcast_to(across, sum_rotation.shape[:-1]), sum_rotation @ across)
    elbow_target = in_arm[..., None, :] - sum_rotation @ (arm.wrist_mm - arm.point_mm[3])
    theta2, theta3 = _two_links(arm, elbow_target, arm.point_mm[3] - arm.point_mm[2])
    theta4 = (theta_sum[..., None] - theta2 - np.sign(h2 @ h3) * theta3) * np.sign(h2 @ h4)
    once = (np.broadcast_to(t, theta3.shape) for t in (theta1[..., None, None], theta5[..., None], theta6[..., None]))
    theta1, theta5, theta6 = once
    return np.stack([theta1, theta2, theta3, theta4, theta5, theta6], axis=-1)


def _shoulder(arm: ArmGeometry, motion: FloatArray) -> tuple[FloatArray, FloatArray]:
    """theta1 (m, 2), and the wrist point seen from axis 2 after undoing it (m, 2, 3).

    Axes 2, 3 (and 4) are parallel, so the wrist keeps its coordinate along them whatever those axes do.
    """
    h1, h2 = arm.axis[:2]
    wrist = se3.apply(motion, arm.wrist_mm) - arm.point_mm[0]
    theta1 = _angles_to_plane(h2, -h1, wrist, np.full(len(wrist), h2 @ (arm.wrist_mm - arm.point_mm[0])))
    in_arm = (_turn(h1, -theta1) @ wrist[:, None, :, None])[..., 0] - (arm.point_mm[1] - arm.point_mm[0])
    return theta1, in_arm


def _two_links(arm: ArmGeometry, target: FloatArray, forearm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """theta2 and theta3 (..., 2) that bring the end of the forearm to targets (..., 3), both seen from axis 2."""
    h2, h3 = arm.axis[1], arm.axis[2]
    upper = arm.point_mm[2] - arm.point_mm[1]
    product = 0.5 * ((target**2).sum(-1) - upper @ upper - forearm @ forearm)
    theta3 = _angles_to_plane(upper, h3, forearm, product)
    reached = upper + (_turn(h3, theta3) @ forearm[:, None])[..., 0]
    theta2 = _angle_onto(h2, reached, target[..., None, :])
    return theta2, theta3


def _sum_rotation(arm: ArmGeometry, arm_rotation: FloatArray, theta5: FloatArray, theta6: FloatArray) -> FloatArray:
    """What axes 2, 3, 4 turn together, (..., 3, 3)."""
    return np.asarray(arm_rotation @ _turn(arm.axis[5], -theta6) @ _turn(arm.axis[4], -theta5))


def _free_or(arm: ArmGeometry, in_arm: FloatArray, arm_rotation: FloatArray, theta5: FloatArray, theta6: FloatArray) -> FloatArray:
    """theta6, or where axis 6 is parallel to axis 2 (theta6 then is free) the sample that the two links reach most easily."""
    axis6 = arm_rotation @ arm.axis[5]
    aligned = np.broadcast_to(np.linalg.norm(np.cross(axis6, arm.axis[1]), axis=-1) < _ALIGNED, theta5.shape)
    if not aligned.any():
        return theta6
    samples = np.linspace(-np.pi, np.pi, _N_FREE_SAMPLES, endpoint=False)
    target = np.broadcast_to(in_arm[..., None, :], (*theta5.shape, 3))[aligned][:, None, :]
    angle5 = np.repeat(theta5[aligned][:, None], len(samples), axis=1)
    rotation = np.broadcast_to(arm_rotation, (*theta5.shape, 3, 3))[aligned][:, None]
    turned = _sum_rotation(arm, rotation, angle5, np.broadcast_to(samples, angle5.shape)) @ (arm.wrist_mm - arm.point_mm[3])
    links = np.linalg.norm(arm.point_mm[2] - arm.point_mm[1]), np.linalg.norm(arm.point_mm[3] - arm.point_mm[2])
    miss = np.abs(np.linalg.norm(target - turned, axis=-1) - np.hypot(*links))
    result = theta6.copy()
    result[aligned] = samples[np.argmin(miss, axis=-1)]
    return result


def _angles_to_plane(normal: FloatArray, axis: FloatArray, vector: FloatArray, value: FloatArray) -> FloatArray:
    """Both angles (..., 2) with `normal . turn(axis, angle) vector = value`, clamped to the nearest where there is none."""
    along = vector @ axis
    sine = np.cross(axis, vector) @ normal
    cosine = vector @ normal - along * (axis @ normal)
    rest = value - along * (axis @ normal)
    middle = np.arctan2(sine, cosine)
    square = sine**2 + cosine**2
    half = np.arctan2(np.sqrt(np.maximum(square - rest**2, _DOUBLE_ROOT_RAD**2 * square)), rest)
    return np.stack([middle + half, middle - half], axis=-1)


def _angle_onto(axis: FloatArray, source: FloatArray, target: FloatArray) -> FloatArray:
    """The angle (...) about an axis that turns source (..., 3) nearest to target (..., 3); 0 where every angle does."""
    # projected first: a nearly straight wrist would lose all digits of the small cross parts to the large parts along the axis
    source_across, target_across = (v - (v @ axis)[..., None] * axis for v in (source, target))
    sine = np.cross(source_across, target_across) @ axis
    cosine = (source_across * target_across).sum(-1)
    size = np.linalg.norm(source, axis=-1) * np.linalg.norm(target, axis=-1)
    return np.where(np.hypot(sine, cosine) <= _NO_DIRECTION * size, 0.0, np.arctan2(sine, cosine))


def _turn(axis: FloatArray, angle_rad: FloatArray) -> FloatArray:
    return se3.exp_so3(angle_rad[..., None] * axis)


def _wrapped(angle_rad: FloatArray) -> FloatArray:
    return np.asarray(np.pi - np.mod(np.pi - angle_rad, 2 * np.pi))


def _perpendicular(axis: FloatArray) -> FloatArray:
    other = np.eye(3)[np.argmin(np.abs(axis))]
    across = np.cross(axis, other)
    return np.asarray(across / np.linalg.norm(across))


def _parallel(first: FloatArray, second: FloatArray) -> bool:
    return bool(np.linalg.norm(np.cross(first, second)) < _PARALLEL)


def _is_on(point: FloatArray, axis: FloatArray, point_on_axis: FloatArray) -> bool:
    return bool(np.linalg.norm(np.cross(point - point_on_axis, axis)) < _TOUCHING_MM)


def _meeting_point(axis_a: FloatArray, point_a: FloatArray, axis_b: FloatArray, point_b: FloatArray) -> FloatArray | None:
    if _parallel(axis_a, axis_b):
        return None
    steps = np.linalg.lstsq(np.stack([axis_a, -axis_b], axis=-1), point_b - point_a)[0]
    meeting = point_a + steps[0] * axis_a
    return meeting if _is_on(meeting, axis_b, point_b) else None
