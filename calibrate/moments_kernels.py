"""The one pass over all points: moment matrices of every shot, and what the noise is estimated from.

About the sphere's centre a residual feels a rigid motion only as a translation of the centre: with u the unit normal
where the point's line of sight meets the sphere, the turning part u . (phi x R u) is zero. So all geometric columns of a
shot's Jacobian are linear in the three numbers u, and one small matrix of sums per shot replaces its points later on.

The residual is taken along the line of sight and projected on the normal. A radial residual |W - c| - R is to first
order the same, but its normal is tilted by the point's own noise, which runs along the sight: at 0.08 mm that bends
the fitted sphere by some micrometres, and a solve over 10^5 points mistakes the bend for a camera error of 0.01 mm.

For the same reason the camera's terms are taken where the point would be without its noise: on the sphere, along the
sight. At the noisy points they correlate with the residuals (errors in variables): 0.08 mm of depth noise then cost
0.015 mm of bias on the paper's cell.

Points go through in blocks, a row of a block a quantity, so that every loop runs on vector instructions.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from calibrate.polynomial_kernels import add_correction, polynomial_products, term_shares
from calibrate.polynomials import Polynomials
from drivers.compiled import parallel_range, vectorised, vectorised_parallel

FloatArray = NDArray[np.float64]

GRAZING_COSINE = 0.3
"""Where the line of sight meets the sphere more grazingly than this (or not at all), the radial residual is used."""
BLOCK = 128
_ROOT_3 = math.sqrt(3.0)


@vectorised
def _residuals(
    sights: FloatArray, corrected: FloatArray, centre: FloatArray, radius: float, along_sight: bool, n: int, rows: FloatArray, cosines: FloatArray
) -> None:
    """Normals and residuals of corrected points (3, >= n) into rows 0 to 2 and the last of `rows`; cosines of incidence.

    `sights` (3, >= n) are unit vectors towards the camera.
    """
    last = rows.shape[0] - 1
    least = (GRAZING_COSINE * radius) ** 2
    for i in range(n):
        x, y, z = corrected[0, i] - centre[0], corrected[1, i] - centre[1], corrected[2, i] - centre[2]
        dx, dy, dz = sights[0, i], sights[1, i], sights[2, i]
        squared = x * x + y * y + z * z
        distance = math.sqrt(squared)
        along = x * dx + y * dy + z * dz
        discriminant = along * along - squared + radius * radius
        hits = along_sight and discriminant > least
        depth = math.sqrt(discriminant) if hits else 0.0
        past = along - depth if hits else 0.0
        size = radius if hits else distance
        rows[0, i] = (x - past * dx) / size
        rows[1, i] = (y - past * dy) / size
        rows[2, i] = (z - past * dz) / size
        rows[last, i] = past * depth / radius if hits else distance - radius
        cosines[i] = depth / radius


@vectorised
def _denoise(measured: FloatArray, sights: FloatArray, rows: FloatArray, cosines: FloatArray, n: int, result: FloatArray) -> None:
    """Fill `result` (3, >= n) with measured points moved onto their sphere: along the sight, or else radially."""
    last = rows.shape[0] - 1
    for i in range(n):
        hits = cosines[i] > 0.0
        shift = -rows[last, i] / cosines[i] if hits else -rows[last, i]
        for axis in range(3):
            result[axis, i] = measured[axis, i] + shift * (sights[axis, i] if hits else rows[axis, i])


@vectorised
def _load(points: FloatArray, first: int, n: int, measured: FloatArray, sights: FloatArray) -> None:
    """A block of points (N, 3) as rows (3, >= n), and the unit vectors from them to the camera."""
    for i in range(n):
        x, y, z = points[first + i, 0], points[first + i, 1], points[first + i, 2]
        scale = -1.0 / math.sqrt(x * x + y * y + z * z)
        measured[0, i], measured[1, i], measured[2, i] = x, y, z
        sights[0, i], sights[1, i], sights[2, i] = scale * x, scale * y, scale * z


@vectorised
def _add_outer(rows: FloatArray, weights: FloatArray, n: int, weighted: FloatArray, sums: FloatArray) -> None:
    """Add the weighted sums of products of all rows (v, >= n) to the upper triangle of `sums` (v, v)."""
    size = rows.shape[0]
    for a in range(size):
        row = rows[a]
        for i in range(n):
            weighted[i] = weights[i] * row[i]
        for b in range(a, size):
            other, total = rows[b], 0.0
            for i in range(n):
                total += weighted[i] * other[i]
            sums[a, b] += total


@vectorised
def _add_patches(
    rows: FloatArray,
    cosines: FloatArray,
    cutoff: float,
    frame: FloatArray,
    first: float,
    count: float,
    n: int,
    patches: FloatArray,
) -> None:
    """Add to each point's patch (12, 7): its number, residual, residual², normal and cos².

    Caps are cut into six sectors of two rings about the line of sight to the centre, profiles (cosine 0) into twelve
    pieces along the arc. Residuals beyond the cutoff are left out.
    """
    last = rows.shape[0] - 1
    for i in range(n):
        residual = rows[last, i]
        if not abs(residual) <= cutoff:
            continue
        if cosines[i] > 0.0:
            a = rows[0, i] * frame[0, 0] + rows[1, i] * frame[0, 1] + rows[2, i] * frame[0, 2]
            b = rows[0, i] * frame[1, 0] + rows[1, i] * frame[1, 1] + rows[2, i] * frame[1, 2]
            # three half-planes at 60 degrees leave six of eight sign patterns: 0, 1, 3, 4, 6, 7
            signs = 4 * (b > 0.0) + 2 * (_ROOT_3 * a + b > 0.0) + (_ROOT_3 * a - b > 0.0)
            sector = signs - (signs >= 2) - (signs >= 5)
            patch = sector + (6 if a * a + b * b > 0.375 else 0)
        else:
            patch = int(12.0 * (first + i) / count)
        patches[patch, 0] += 1.0
        patches[patch, 1] += residual
        patches[patch, 2] += residual * residual
        patches[patch, 3] += rows[0, i]
        patches[patch, 4] += rows[1, i]
        patches[patch, 5] += rows[2, i]
        patches[patch, 6] += cosines[i] * cosines[i]


@vectorised
def _across_sight(centre: FloatArray, frame: FloatArray) -> None:
    """Two unit vectors (2, 3) across the line of sight to a centre."""
    norm = math.sqrt(centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2)
    length = math.sqrt(centre[0] ** 2 + centre[2] ** 2)
    ax, az = centre[2] / length, -centre[0] / length
    frame[0, 0], frame[0, 1], frame[0, 2] = ax, 0.0, az
    frame[1, 0], frame[1, 1], frame[1, 2] = centre[1] * az / norm, (centre[2] * ax - centre[0] * az) / norm, -centre[1] * ax / norm


@vectorised_parallel
def shot_sums(
    points: FloatArray,
    starts: NDArray[np.int64],
    table: Polynomials,
    coefficients: FloatArray,
    centres: FloatArray,
    radii: FloatArray,
    along_sight: bool,
    cutoffs: FloatArray,
    incidence: FloatArray,
    moments: FloatArray,
    counts: FloatArray,
    patches: FloatArray,
) -> None:
    """Fill `moments` (m, v, v), the weighted sums of w w' per shot, w = (u, terms along u, -1, residual).

    Points (N, 3) and centres (m, 3) are in the camera frame, shot j owns points starts[j]:starts[j+1]. A point whose
    sight meets the sphere at cosine c has variance s² = incidence[0] + incidence[1] c² relative to the shot's, and the
    weight 1 / s² times Geman-McClure's 1 / (1 + (r / (cutoff s))²)². `counts` (m, 4) receives the sums of the weights and of
    r², the number of points, and the sum of the weights that the second derivative of the robust loss has. `patches` (m, 12, 7),
    see `_add_patches`, is filled unless it is empty.
    """
    n_terms, highest = table.axis.shape[0], table.forward.shape[0]
    size = n_terms + 5
    for j in parallel_range(starts.shape[0] - 1):
        rows, sums = np.zeros((size, BLOCK)), np.zeros((size, size))
        measured, sights, moved = np.zeros((3, BLOCK)), np.zeros((3, BLOCK)), np.zeros((3, BLOCK))
        values, slopes = np.zeros((3, highest + 1, BLOCK)), np.zeros((highest + 2, BLOCK))
        products = np.zeros((max(table.degrees.shape[0], 1), BLOCK))
        cosines, weights, weighted = np.zeros(BLOCK), np.zeros(BLOCK), np.zeros(BLOCK)
        frame = np.zeros((2, 3))
        _across_sight(centres[j], frame)
        sum_w, sum_r2, sum_h = 0.0, 0.0, 0.0
        for first in range(starts[j], starts[j + 1], BLOCK):
            n = min(BLOCK, starts[j + 1] - first)
            _load(points, first, n, measured, sights)
            moved[:] = measured
            if n_terms:
                polynomial_products(table, measured, n, values, slopes, products)
                add_correction(table, coefficients, products, n, moved)
                _residuals(sights, moved, centres[j], radii[j], along_sight, n, rows, cosines)
                _denoise(measured, sights, rows, cosines, n, moved)
                polynomial_products(table, moved, n, values, slopes, products)
                moved[:] = measured
                add_correction(table, coefficients, products, n, moved)
            _residuals(sights, moved, centres[j], radii[j], along_sight, n, rows, cosines)
            term_shares(table, products, rows, n, rows[3:])
            for i in range(n):
                rows[size - 2, i] = -1.0
                r2 = rows[size - 1, i] ** 2
                precision = 1.0 / (incidence[0] + incidence[1] * cosines[i] * cosines[i])
                ratio = r2 * precision / (cutoffs[j] * cutoffs[j])
                weight = precision / ((1.0 + ratio) * (1.0 + ratio))
                weights[i] = weight
                sum_w += weight
                sum_r2 += r2
                sum_h += weight * (1.0 - 3.0 * ratio) / (1.0 + ratio)
            _add_outer(rows, weights, n, weighted, sums)
            if patches.shape[0] > 0:
                first_in_shot, count = float(first - starts[j]), float(starts[j + 1] - starts[j])
                _add_patches(rows, cosines, cutoffs[j], frame, first_in_shot, count, n, patches[j])
        for a in range(size):
            for b in range(a, size):
                moments[j, a, b] = sums[a, b]
                moments[j, b, a] = sums[a, b]
        counts[j, 0], counts[j, 1], counts[j, 2], counts[j, 3] = sum_w, sum_r2, starts[j + 1] - starts[j], sum_h
