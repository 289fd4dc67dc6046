"""Where a robust fit stands and how its points scatter: the beginning of every fit.

Tukey's weights on a thinned set find the neighbourhood; a mixture of surface and strays then finds the surface in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.errors import DataError
from drivers.kinematics.se3 import FloatArray
from measure.inspecting.shapes import Distances, Shape
from measure.inspecting.strays import Mixture, mode_mm

_THINNED = 6_000
_ROUNDS = 25
_TUKEY = 4.685
_NARROWER = 0.25
_LEAST_GAIN = 10.0
"""Logarithm of how much likelier a narrower surface must be."""
_LONGEST_STEP_MM = 0.5
_MOST_CONDITION = 1e5


def robust_fit(shape: Shape, local_mm: FloatArray, weights: FloatArray, least_sigma_mm: float, name: str) -> tuple[FloatArray, Mixture]:
    """Parameters (p,), and the mixture that tells surface from strays.

    Args:
        shape: the nominal.
        local_mm: points (n, 3), frame of the shape.
        weights: (n,).
        least_sigma_mm: noise is not taken as less.
        name: of the feature, for errors.

    Raises:
        DataError: the points leave the shape open.
    """
    thinned = slice(None, None, max(1, len(local_mm) // _THINNED))
    few = _Few(local_mm[thinned], weights[thinned] / max(float(weights[thinned].mean()), 1e-12), least_sigma_mm)
    plain, narrow = (_mixed(shape, few, *begun, name) for begun in _beginnings(shape, few, *_tukey(shape, few, name)))
    # some of a few points always happen to lie close together
    return narrow if few.likelihood(shape, *narrow) > few.likelihood(shape, *plain) + _LEAST_GAIN else plain


@dataclass(frozen=True, slots=True, eq=False)
class _Few:
    """Some of a feature's points, enough to tell surface from strays."""

    local_mm: FloatArray
    """(n, 3) frame of the shape."""
    weights: FloatArray
    """(n,) 1 on average."""
    least_sigma_mm: float

    def likelihood(self, shape: Shape, params: FloatArray, mixture: Mixture) -> float:
        return mixture.likelihood(shape.distances(params, self.local_mm).residual_mm, self.weights)


def _beginnings(shape: Shape, few: _Few, start: FloatArray, scale: float) -> tuple[tuple[FloatArray, Mixture], tuple[FloatArray, Mixture]]:
    """Parameters and mixtures to begin with: among many strays the scale is theirs, and the surface a peak beside their middle."""
    at_mode = start.copy()
    at_mode[[name in {"radius", "offset"} for name in shape.names]] += mode_mm(shape.distances(start, few.local_mm).residual_mm)
    wide, narrow = (
        Mixture(sigma, 0.0, max(shape.search_mm / 2, 4 * sigma), shape.search_mm) for sigma in (scale, max(_NARROWER * scale, few.least_sigma_mm))
    )
    return (start, wide), (at_mode, narrow)


def _mixed(shape: Shape, few: _Few, params: FloatArray, mixture: Mixture, name: str) -> tuple[FloatArray, Mixture]:
    """Parameters and mixture that fit together."""
    for _ in range(_ROUNDS):
        found = shape.distances(params, few.local_mm)
        mixture = mixture.updated(found.residual_mm, few.weights, few.least_sigma_mm)
        step = fit_step(found, few.weights * mixture.chances(found.residual_mm), name)
        params = params + step
        if np.abs(step).max() < 1e-3 * mixture.sigma_mm:
            break
    return params, mixture


def _tukey(shape: Shape, few: _Few, name: str) -> tuple[FloatArray, float]:
    """Parameters, and the scale of the residuals about them."""
    params = np.zeros(len(shape.names))
    scale = np.inf
    for _ in range(_ROUNDS):
        found = shape.distances(params, few.local_mm)
        scale = max(_scale_of(found.residual_mm), few.least_sigma_mm)
        share = np.clip(found.residual_mm / (_TUKEY * scale), -1.0, 1.0)
        step = fit_step(found, few.weights * (1.0 - share**2) ** 2, name)
        params = params + step
        if np.abs(step).max() < 1e-3 * scale:
            break
    return params, max(_scale_of(shape.distances(params, few.local_mm).residual_mm), few.least_sigma_mm)


def _scale_of(residual_mm: FloatArray) -> float:
    """Standard deviation about zero, by the median of sizes."""
    return 1.4826 * float(np.median(np.abs(residual_mm)))


def fit_step(found: Distances, weights: FloatArray, name: str) -> FloatArray:
    """(p,) step of weighted least squares.

    Raises:
        DataError: the points leave the shape open.
    """
    weighted = found.jacobian * weights[:, None]
    normal = weighted.T @ found.jacobian
    size = np.sqrt(np.maximum(np.diag(normal), 1e-30))
    if np.linalg.cond(normal / np.outer(size, size)) > _MOST_CONDITION**2:
        raise DataError(
            "the points leave the feature open: they cover too little of it",
            where=name,
            remedy="Scan more of the feature, or describe it by another one (a circle, a plane).",
        )
    step = -np.linalg.solve(normal, weighted.T @ found.residual_mm)
    return np.asarray(step * min(1.0, _LONGEST_STEP_MM / max(float(np.abs(step).max()), 1e-12)))
