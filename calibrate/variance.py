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
_FEWEST_IN_BAND = 20
_LEAST_FLAT = 0.1
_HIGHEST_POWER = 4.0
_FREE_PER_SHOT = 3
"""What the pose noise of a shot takes out of its patches."""


def estimate_point_noise(patch_sums: FloatArray, noise: NoiseModel) -> NoiseModel:
    """Point noise and form error from (m, 12, 3) counts, sums and sums of squares of the residuals per patch.

    Scatter within patches is noise; what patch means have beyond it is form. Medians over shots shrug off spoiled ones.
    """
    n, total = patch_sums[..., 0], patch_sums[..., 1]
    within = _within_patches_mm2(patch_sums)
    point_variance = max(float(np.median(within)), _SMALLEST_POINT_MM**2)
    n_patches = (n > 0).sum(axis=1)
    between = (total**2 / np.maximum(n, 1.0)).sum(axis=1) - np.maximum(n_patches - _FREE_PER_SHOT, 1) * within
    form_variance = float(np.median(between / np.maximum(n.sum(axis=1), 1.0))) * PATCHES / (PATCHES - _FREE_PER_SHOT)
    return replace(noise, point_mm=float(np.sqrt(point_variance)), form_mm=float(np.sqrt(max(form_variance, 0.0))))


def estimate_incidence(bands: FloatArray, noise: NoiseModel) -> NoiseModel:
    """How a point's variance depends on incidence, from (m, 6, 3) numbers, sums of cos² and sums of squares by band.

    Noise along the sight shows as cos² in a residual along the normal, noise of the surface itself does not: two parts,
    neither negative, a line through the bands' medians over the shots.
    """
    n = bands[..., 0]
    used = (n > _FEWEST_IN_BAND).any(axis=0)
    if used.sum() < 2:
        return replace(noise, flat=1.0, steep=0.0)
    mean_square = np.where(n > _FEWEST_IN_BAND, bands[..., 2] / np.maximum(n, 1.0), np.nan)[:, used]
    variance = np.maximum(np.nanmedian(mean_square, axis=0) - noise.form_mm**2, 0.0)
    number, cos2 = n.sum(axis=0)[used], bands[..., 1].sum(axis=0)[used] / n.sum(axis=0)[used]
    slope, constant = np.polyfit(cos2, variance, 1, w=np.sqrt(number))
    typical = float((number * cos2).sum() / number.sum())
    mean = constant + slope * typical
    # points that graze are never trusted without bounds, however quiet they look
    flat = float(np.clip(constant / mean, _LEAST_FLAT, 1.0)) if mean > 0.0 else 1.0
    return replace(noise, flat=flat, steep=(1.0 - flat) / typical)


def estimate_range_growth(patch_sums: FloatArray, range_mm: FloatArray, noise: NoiseModel) -> NoiseModel:
    """The power of the range (m,) with which noise within patches grows, between none and the square's square.

    Shots at nearly the same range do not tell it: a weak belief in none (power 0 +- 1) then decides.
    """
    variance = _within_patches_mm2(patch_sums)
    x = np.log(range_mm / np.median(range_mm))
    y = np.log(np.maximum(variance, _SMALLEST_POINT_MM**2)) / 2.0
    y = y - np.median(y)
    scatter = float(np.median(np.abs(y - np.median(y)))) ** 2 + 1e-12
    power = float(np.clip((x @ y) / (x @ x + scatter), 0.0, _HIGHEST_POWER))
    typical = float(np.sqrt(np.median(variance / (range_mm / np.median(range_mm)) ** (2 * power))))
    return replace(noise, point_mm=max(typical, _SMALLEST_POINT_MM), range_power=power, range_mm=float(np.median(range_mm)))


def _within_patches_mm2(patch_sums: FloatArray) -> FloatArray:
    """(m,) variance of the residuals about their patch's mean."""
    n, total, squares = patch_sums[..., 0], patch_sums[..., 1], patch_sums[..., 2]
    return np.asarray((squares - total**2 / np.maximum(n, 1.0)).sum(axis=1) / np.maximum((n - (n > 0)).sum(axis=1), 1.0))


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

    where = minimise_by_parabolas(cost, where, floor, sweeps=sweeps)
    return replace(start, pose_mm=float(np.exp(where[0])), pose_rad=float(np.exp(where[1])))


def minimise_by_parabolas(cost: Callable[[FloatArray], float], where: FloatArray, floor: FloatArray, *, sweeps: int) -> FloatArray:
    """Coordinate descent (k,) by parabolas from a start, never below the floor."""
    here = cost(where)
    for _ in range(sweeps):
        for axis in range(len(where)):
            where, here = _parabola_step(cost, where, here, axis)
        where = np.maximum(where, floor)
    return where


def _parabola_step(cost: Callable[[FloatArray], float], where: FloatArray, here: float, axis: int) -> tuple[FloatArray, float]:
    """One coordinate's best of the three points and of the vertex of their parabola."""
    unit = np.zeros(len(where))
    unit[axis] = _PROBE
    above, below = cost(where + unit), cost(where - unit)
    curvature = above + below - 2 * here
    step = 0.5 * (below - above) / curvature if curvature > 0 else np.sign(below - above) * _LONGEST
    vertex = where + unit * float(np.clip(step, -_LONGEST, _LONGEST))
    tried = [(here, where), (above, where + unit), (below, where - unit), (cost(vertex), vertex)]
    best, place = min(tried, key=lambda item: item[0])
    return place, best
