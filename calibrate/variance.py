"""Noise from the data: points and form from the residuals' patches, pose noise by restricted maximum likelihood."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calibrate.normal import PATCHES, Linearised, MarginalCost, NoiseModel
from drivers.kinematics.se3 import FloatArray

_SMALLEST_MM, _SMALLEST_RAD = 1e-4, 2e-7
_SMALLEST_POINT_MM = 1e-4
_PROBE, _LONGEST = 0.3, 5.0
"""Step of the probes in the logarithm of a sigma, and the longest step in probes."""
_FEWEST_IN_RING = 30
_LEAST_FLAT = 0.1
_HIGHEST_POWER = 4.0
_RUNGS = 8
_SMALL_PROBE, _LONGEST_NEWTON, _NEWTON_TOLERANCE, _MOST_NEWTON_STEPS = 0.02, 0.5, 1e-6, 6
_FREE_PER_SHOT = 3
"""What the pose noise of a shot takes out of its patches."""


def estimate_point_noise(patches: FloatArray, noise: NoiseModel) -> NoiseModel:
    """Point noise and form error from the sums of (m, 12, 7) patches, see `ShotSums`.

    Scatter within patches is noise; what patch means have beyond it is form, once each shot's own best shift is taken out:
    what pose noise is taken to be has no part in it. Medians over shots shrug off spoiled ones.
    """
    n = patches[..., 0]
    within = _within_patches_mm2(patches)
    point_variance = max(float(np.median(within)), _SMALLEST_POINT_MM**2)
    n_patches = (n > 0).sum(axis=1)
    between = _shapes_mm2(patches) - np.maximum(n_patches - _FREE_PER_SHOT, 1) * within
    form_variance = float(np.median(between / np.maximum(n.sum(axis=1), 1.0))) * PATCHES / (PATCHES - _FREE_PER_SHOT)
    return replace(noise, point_mm=float(np.sqrt(point_variance)), form_mm=float(np.sqrt(max(form_variance, 0.0))))


def _shapes_mm2(patches: FloatArray) -> FloatArray:
    """(m,) weighted sum of squares of the patch means that no shift of the shot's sphere explains."""
    n, total, unit = patches[..., 0], patches[..., 1], patches[..., 3:6]
    filled = np.maximum(n, 1.0)[..., None]
    normal = np.swapaxes(unit, 1, 2) @ (unit / filled)
    normal = normal + 1e-9 * np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-12)[:, None, None] * np.eye(3)
    right = np.swapaxes(unit, 1, 2) @ (total[..., None] / filled)
    return np.asarray((total**2 / filled[..., 0]).sum(axis=1) - (right * np.linalg.solve(normal, right)).sum(axis=(1, 2)))


def estimate_incidence(patches: FloatArray, noise: NoiseModel) -> NoiseModel:
    """How a point's variance depends on incidence, from the two rings of (m, 12, 7) patches of caps.

    Noise along the sight shows as cos² in a residual along the normal, noise of the surface itself does not: two parts,
    neither negative, a line through what scatters within the inner and within the outer patches.
    """
    rings = [patches[:, : PATCHES // 2], patches[:, PATCHES // 2 :]]
    seen = [ring[ring[..., 0].sum(axis=1) > _FEWEST_IN_RING] for ring in rings]
    if not all(len(ring) for ring in seen):
        return replace(noise, flat=1.0, steep=0.0)
    variance = [float(np.median(_within_patches_mm2(ring))) for ring in seen]
    number, cos2 = np.array([ring[..., 0].sum() for ring in rings]), np.array([ring[..., 6].sum() for ring in rings])
    inner, outer = cos2 / number
    typical = float(cos2.sum() / number.sum())
    slope = (variance[0] - variance[1]) / max(inner - outer, 1e-6)
    constant = variance[1] - slope * outer
    mean = constant + slope * typical
    # points that graze are never trusted without bounds, however quiet they look
    flat = float(np.clip(constant / mean, _LEAST_FLAT, 1.0)) if mean > 0.0 else 1.0
    return replace(noise, flat=flat, steep=(1.0 - flat) / typical)


def estimate_range_growth(patches: FloatArray, range_mm: FloatArray, noise: NoiseModel) -> NoiseModel:
    """The power of the range (m,) with which noise within patches grows, between none and the square's square.

    Shots at nearly the same range do not tell it: a weak belief in none (power 0 +- 1) then decides.
    """
    variance = _within_patches_mm2(patches)
    middle_mm = float(np.median(range_mm))
    x = np.log(range_mm / middle_mm)
    y = np.log(np.maximum(variance, _SMALLEST_POINT_MM**2)) / 2.0
    y = y - np.median(y)
    scatter = float(np.median(np.abs(y))) ** 2 + 1e-12
    power = float(np.clip((x @ y) / (x @ x + scatter), 0.0, _HIGHEST_POWER))
    typical = float(np.sqrt(np.median(variance / (range_mm / middle_mm) ** (2 * power))))
    return replace(noise, point_mm=max(typical, _SMALLEST_POINT_MM), range_power=power, range_mm=middle_mm)


def _within_patches_mm2(patches: FloatArray) -> FloatArray:
    """(m,) variance of the residuals about their patch's mean."""
    n, total, squares = patches[..., 0], patches[..., 1], patches[..., 2]
    return np.asarray((squares - total**2 / np.maximum(n, 1.0)).sum(axis=1) / np.maximum((n - (n > 0)).sum(axis=1), 1.0))


def estimate_pose_noise(linearised: Linearised, start: NoiseModel, *, sweeps: int = 4) -> NoiseModel:
    """The (s_t, s_r) that make the data most likely, unknowns integrated out; never below a tenth of a micrometre.

    Parabolas through three points in the logarithm of one sigma after the other: the cost is flat towards zero, where
    Newton steps go astray. A few sweeps find it; with none, Newton steps end a search that has come near it.
    """
    floor = np.log([_SMALLEST_MM, _SMALLEST_RAD])
    where = np.maximum(np.log([start.pose_mm, start.pose_rad]), floor)
    marginal_cost = MarginalCost(linearised)

    def cost(log_sigma: FloatArray) -> float:
        sigma_mm, sigma_rad = np.exp(np.maximum(log_sigma, floor))
        return marginal_cost(replace(start, pose_mm=float(sigma_mm), pose_rad=float(sigma_rad)).pose_precision)

    where = minimise_by_parabolas(cost, where, floor, sweeps=sweeps)
    return replace(start, pose_mm=float(np.exp(where[0])), pose_rad=float(np.exp(where[1])))


def minimise_by_parabolas(cost: Callable[[FloatArray], float], where: FloatArray, floor: FloatArray, *, sweeps: int) -> FloatArray:
    """Coordinate descent (k,) by parabolas from a start, never below the floor; no sweeps: Newton steps from near the minimum.

    Where parabolas end depends on where they began, by some per cent; Newton steps end in the minimum itself.
    """
    if not sweeps:
        return _polished(cost, where, floor)
    for _ in range(sweeps):
        where = _sweep(cost, where, floor)
    return where


def _sweep(cost: Callable[[FloatArray], float], where: FloatArray, floor: FloatArray) -> FloatArray:
    here = cost(where)
    for axis in range(len(where)):
        where, here = _parabola_step(cost, where, here, axis)
    return np.maximum(where, floor)


def _lifted(cost: Callable[[FloatArray], float], where: FloatArray, floor: FloatArray) -> FloatArray:
    """A way out for coordinates at the floor, about which the cost is flat: the best of some places above it."""
    for axis in np.flatnonzero(where <= floor + _SMALL_PROBE):
        places = [where + unit for unit in np.outer(np.arange(_RUNGS) * np.log(3.0), np.eye(len(where))[axis])]
        where = min(places, key=cost)
    return where


def _polished(cost: Callable[[FloatArray], float], where: FloatArray, floor: FloatArray) -> FloatArray:
    where = _lifted(cost, where, floor)
    for _ in range(_MOST_NEWTON_STEPS):
        free = np.flatnonzero(where > floor + _SMALL_PROBE)
        if not len(free):
            break
        gradient, hessian = _differences(cost, where, free)
        step = -np.linalg.solve(hessian, gradient) if np.linalg.eigvalsh(hessian)[0] > 0 else np.full(len(free), np.inf)
        if np.abs(step).max() > _LONGEST_NEWTON:
            where = _sweep(cost, where, floor)
            continue
        where = where.copy()
        where[free] += step
        where = np.maximum(where, floor)
        if np.abs(step).max() < _NEWTON_TOLERANCE:
            break
    return where


def _differences(cost: Callable[[FloatArray], float], where: FloatArray, free: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """Gradient (f,) and Hessian (f, f) of the cost along some coordinates."""
    unit = _SMALL_PROBE * np.eye(len(where))[free]
    here = cost(where)
    above, below = np.array([cost(where + u) for u in unit]), np.array([cost(where - u) for u in unit])
    hessian = np.diag(above + below - 2 * here)
    for i, j in combinations(range(len(free)), 2):
        # both orders of the mixed difference, so that the error is of second order
        mixed = cost(where + unit[i] + unit[j]) + cost(where - unit[i] - unit[j]) + 2 * here - above[i] - below[i] - above[j] - below[j]
        hessian[i, j] = hessian[j, i] = mixed / 2
    return (above - below) / (2 * _SMALL_PROBE), hessian / _SMALL_PROBE**2


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
