"""The base frame of a calibration: a free solve moves it by tenths of a mm, so it must be said (DESIGN.md 3, *Datum*).

The base is the rigid motion that brings the calibrated robot nearest to the nominal one over the poses that were used:
four points fixed to the flange (its origin and three at the distance of the work) at every reference pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

ARM_MM = 400.0
"""Distance from the flange at which work is measured: how much orientation counts against position."""
MAX_REFERENCES = 60


@dataclass(frozen=True, slots=True, eq=False)
class Datum:
    """Which base frame the results are in."""

    kind: str
    """`nominal_robot`: best fit to it; `controller`: the robot is taken as it reports."""
    base_from_solver: FloatArray
    """(4, 4) from the solver's own base to the stated one."""
    reference_joints_rad: FloatArray
    """(k, n) poses over which the fit was made; (0, 0) for `controller`."""


def nominal_robot_datum(model: RobotModel, link_twists: FloatArray, joints_rad: FloatArray) -> Datum:
    """Best fit of the calibrated to the nominal robot over some poses (m, n); their order does not matter."""
    ordered = joints_rad[np.lexsort(joints_rad.T)]
    references = ordered[np.unique(np.linspace(0, len(ordered) - 1, min(MAX_REFERENCES, len(ordered))).round().astype(int))]
    solved = _points(mdh.base_from_flange(model, references, link_twists))
    return Datum("nominal_robot", se3.fit_rigid(solved, _points(mdh.base_from_flange(model, references))), references)


def controller_datum() -> Datum:
    """The base that the controller reports its poses in."""
    return Datum("controller", np.eye(4), np.zeros((0, 0)))


def datum_jacobian(datum: Datum, model: RobotModel | None, link_twists: FloatArray) -> FloatArray:
    """(6, 6 n) left twist of the solver's base per link twist component: how the fit follows the calibration."""
    if model is None or not len(datum.reference_joints_rad):
        return np.zeros((6, link_twists.size))
    frames = mdh.chain(model, datum.reference_joints_rad, link_twists)
    points = _points(frames[:, -1]).reshape(len(frames), 4, 3)
    jacobian = np.stack([link_columns(model, datum.reference_joints_rad, frames, link_twists, points[:, i]) for i in range(4)], axis=1)
    flat_points, flat_jacobian = points.reshape(-1, 3), jacobian.reshape(-1, link_twists.size)
    design = np.concatenate([np.broadcast_to(np.eye(3), (len(flat_points), 3, 3)), -se3.hat(flat_points)], axis=-1).reshape(-1, 6)
    scale = np.array([1.0, 1, 1, 1e-3, 1e-3, 1e-3])
    return np.asarray(-scale[:, None] * np.linalg.lstsq(design * scale, flat_jacobian, rcond=None)[0])


def term_columns(model: RobotModel, steps: FloatArray, frames: FloatArray, load: FloatArray, points_in_base_mm: FloatArray) -> FloatArray:
    """(m, 3, K): motion of points (m, 3) carried by the flange per coefficient of deflection terms with loads (m, n, K)."""
    result = np.zeros((len(frames), 3, load.shape[-1]))
    for i in range(model.n_joints):
        if load[:, i].any():
            turned = frames[:, i] @ steps[:, i]
            motion = np.cross(turned[:, :3, 2], points_in_base_mm - turned[:, :3, 3])
            result += motion[:, :, None] * load[:, i, None, :]
    return result


def link_columns(model: RobotModel, joints_rad: FloatArray, frames: FloatArray, link_twists: FloatArray, points_in_base_mm: FloatArray) -> FloatArray:
    """(m, 3, 6 n): motion of points (m, 3) carried by the flange per component of the link twists (n, 6)."""
    steps = mdh.link_transforms(model, joints_rad)
    left_jacobian = se3.left_jacobian(link_twists)
    columns = [twist_columns(frames[:, i] @ steps[:, i], points_in_base_mm) @ left_jacobian[i] for i in range(len(link_twists))]
    return np.concatenate(columns, axis=-1)


def twist_columns(base_from_frame: FloatArray, point_in_base_mm: FloatArray) -> FloatArray:
    """(m, 3, 6): motion in the base of points (m, 3) per left twist acting in frames (m, 4, 4)."""
    rotation = base_from_frame[:, :3, :3]
    point_in_frame = np.einsum("mji,mj->mi", rotation, point_in_base_mm - base_from_frame[:, :3, 3])
    return np.concatenate([rotation, -rotation @ se3.hat(point_in_frame)], axis=-1)


def _points(base_from_flange: FloatArray) -> FloatArray:
    corners = np.concatenate([np.zeros((1, 3)), ARM_MM * np.eye(3)])
    return se3.apply(base_from_flange[:, None], corners).reshape(-1, 3)
