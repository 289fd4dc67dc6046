"""Noise from the data: points and form from the residuals' patches, pose noise by restricted maximum likelihood."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibrate.normal import PATCHES, Linearised, NoiseModel, marginal_cost
from drivers.kinematics.se3 import FloatArray

_SMALLEST_MM, _SMALLEST_RAD = 1e-4, 2e-7
_SMALLEST_POINT_MM = 1e-4
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


def estimate_pose_noise(linearised: Linearised, start: NoiseModel) -> NoiseModel:
    """The (s_t, s_r) that make the data most likely, unknowns integrated out; never below a tenth of a micrometre.

    Nelder-Mead in the logarithms: the cost is flat towards zero, where Newton steps go astray.
    """
    from scipy.optimize import minimize

    floor = np.log([_SMALLEST_MM, _SMALLEST_RAD])

    def cost(log_sigma: FloatArray) -> float:
        sigma_mm, sigma_rad = np.exp(np.maximum(log_sigma, floor))
        excess = float(np.maximum(floor - log_sigma, 0.0).sum())
        return marginal_cost(linearised, replace(start, pose_mm=sigma_mm, pose_rad=sigma_rad).pose_precision) + excess

    first = np.maximum(np.log([start.pose_mm, start.pose_rad]), floor + 1.0)
    simplex = first + np.array([[0.0, 0.0], [-0.7, 0.0], [0.0, -0.7]])
    found = minimize(cost, first, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 0.02, "fatol": 0.02, "maxfev": 80})
    sigma_mm, sigma_rad = np.exp(np.maximum(found.x, floor))
    return replace(start, pose_mm=float(sigma_mm), pose_rad=float(sigma_rad))
