"""Per-point loops of the robust sphere fit (numba): import inside the function that needs them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acquire.sphere_kernels import beside
from drivers.compiled import compiled

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@compiled
def share_at_middle(points: FloatArray, centre: FloatArray, radius_mm: float, on_it: BoolArray) -> float:
    """Of the points (n, 3) whose line of sight meets the middle of the sphere, the share that is marked."""
    middle = 0
    hits = 0
    for i in range(points.shape[0]):
        if beside(points[i], centre) < 0.8 * radius_mm:
            middle += 1
            hits += on_it[i]
    # nothing seen there (a highlight, say) speaks neither for nor against
    return hits / middle if middle > 0 else 1.0


@compiled
def shape(points: FloatArray, centre: FloatArray, across: FloatArray, radius_mm: float, facing: float) -> FloatArray:
    """(n, 4): residual from the surface, cosine of the incidence angle, the normal's two parts along `across` (2, 3)."""
    result = np.zeros((points.shape[0], 4))
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        dx, dy, dz = x - centre[0], y - centre[1], z - centre[2]
        distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-9)
        result[i, 0] = distance - radius_mm
        result[i, 1] = -facing * (dx * x + dy * y + dz * z) / (distance * np.sqrt(x * x + y * y + z * z))
        result[i, 2] = (dx * across[0, 0] + dy * across[0, 1] + dz * across[0, 2]) / distance
        result[i, 3] = (dx * across[1, 0] + dy * across[1, 1] + dz * across[1, 2]) / distance
    return result


@compiled
def form_normal(shaped: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Normal equations (6, 6), (6,) of a quadratic in the last two columns of `shape` to the first, over some rows."""
    normal, right = np.zeros((6, 6)), np.zeros(6)
    basis = np.zeros(6)
    for row in rows:
        a, b = shaped[row, 2], shaped[row, 3]
        basis[0], basis[1], basis[2], basis[3], basis[4], basis[5] = 1.0, a, b, a * a, a * b, b * b
        for i in range(6):
            right[i] += basis[i] * shaped[row, 0]
            for j in range(i + 1):
                normal[i, j] += basis[i] * basis[j]
    for i in range(6):
        for j in range(i):
            normal[j, i] = normal[i, j]
    return normal, right


@compiled
def without_form(shaped: FloatArray, form: FloatArray) -> FloatArray:
    """(n,) residuals less a quadratic form (6,)."""
    result = np.zeros(shaped.shape[0])
    for i in range(shaped.shape[0]):
        a, b = shaped[i, 2], shaped[i, 3]
        result[i] = shaped[i, 0] - form[0] - form[1] * a - form[2] * b - form[3] * a * a - form[4] * a * b - form[5] * b * b
    return result


@compiled
def fixed_radius_normal(points: FloatArray, rows: IntArray, centre: FloatArray, radius_mm: float) -> tuple[FloatArray, FloatArray]:
    """Normal equations (3, 3), (3,) of one Gauss-Newton step of the centre over some rows."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    u = np.zeros(3)
    for row in rows:
        distance = 0.0
        for i in range(3):
            u[i] = points[row, i] - centre[i]
            distance += u[i] * u[i]
        distance = max(np.sqrt(distance), 1e-9)
        for i in range(3):
            u[i] /= distance
        for i in range(3):
            right[i] += u[i] * (distance - radius_mm)
            for j in range(3):
                normal[i, j] += u[i] * u[j]
    return normal, right
