"""Nuisances whitened scan by scan: a 6 x 6 Cholesky factor at a time, which NumPy's batches are too small for."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import vectorised

FloatArray = NDArray[np.float64]


@vectorised
def whiten(hessian: FloatArray, precision: FloatArray, rows: FloatArray, white: FloatArray) -> float:
    """Fill `white` (G, 6, P) with inv(L_g) rows_g (G, 6, P), L_g L_g' = hessian_g (G, 6, 6) + diag(precision (6,)).

    Returns the sum over scans of log |L_g L_g'|; NaN where one is not positive.
    """
    factor, size, total = np.zeros((6, 6)), rows.shape[2], 0.0
    for g in range(hessian.shape[0]):
        for a in range(6):
            for b in range(a + 1):
                value = hessian[g, a, b]
                for c in range(b):
                    value -= factor[a, c] * factor[b, c]
                if a == b:
                    pivot = value + precision[a]
                    if not pivot > 0.0:
                        return math.nan
                    factor[a, a] = math.sqrt(pivot)
                    total += math.log(pivot)
                else:
                    factor[a, b] = value / factor[b, b]
        for a in range(6):
            for k in range(size):
                white[g, a, k] = rows[g, a, k]
            for c in range(a):
                share = factor[a, c]
                for k in range(size):
                    white[g, a, k] -= share * white[g, c, k]
            over = 1.0 / factor[a, a]
            for k in range(size):
                white[g, a, k] *= over
    return total
