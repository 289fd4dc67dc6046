"""The way of many points into the base, in one compiled pass; import inside functions (numba)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibrate.polynomial_kernels import add_correction, polynomial_products
from calibrate.polynomials import Polynomials
from drivers.compiled import vectorised

FloatArray = NDArray[np.float64]

_BLOCK = 512
"""Points corrected together: their polynomials stay in the nearest cache."""
_LARGEST = np.finfo(np.float64).max


@vectorised
def place_points(
    points_in_camera_mm: NDArray[np.floating], table: Polynomials, camera_mm: FloatArray, base_from_camera: FloatArray, points_in_base_mm: FloatArray
) -> None:
    """Correct points (n, 3) by a camera error model with coefficients (k,), move them by (4, 4), and write them into (n, 3).

    One thread: blocks are cut the same way whoever else computes, so the result never depends on threads. NaN stays NaN.
    """
    r, n_points, n_products = base_from_camera, points_in_camera_mm.shape[0], table.degrees.shape[0]
    highest = table.forward.shape[0]
    block, values, slopes = np.zeros((3, _BLOCK)), np.zeros((3, highest + 1, _BLOCK)), np.zeros((highest + 2, _BLOCK))
    products, hole = np.zeros((n_products, _BLOCK)), np.zeros(_BLOCK)
    for start in range(0, n_points, _BLOCK):
        n, n_valid = min(_BLOCK, n_points - start), 0
        for i in range(n):
            x = np.float64(points_in_camera_mm[start + i, 0])
            y = np.float64(points_in_camera_mm[start + i, 1])
            z = np.float64(points_in_camera_mm[start + i, 2])
            # isfinite says yes to infinity where sums may be regrouped
            valid = (abs(x) <= _LARGEST) & (abs(y) <= _LARGEST) & (abs(z) <= _LARGEST)
            n_valid += 1 if valid else 0
            hole[i] = 0.0 if valid else np.nan
            # holes are corrected as the middle of the model, so that they cost no detour
            block[0, i] = x if valid else table.centre_mm[0]
            block[1, i] = y if valid else table.centre_mm[1]
            block[2, i] = z if valid else table.centre_mm[2]
        if n_valid and n_products:
            polynomial_products(table, block, n, values, slopes, products)
            add_correction(table, camera_mm, products, n, block)
        for i in range(n):
            x, y, z = block[0, i], block[1, i], block[2, i]
            points_in_base_mm[start + i, 0] = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + r[0, 3] + hole[i]
            points_in_base_mm[start + i, 1] = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + r[1, 3] + hole[i]
            points_in_base_mm[start + i, 2] = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + r[2, 3] + hole[i]
