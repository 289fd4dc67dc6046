"""Least-squares spheres: Gauss-Newton on the distance from the surface, with the radius known or free.

The known (certified) radius gives the centre; the free radius is a diagnostic only, because it couples one to one
into the depth of the centre (facts: cameras 6). Residual `|p - c| - R`, row of the Jacobian `-u` with `u` the unit
vector from centre to point: A. B. Forbes, "Least-squares best-fit geometric elements", NPL DITC 140/89.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.errors import DataError

FloatArray = NDArray[np.float64]

_MAX_STEPS = 50
_CONVERGED = 1e-10


def fit_fixed_radius(
    points_mm: ArrayLike, radius_mm: float, start_mm: ArrayLike, weights: ArrayLike | None = None
) -> tuple[FloatArray, FloatArray]:
    """Centre of a sphere of known radius by least squares.

    Args:
        points_mm: (n, 3) points on the surface, n >= 4.
        radius_mm: the certified radius.
        start_mm: (3,) a start on the right side: the mirror centre, on the other side of the cap, is a minimum too.
        weights: (n,) or None.

    Returns:
        centre (3,) in the frame of the points, and its covariance (3, 3) in mm² from the residual variance.

    Raises:
        DataError: fewer than 4 points, or points that do not fix a centre.
    """
    points, weight = _checked(points_mm, weights, least=4)
    centre, residual, direction = _descend(points, weight, np.asarray(start_mm, dtype=np.float64), radius_mm, free=False)
    return centre[:3], _covariance(direction, residual, weight)


def fit_free_radius(
    points_mm: ArrayLike, radius_mm: float, start_mm: ArrayLike, weights: ArrayLike | None = None
) -> tuple[FloatArray, float, FloatArray]:
    """Centre and radius by least squares, as a diagnostic.

    Args:
        points_mm: (n, 3) points on the surface, n >= 5.
        radius_mm: where the radius starts.
        start_mm: (3,) where the centre starts.
        weights: (n,) or None.

    Returns:
        centre (3,), radius in mm, covariance (4, 4) of (centre, radius) in mm².

    Raises:
        DataError: fewer than 5 points, or points that do not fix a sphere (a plane, a circle).
    """
    points, weight = _checked(points_mm, weights, least=5)
    start = np.append(np.asarray(start_mm, dtype=np.float64), radius_mm)
    found, residual, direction = _descend(points, weight, start, radius_mm, free=True)
    design = np.column_stack([direction, np.ones(len(direction))])
    return found[:3], float(found[3]), _covariance(design, residual, weight)


def _checked(points_mm: ArrayLike, weights: ArrayLike | None, *, least: int) -> tuple[FloatArray, FloatArray]:
    points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 3)
    if len(points) < least:
        raise DataError(f"{len(points)} points cannot fix a sphere", remedy=f"Give at least {least} points on its surface.")
    weight = np.ones(len(points)) if weights is None else np.asarray(weights, dtype=np.float64)
    return points, weight


def _descend(points: FloatArray, weight: FloatArray, start: FloatArray, radius_mm: float, *, free: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gauss-Newton with Levenberg damping (raised when a step makes it worse): parameters, residuals, unit vectors."""
    parameters, damping = start.copy(), 0.0
    residual, direction = _evaluate(points, parameters, radius_mm, free=free)
    cost = float((weight * residual**2).sum())
    for _ in range(_MAX_STEPS):
        step = _step(direction, residual, weight, damping, free=free)
        trial = parameters + step
        trial_residual, trial_direction = _evaluate(points, trial, radius_mm, free=free)
        trial_cost = float((weight * trial_residual**2).sum())
        if trial_cost > cost * (1 + 1e-12):
            damping = max(10 * damping, 1e-3)
            continue
        parameters, residual, direction, cost, damping = trial, trial_residual, trial_direction, trial_cost, damping / 10
        if np.abs(step).max() < _CONVERGED * radius_mm:
            break
    return parameters, residual, direction


def _evaluate(points: FloatArray, parameters: FloatArray, radius_mm: float, *, free: bool) -> tuple[FloatArray, FloatArray]:
    offset = points - parameters[:3]
    distance = np.sqrt(np.einsum("ij,ij->i", offset, offset))
    return distance - (parameters[3] if free else radius_mm), offset / np.maximum(distance, 1e-12)[:, None]


def _step(direction: FloatArray, residual: FloatArray, weight: FloatArray, damping: float, *, free: bool) -> FloatArray:
    design = np.column_stack([direction, np.ones(len(direction))]) if free else direction
    weighted = design * weight[:, None]
    # einsum and not a matrix product: on so thin an array a threaded BLAS is slower, a hundredfold on a busy machine
    normal = np.einsum("ni,nj->ij", weighted, design)
    normal[np.diag_indices_from(normal)] *= 1 + damping
    return np.asarray(np.linalg.lstsq(normal, np.einsum("ni,n->i", weighted, residual), rcond=1e-13)[0])


def _covariance(design: FloatArray, residual: FloatArray, weight: FloatArray) -> FloatArray:
    normal = np.einsum("ni,nj->ij", design * weight[:, None], design)
    if np.linalg.cond(normal) > 1e13:
        raise DataError("the points do not fix the sphere's centre", remedy="Use points spread over a cap, not on a plane or a line.")
    freedom = max(len(residual) - design.shape[1], 1)
    return np.asarray(np.linalg.inv(normal) * float((weight * residual**2).sum()) / freedom)
