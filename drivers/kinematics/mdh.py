"""Serial chains in modified Denavit-Hartenberg form (J. J. Craig, "Introduction to Robotics", section 3.5).

    T_i = RotX(alpha_{i-1}) TransX(a_{i-1}) RotZ(theta_i) TransZ(d_i)
    theta = coupling @ q + theta_offset
    base_from_flange = prod_i T_i(theta_i) exp(xi_i)                    (paper, eq. 2)

`q` are the axis angles that the controller reports, `xi_i` the link twists of a calibration, (rho mm, phi rad).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LinearLimit:
    """`lower <= row @ q <= upper`, e.g. of a parallelogram; row (n,), bounds in rad."""

    row: FloatArray
    lower_rad: float
    upper_rad: float


@dataclass(frozen=True, slots=True)
class Capsule:
    """Part of a link's body: a segment in the frame of `link` (0 is the base, n the flange) with a radius."""

    link: int
    start_mm: tuple[float, float, float]
    end_mm: tuple[float, float, float]
    radius_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class RobotModel:
    """Nominal geometry of a serial robot with n axes, base to flange."""

    name: str
    a_mm: FloatArray
    """(n,) link lengths a_{i-1}."""
    alpha_rad: FloatArray
    """(n,) link twists alpha_{i-1}."""
    d_mm: FloatArray
    """(n,) link offsets."""
    theta_offset_rad: FloatArray
    """(n,) added to `coupling @ q`."""
    coupling: FloatArray
    """(n, n), identity for most robots."""
    joint_limits_rad: FloatArray
    """(n, 2) on q, -inf and inf where the model states none."""
    linear_limits: tuple[LinearLimit, ...] = ()
    shape: tuple[Capsule, ...] = ()
    source: str = ""
    text: str = field(default="", repr=False)
    """The YAML this model was read from, for verbatim copies in sessions and calibrations."""

    @property
    def n_joints(self) -> int:
        """Number of axes."""
        return int(self.a_mm.shape[0])


def link_angles_rad(model: RobotModel, joints_rad: ArrayLike) -> FloatArray:
    """MDH angles theta (..., n) of reported axis angles q (..., n)."""
    q = np.asarray(joints_rad, dtype=np.float64)
    return np.asarray(q @ model.coupling.T + model.theta_offset_rad)


def joints_from_link_angles_rad(model: RobotModel, theta_rad: ArrayLike) -> FloatArray:
    """Axis angles q (..., n) of MDH angles theta (..., n); the inverse of `link_angles_rad`."""
    theta = np.asarray(theta_rad, dtype=np.float64)
    return np.asarray((theta - model.theta_offset_rad) @ np.linalg.inv(model.coupling).T)


def link_transforms(model: RobotModel, joints_rad: ArrayLike, deflection_rad: ArrayLike | None = None) -> FloatArray:
    """`link_{i-1}_from_link_i` of every axis, shape (..., n, 4, 4), for q (..., n) and angles (..., n) that the links yield by."""
    theta = link_angles_rad(model, joints_rad)
    if deflection_rad is not None:
        theta = theta + np.asarray(deflection_rad, dtype=np.float64)
    sin_t, cos_t = np.sin(theta), np.cos(theta)
    sin_a, cos_a = np.sin(model.alpha_rad), np.cos(model.alpha_rad)
    result = np.zeros((*theta.shape, 4, 4))
    result[..., 0, 0], result[..., 0, 1], result[..., 0, 3] = cos_t, -sin_t, model.a_mm
    result[..., 1, 0], result[..., 1, 1] = sin_t * cos_a, cos_t * cos_a
    result[..., 1, 2], result[..., 1, 3] = -sin_a, -sin_a * model.d_mm
    result[..., 2, 0], result[..., 2, 1] = sin_t * sin_a, cos_t * sin_a
    result[..., 2, 2], result[..., 2, 3] = cos_a, cos_a * model.d_mm
    result[..., 3, 3] = 1.0
    return result


def chain(model: RobotModel, joints_rad: ArrayLike, link_twists: ArrayLike | None = None, deflection_rad: ArrayLike | None = None) -> FloatArray:
    """`base_from_link_i` for i = 0..n, shape (..., n + 1, 4, 4), for q (..., n) and link twists (n, 6) or none.

    Link i includes its own twist: the last entry is `base_from_flange`.
    """
    steps = link_transforms(model, joints_rad, deflection_rad)
    if link_twists is not None:
        steps = steps @ se3.exp(link_twists)
    frames = [se3.identity(*steps.shape[:-3])]
    for i in range(steps.shape[-3]):
        frames.append(frames[-1] @ steps[..., i, :, :])
    return np.stack(frames, axis=-3)


def base_from_flange(
    model: RobotModel, joints_rad: ArrayLike, link_twists: ArrayLike | None = None, deflection_rad: ArrayLike | None = None
) -> FloatArray:
    """Forward kinematics (..., 4, 4) for q (..., n), link twists (n, 6) or none, and deflections (..., n) or none."""
    return chain(model, joints_rad, link_twists, deflection_rad)[..., -1, :, :]


def within_limits(model: RobotModel, joints_rad: ArrayLike, margin_rad: float = 0.0) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Whether q (..., n) keeps all axis and linear limits with a margin, shape (...)."""
    q = np.asarray(joints_rad, dtype=np.float64)
    lower, upper = model.joint_limits_rad[:, 0] + margin_rad, model.joint_limits_rad[:, 1] - margin_rad
    inside = ((q >= lower) & (q <= upper)).all(axis=-1)
    for limit in model.linear_limits:
        value = q @ limit.row
        inside = inside & (value >= limit.lower_rad + margin_rad) & (value <= limit.upper_rad - margin_rad)
    return np.asarray(inside, dtype=np.bool_)
