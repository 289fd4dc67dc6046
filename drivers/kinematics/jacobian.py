"""Analytic derivatives of a serial chain, as left twists of the flange: `base_from_flange <- exp(J @ delta) @ base_from_flange`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray


def joint_jacobian(model: RobotModel, joints_rad: ArrayLike, link_twists: ArrayLike | None = None) -> FloatArray:
    """Derivative (..., 6, n) of the flange, (rho mm, phi rad) in the base, by reported axis angles q (..., n).

    Link i turns about the z axis of its own frame, before its twist: the column of theta_i is Ad(frame) (0, 0, 0, 0, 0, 1);
    the coupling then maps q to theta.
    """
    frames = _frames_before_twists(model, joints_rad, link_twists)
    axis = frames[..., :3, 2]
    moment = np.cross(frames[..., :3, 3], axis)
    by_theta = np.concatenate([moment, axis], axis=-1)
    return np.asarray(np.swapaxes(by_theta, -1, -2) @ model.coupling)


def link_twist_jacobian(model: RobotModel, joints_rad: ArrayLike, link_twists: ArrayLike | None = None) -> FloatArray:
    """Derivatives (..., n, 6, 6) of the flange by left updates of the link twists, `exp(xi_i) <- exp(delta) exp(xi_i)`."""
    return se3.adjoint(_frames_before_twists(model, joints_rad, link_twists))


def _frames_before_twists(model: RobotModel, joints_rad: ArrayLike, link_twists: ArrayLike | None) -> FloatArray:
    frames = mdh.chain(model, joints_rad, link_twists)[..., 1:, :, :]
    return frames if link_twists is None else np.asarray(frames @ se3.inverse(se3.exp(link_twists)))
