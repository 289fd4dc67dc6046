"""Method 4 of the paper's Table 3: robot and hand-eye, the robot by linearised D-H errors (the paper's reference 26).

The same consecutive differences as in eq. 8, but all unknowns at once: four errors (a, alpha, d, theta) a link and a
hand-eye twist, one linear least-squares system after the other until the steps are small. The derivatives are the twists
that T = RotX(alpha) TransX(a) RotZ(theta) TransZ(d) has along its own x and z axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibrate.datum import twist_columns
from calibrate.stepwise import IntArray, consecutive_pairs
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_DH_SCALE = np.array([1.0, 1e-3, 1.0, 1e-3])
_TWIST_SCALE = np.array([1.0] * 3 + [1e-3] * 3)
_LEAST_STEP = 1e-7
RANK_REVEALING = 1e-3
"""Directions that move the differences by less than this share of the strongest one are left alone: gauge."""
GAUGE_LEFT_TO_NOISE = 1e-6
"""Next to nothing is left alone, as where normal equations are inverted: noise then decides the gauge."""


@dataclass(frozen=True, slots=True, eq=False)
class DhResult:
    """Robot and hand-eye of method 4."""

    model: RobotModel
    """With the D-H errors that were found."""
    flange_from_camera: FloatArray
    iterations: int
    objective_mm2: float


def solve_linearised_dh(
    model: RobotModel,
    joints_rad: FloatArray,
    centres_in_camera_mm: FloatArray,
    hand_eye_guess: FloatArray,
    *,
    relative_zero: float = RANK_REVEALING,
    max_iterations: int = 20,
) -> DhResult:
    """Solve for D-H errors and hand-eye on shots of one sphere in capture order.

    Args:
        model: nominal robot with n axes.
        joints_rad: (m, n).
        centres_in_camera_mm: (m, 3).
        hand_eye_guess: (4, 4).
        relative_zero: what counts as gauge.
        max_iterations: of the linear system.
    """
    found, hand_eye = model, hand_eye_guess
    pairs = consecutive_pairs(np.zeros(len(joints_rad), dtype=np.int64))
    iterations = 0
    while iterations < max_iterations:
        iterations += 1
        points, columns = dh_columns(found, joints_rad, hand_eye, centres_in_camera_mm)
        scale = np.concatenate([np.tile(_DH_SCALE, model.n_joints), _TWIST_SCALE])
        flat = _difference(columns, pairs).reshape(-1, columns.shape[-1]) * scale
        scaled = -np.linalg.lstsq(flat, _difference(points, pairs).reshape(-1), rcond=relative_zero)[0]
        found, hand_eye = moved(found, hand_eye, scaled * scale)
        if float(np.abs(flat @ scaled).max()) < _LEAST_STEP:
            break
    points, _ = dh_columns(found, joints_rad, hand_eye, centres_in_camera_mm)
    return DhResult(found, hand_eye, iterations, 0.5 * float((_difference(points, pairs) ** 2).sum()))


def dh_columns(model: RobotModel, joints_rad: FloatArray, hand_eye: FloatArray, centres_in_camera_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (m, 3) in the base and their motion (m, 3, 4 n + 6) per (a, alpha, d, theta) of every link and hand-eye twist."""
    frames = mdh.chain(model, joints_rad)
    points = se3.apply(frames[:, -1] @ hand_eye, centres_in_camera_mm)
    blocks = []
    for i in range(model.n_joints):
        about_x, about_z = twist_columns(frames[:, i], points)[:, :, [0, 3]], twist_columns(frames[:, i + 1], points)[:, :, [2, 5]]
        blocks += [about_x, about_z]
    return points, np.concatenate([*blocks, twist_columns(frames[:, -1], points)], axis=-1)


def moved(model: RobotModel, hand_eye: FloatArray, step: FloatArray) -> tuple[RobotModel, FloatArray]:
    """The model and the hand-eye transform after a step (4 n + 6,) of `dh_columns`' unknowns."""
    a, alpha, d, theta = step[: 4 * model.n_joints].reshape(-1, 4).T
    return (
        replace(model, a_mm=model.a_mm + a, alpha_rad=model.alpha_rad + alpha, d_mm=model.d_mm + d, theta_offset_rad=model.theta_offset_rad + theta),
        se3.exp(step[4 * model.n_joints :]) @ hand_eye,
    )


def _difference(values: FloatArray, pairs: IntArray) -> FloatArray:
    return np.asarray(values[pairs[:, 0]] - values[pairs[:, 1]])
