"""Camera error models at blocks of points: products of one-dimensional polynomials, and the correction they make."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibrate.polynomials import Polynomials
from drivers.compiled import vectorised

FloatArray = NDArray[np.float64]


@vectorised
def _next_value(t: FloatArray, last: FloatArray, before: FloatArray, forward: float, backward: float, n: int, result: FloatArray) -> None:
    for i in range(n):
        result[i] = forward * t[i] * last[i] - backward * before[i]


@vectorised
def _next_slope(
    t: FloatArray, value: FloatArray, last: FloatArray, before: FloatArray, forward: float, backward: float, n: int, result: FloatArray
) -> None:
    for i in range(n):
        result[i] = forward * (value[i] + t[i] * last[i]) - backward * before[i]


@vectorised
def _tangents(table: Polynomials, t: FloatArray, highest: int, n: int, values: FloatArray, slopes: FloatArray) -> None:
    """Carry the functions on along their tangents where t (>= n) lies outside [-1, 1], `values` being those at the border."""
    for d in range(highest + 1):
        slopes[d, :n] = 1.0 if d == 1 else 0.0
    for d in range(1, highest):
        _next_slope(values[1], values[d], slopes[d], slopes[d - 1], table.forward[d], table.backward[d], n, slopes[d + 1])
    for i in range(n):
        t[i] -= values[1, i]
    for d in range(1, highest + 1):
        value, slope = values[d], slopes[d]
        for i in range(n):
            value[i] += slope[i] * t[i]


@vectorised
def polynomial_products(table: Polynomials, points: FloatArray, n: int, values: FloatArray, slopes: FloatArray, result: FloatArray) -> None:
    """Fill `result` (M, >= n) with the products at the first n points of a block (3, >= n).

    `values` (3, D + 1, >= n) and `slopes` (D + 2, >= n) are room to work in.
    """
    for axis in range(3):
        centre, scale, highest = table.centre_mm[axis], 1.0 / table.scale_mm[axis], 0
        for m in range(table.degrees.shape[0]):
            highest = max(highest, table.degrees[m, axis])
        value, point, t = values[axis], points[axis], slopes[slopes.shape[0] - 1]
        value[0, :n] = 1.0
        if highest == 0:
            continue
        first, outside = value[1], False
        for i in range(n):
            t[i] = (point[i] - centre) * scale
            first[i] = min(max(t[i], -1.0), 1.0) if table.tame else t[i]
            outside |= first[i] != t[i]
        for d in range(1, highest):
            _next_value(first, value[d], value[d - 1], table.forward[d], table.backward[d], n, value[d + 1])
        if outside:
            _tangents(table, t, highest, n, value, slopes)
    for m in range(table.degrees.shape[0]):
        x, y, z, product = values[0, table.degrees[m, 0]], values[1, table.degrees[m, 1]], values[2, table.degrees[m, 2]], result[m]
        for i in range(n):
            product[i] = x[i] * y[i] * z[i]


@vectorised
def add_correction(table: Polynomials, coefficients: FloatArray, products: FloatArray, n: int, points: FloatArray) -> None:
    """Add the correction to a block of points (3, >= n) whose products (M, >= n) are known."""
    for k in range(table.axis.shape[0]):
        moved = points[table.axis[k]]
        for entry in range(table.starts[k], table.starts[k + 1]):
            size, product = table.factor[entry] * coefficients[k], products[table.product[entry]]
            for i in range(n):
                moved[i] += size * product[i]


@vectorised
def term_shares(table: Polynomials, products: FloatArray, normals: FloatArray, n: int, result: FloatArray) -> None:
    """Fill `result` (k, >= n) with each term's motion of a point along its normal (3, >= n)."""
    for k in range(table.axis.shape[0]):
        share, normal = result[k], normals[table.axis[k]]
        for i in range(n):
            share[i] = 0.0
        for entry in range(table.starts[k], table.starts[k + 1]):
            size, product = table.factor[entry], products[table.product[entry]]
            for i in range(n):
                share[i] += size * product[i] * normal[i]
