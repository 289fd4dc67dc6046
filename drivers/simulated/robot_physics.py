"""The true robot: nominal chain plus everything of a `RobotTruth`, as pure functions of axis angles."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from drivers.errors import SettingsError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.truth import RobotTruth, Vector


@dataclass(frozen=True, slots=True, eq=False)
class StopNoise:
    """What repeatability does to one stop of the robot."""

    axis_rad: FloatArray
    """(n,) added to the axis angles."""
    position_mm: FloatArray
    """(3,) added to the flange's position in the base."""
    rotation_rad: FloatArray
    """(3,) rotation vector about the flange's origin, in the base."""


def check_axes(model: RobotModel, truth: RobotTruth) -> None:
    """Refuse a truth that was made for another number of axes.

    Raises:
        SettingsError: when a list of the truth is neither empty nor one entry per axis.
    """
    n = model.n_joints
    wrong = {name: len(values) for name, values in truth.per_axis().items() if len(values) not in {0, n}}
    wrong |= {f"gear_harmonics of axis {h.axis}": h.axis + 1 for h in truth.gear_harmonics if h.axis >= n}
    if wrong:
        found = ", ".join(f"{name} ({count})" for name, count in wrong.items())
        raise SettingsError(
            f"the truth was not made for {model.name} with {n} axes: {found}", where="robot", remedy="Use the truth of this robot model."
        )


def no_noise(model: RobotModel) -> StopNoise:
    """A stop exactly where the systematic errors put it."""
    return StopNoise(np.zeros(model.n_joints), np.zeros(3), np.zeros(3))


def draw_stop_noise(model: RobotModel, truth: RobotTruth, rng: np.random.Generator) -> StopNoise:
    """One stop's repeatability: axes, position and orientation, all Gaussian and independent."""
    return StopNoise(
        _vector(truth.axis_repeatability_rad, model) * rng.standard_normal(model.n_joints),
        truth.pose_noise_mm * rng.standard_normal(3),
        truth.pose_noise_rad * rng.standard_normal(3),
    )


def true_base_from_flange(
    model: RobotModel,
    truth: RobotTruth,
    joints_rad: ArrayLike,
    *,
    approach: ArrayLike | None = None,
    hours: float = 0.0,
    noise: StopNoise | None = None,
) -> FloatArray:
    """Where the flange truly is, (..., 4, 4), when the controller reads joints (..., n).

    Args:
        model: Nominal geometry.
        truth: The robot's errors.
        joints_rad: Reported axis angles, shape (..., n).
        approach: (n,) or (..., n), sign of the last motion of each axis; None for no play on either side.
        hours: Time on the cell's clock, for the drift.
        noise: Repeatability of this stop.
    """
    q = _true_axes(model, truth, np.asarray(joints_rad, dtype=np.float64), approach, hours)
    q = q if noise is None else q + noise.axis_rad
    theta = mdh.link_angles_rad(model, q)
    theta = theta + _vector(truth.theta_error_rad, model) + _droop(model, truth, q)
    flange = se3.exp(hours * np.asarray(truth.drift_per_hour)) @ _true_chain(model, truth, theta)
    return flange if noise is None else _displaced(flange, noise)


def gravity_load(model: RobotModel, joints_rad: ArrayLike) -> FloatArray:
    """Gravity's torque about each axis (..., n) for a mass at the flange, in units of that of the horizontal stretch.

    z_i . ((p_flange - p_i) x -e_z) / sum_{k>i} hypot(a_k, d_k): between -1 and 1, positive where it drives the axis on.
    """
    frames = mdh.chain(model, joints_rad)
    axes, origins = frames[..., 1:, :3, 2], frames[..., 1:, :3, 3]
    lever = origins[..., -1:, :] - origins
    torque = np.sum(axes * np.cross(lever, [0.0, 0.0, -1.0]), axis=-1)
    lengths = np.hypot(model.a_mm, model.d_mm)
    reach = lengths[::-1].cumsum()[::-1] - lengths
    return np.asarray(np.divide(torque, reach, out=np.zeros_like(torque), where=np.broadcast_to(reach, torque.shape) > 0))


def _true_axes(model: RobotModel, truth: RobotTruth, q: FloatArray, approach: ArrayLike | None, hours: float) -> FloatArray:
    signs = 0.0 if approach is None else np.asarray(approach, dtype=np.float64)
    result = q - 0.5 * _vector(truth.backlash_rad, model) * signs + hours * _vector(truth.axis_drift_rad_per_hour, model)
    for harmonic in truth.gear_harmonics:
        angle = harmonic.cycles_per_turn * q[..., harmonic.axis] + harmonic.phase_rad
        result[..., harmonic.axis] += harmonic.amplitude_rad * np.sin(angle)
    return np.asarray(result)


def _droop(model: RobotModel, truth: RobotTruth, q: FloatArray) -> FloatArray:
    if not any(truth.droop_rad):
        return np.zeros(model.n_joints)
    return _vector(truth.droop_rad, model) * gravity_load(model, q)


def _true_chain(model: RobotModel, truth: RobotTruth, theta: FloatArray) -> FloatArray:
    """prod_i RotX(alpha) TransX(a) RotY(tilt) RotZ(theta) TransZ(d) exp(xi), errors included."""
    n = model.n_joints
    zero = np.zeros(n)
    plain = replace(model, coupling=np.eye(n), theta_offset_rad=zero)
    alpha = model.alpha_rad + _vector(truth.alpha_error_rad, model)
    before = replace(plain, a_mm=model.a_mm + _vector(truth.a_error_mm, model), alpha_rad=alpha, d_mm=zero)
    after = replace(plain, a_mm=zero, alpha_rad=zero, d_mm=model.d_mm + _vector(truth.d_error_mm, model))
    tilt = np.zeros((n, 6))
    tilt[:, 4] = _vector(truth.tilt_rad, model)
    steps = (mdh.link_transforms(before, zero) @ se3.exp(tilt)) @ mdh.link_transforms(after, theta)
    if truth.link_twists:
        steps = steps @ se3.exp(truth.link_twists)
    result = steps[..., 0, :, :]
    for i in range(1, n):
        result = result @ steps[..., i, :, :]
    return np.asarray(result)


def _displaced(base_from_flange: FloatArray, noise: StopNoise) -> FloatArray:
    result = base_from_flange.copy()
    result[..., :3, :3] = se3.exp_so3(noise.rotation_rad) @ base_from_flange[..., :3, :3]
    result[..., :3, 3] += noise.position_mm
    return result


def _vector(values: Vector, model: RobotModel) -> FloatArray:
    return np.asarray(values, dtype=np.float64) if values else np.zeros(model.n_joints)

