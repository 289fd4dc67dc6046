"""Noise from the data: points and form from the residuals' patches, pose noise by restricted maximum likelihood."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calibrate.normal import PATCHES, Linearised, NoiseModel, marginal_cost
from drivers.kinematics.se3 import FloatArray

_SMALLEST_MM, _SMALLEST_RAD = 1e-4, 2e-7
_SMALLEST_POINT_MM = 1e-4
_PROBE, _LONGEST = 0.3, 5.0
"""Step of the probes in the logarithm of a sigma, and the longest step in probes."""
_FREE_PER_SHOT = 3
"""What the pose noise of a shot takes out of its patches."""


def estimate_point_noise(patch_sums: FloatArray, noise: NoiseModel) -> NoiseModel:
    """Point noise and form error from (m, 12, 3) counts, sums and sums of squares of the residuals per patch.

    Scatter within patches is noise; what patch means have beyond it is form. Medians over shots shrug off spoiled ones.
    """
    n, total, squares = patch_sums[..., 0], patch_sums[..., 1], patch_sums[..., 2]
    filled = np.maximum(n, 1.0)
    within = (squares - total**2 / filled).sum(axis=1) / np.maximum((n - (n > 0)).sum(axis=1), 1.0)
    point_variance = max(float(np.median(within)), _SMALLEST_POINT_MM**2)
    n_patches = (n > 0).sum(axis=1)
    between = (total**2 / filled).sum(axis=1) - np.maximum(n_patches - _FREE_PER_SHOT, 1) * point_variance
    form_variance = float(np.median(between / np.maximum(n.sum(axis=1), 1.0))) * PATCHES / (PATCHES - _FREE_PER_SHOT)
    return replace(noise, point_mm=float(np.sqrt(point_variance)), form_mm=float(np.sqrt(max(form_variance, 0.0))))


def estimate_pose_noise(linearised: Linearised, start: NoiseModel, *, sweeps: int = 4) -> NoiseModel:
    """The (s_t, s_r) that make the data most likely, unknowns integrated out; never below a tenth of a micrometre.

    Parabolas through three points in the logarithm of one sigma after the other: the cost is flat towards zero, where
    Newton steps go astray. A few sweeps find it; one follows it while the solve itself still moves.
    """
    floor = np.log([_SMALLEST_MM, _SMALLEST_RAD])
    where = np.maximum(np.log([start.pose_mm, start.pose_rad]), floor)

    def cost(log_sigma: FloatArray) -> float:
        sigma_mm, sigma_rad = np.exp(np.maximum(log_sigma, floor))
        return marginal_cost(linearised, replace(start, pose_mm=float(sigma_mm), pose_rad=float(sigma_rad)).pose_precision)

    here = cost(where)
    for _ in range(sweeps):
        for axis in range(2):
            where, here = _parabola_step(cost, where, here, axis)
        where = np.maximum(where, floor)
    return replace(start, pose_mm=float(np.exp(where[0])), pose_rad=float(np.exp(where[1])))


def _parabola_step(cost: Callable[[FloatArray], float], where: FloatArray, here: float, axis: int) -> tuple[FloatArray, float]:
    """One coordinate's best of the three points and of the vertex of their parabola."""
    unit = np.zeros(2)
    unit[axis] = _PROBE
    above, below = cost(where + unit), cost(where - unit)
    curvature = above + below - 2 * here
    step = 0.5 * (below - above) / curvature if curvature > 0 else np.sign(below - above) * _LONGEST
    vertex = where + unit * float(np.clip(step, -_LONGEST, _LONGEST))
    tried = [(here, where), (above, where + unit), (below, where - unit), (cost(vertex), vertex)]
    best, place = min(tried, key=lambda item: item[0])
    return place, best
