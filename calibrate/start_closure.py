"""Do shots close? Hand-eye transform and sphere places alone, robustly, many variants of the data at once (METHOD.md 4).

The robot is taken as it says. What is left is a few mm where the data belong together, and tens to hundreds where they
do not: the evidence by which wrong units, orders and conventions are told apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.problem import IntArray
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

LEAST_SHOTS = 7
"""The linear system has 15 unknowns for one sphere; six shots would leave nothing to judge it by."""
_LINEAR_ROUNDS = 8
_RIGID_ROUNDS = 25
_MEDIAN_OF_UNIT, _SHARE, _SHARE_OF_UNIT = 1.538, 0.7, 1.914
"""Quantiles of the length of a 3-vector of unit noise: the median, and that of the share which must fit."""
_LEVER_MM = 300.0
_SMALLEST_SCALE_MM = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Closure:
    """The best common hand-eye transform of B variants of m shots on S spheres."""

    flange_from_camera: FloatArray
    """(B, 4, 4)"""
    places_in_base_mm: FloatArray
    """(B, S, 3)"""
    miss_mm: FloatArray
    """(B, m) distance of each shot's centre from its sphere's place."""

    @property
    def spread_mm(self) -> FloatArray:
        """(B,) sigma of one component by the 70 % of the shots that fit best: some may be spoiled."""
        return np.asarray(np.quantile(self.miss_mm, _SHARE, axis=1) / _SHARE_OF_UNIT)


def fit_closure(base_from_flange: FloatArray, centres_in_camera_mm: FloatArray, sphere: IntArray) -> Closure:
    """Fit flange_from_camera and places to poses (B, m, 4, 4), centres (B, m, 3) and sphere indices (B, m) or (m,)."""
    member = one_hot(sphere)
    hand_eye = linear_hand_eye(base_from_flange, centres_in_camera_mm, member)
    return refine_closure(base_from_flange, centres_in_camera_mm, member, hand_eye)


def one_hot(sphere: IntArray) -> FloatArray:
    """(..., S) of sphere indices (...)."""
    return np.asarray(np.eye(int(sphere.max()) + 1)[sphere])


def linear_hand_eye(
    base_from_flange: FloatArray, centres_in_camera_mm: FloatArray, member: FloatArray, *, rounds: int = _LINEAR_ROUNDS
) -> FloatArray:
    """(B, 4, 4) from the reweighted linear system R_j R_X p_j + R_j t_X - c_s = -t_j, its R_X projected on SO(3)."""
    unknowns = _linear_unknowns(base_from_flange, centres_in_camera_mm, member, rounds)
    return se3.from_rotation_translation(se3.nearest_rotation(unknowns[:, :9].reshape(-1, 3, 3)), unknowns[:, 9:12])


def linear_matrix(base_from_flange: FloatArray, centres_in_camera_mm: FloatArray, member: FloatArray) -> FloatArray:
    """(B, 3, 3) that the linear system, each shot weighted equally, puts in the place of R_X: no rotation where data disagree."""
    return _linear_unknowns(base_from_flange, centres_in_camera_mm, member, 1)[:, :9].reshape(-1, 3, 3) / _LEVER_MM


def _linear_unknowns(base_from_flange: FloatArray, centres: FloatArray, member: FloatArray, rounds: int) -> FloatArray:
    """(B, 12 + 3 S): R_X times the lever, t_X, c."""
    columns, right = _linear_system(base_from_flange, centres, member)
    weight = np.ones(right.shape[:2])
    for turn in range(rounds):
        weighted = np.swapaxes(columns * weight[..., None, None], 2, 3)
        normal = (weighted @ columns).sum(axis=1)
        normal += 1e-10 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(normal.shape[-1])
        unknowns = np.linalg.solve(normal, (weighted @ right[..., None]).sum(axis=1))[..., 0]
        if turn + 1 < rounds:
            weight = _weights(np.linalg.norm((columns @ unknowns[:, None, :, None])[..., 0] - right, axis=2))
    return np.asarray(unknowns)


def refine_closure(base_from_flange: FloatArray, centres_in_camera_mm: FloatArray, member: FloatArray, flange_from_camera: FloatArray) -> Closure:
    """Gauss-Newton with redescending weights from given hand-eye transforms (B, 4, 4); places are weighted means."""
    rotation, hand_eye = base_from_flange[..., :3, :3], flange_from_camera
    weight = np.ones(centres_in_camera_mm.shape[:2])
    for turn in range(_RIGID_ROUNDS + 1):
        in_flange = se3.apply(hand_eye[:, None], centres_in_camera_mm)
        in_base = se3.apply(base_from_flange, in_flange)
        places = _means(in_base, weight, member)
        difference = in_base - member @ places
        miss = np.linalg.norm(difference, axis=2)
        if turn == _RIGID_ROUNDS:
            break
        weight = _weights(miss)
        columns = rotation @ np.concatenate([np.broadcast_to(np.eye(3), (*miss.shape, 3, 3)), -se3.hat(in_flange) / _LEVER_MM], axis=-1)
        flat = columns.reshape(*miss.shape, 18)
        columns = (flat - member @ _means(flat, weight, member)).reshape(*miss.shape, 3, 6)
        weighted = np.swapaxes(columns * weight[..., None, None], 2, 3)
        normal = (weighted @ columns).sum(axis=1)
        # a floor of its own: a sphere that one shot alone shows gives no column at all
        normal += (1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-12) * np.eye(6)
        step = -np.linalg.solve(normal, (weighted @ difference[..., None]).sum(axis=1))[..., 0]
        hand_eye = se3.exp(step / [1, 1, 1, _LEVER_MM, _LEVER_MM, _LEVER_MM]) @ hand_eye
    return Closure(hand_eye, places, miss)


def _linear_system(base_from_flange: FloatArray, centres: FloatArray, member: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Columns (B, m, 3, 12 + 3 S), the rotation's scaled by a typical distance, and the right-hand side (B, m, 3)."""
    rotation = base_from_flange[..., :3, :3]
    batch, n_shots, n_spheres = *centres.shape[:2], member.shape[-1]
    columns = np.zeros((batch, n_shots, 3, 12 + 3 * n_spheres))
    columns[..., :9] = (rotation[..., None] * centres[:, :, None, None, :]).reshape(batch, n_shots, 3, 9)
    columns[..., 9:12] = rotation
    columns[..., 12:] = -(member[..., None, :, None] * np.eye(3)[:, None, :]).reshape(*member.shape[:-1], 3, 3 * n_spheres)
    # one length for all columns: the rotation's unknowns come out in units of the distance and are only projected
    columns[..., :9] /= _LEVER_MM
    return columns, -base_from_flange[..., :3, 3]


def _means(values: FloatArray, weight: FloatArray, member: FloatArray) -> FloatArray:
    """(B, S, k) weighted means of (B, m, k) over the shots of each sphere."""
    share = weight[..., None] * member
    return np.asarray(np.swapaxes(share, 1, 2) @ values / np.maximum(share.sum(axis=1), 1e-12)[..., None])


def _weights(miss_mm: FloatArray) -> FloatArray:
    scale = np.maximum(np.median(miss_mm, axis=1) / _MEDIAN_OF_UNIT, _SMALLEST_SCALE_MM)[:, None]
    return np.asarray((1.0 + (miss_mm / (4.0 * scale)) ** 2) ** -2.0)
