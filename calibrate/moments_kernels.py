"""The one pass over all points: moment matrices of every shot.

About the sphere's centre a residual feels a rigid motion only as a translation of the centre: with u the unit normal
where the point's line of sight meets the sphere, the turning part u . (phi x R u) is zero. So all geometric columns of a
shot's Jacobian are linear in the three numbers u, and one small matrix of sums per shot replaces its points later on.

The residual is taken along the line of sight and projected on the normal. A radial residual |W - c| - R is to first
order the same, but its normal is tilted by the point's own noise, which runs along the sight: at 0.08 mm that bends
the fitted sphere by some micrometres, and a solve over 10^5 points mistakes the bend for a camera error of 0.01 mm.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, compiled_parallel, parallel_range

FloatArray = NDArray[np.float64]

GRAZING_COSINE = 0.3
"""Where the line of sight meets the sphere more grazingly than this (or not at all), the radial residual is used."""


@compiled
def point_residual(
    points: FloatArray,
    basis: FloatArray,
    axis: NDArray[np.int64],
    coefficients: FloatArray,
    i: int,
    centre: FloatArray,
    radius: float,
    along_sight: bool,
    v: FloatArray,
) -> float:
    """Residual in mm of corrected point i; the normal goes to v[0:3]."""
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    cx, cy, cz = x, y, z
    for k in range(axis.shape[0]):
        shift = basis[i, k] * coefficients[k]
        if axis[k] == 2:
            cz += shift
        elif axis[k] == 0:
            cx += shift
        else:
            cy += shift
    cx -= centre[0]
    cy -= centre[1]
    cz -= centre[2]
    squared = cx * cx + cy * cy + cz * cz
    if along_sight:
        scale = -1.0 / math.sqrt(x * x + y * y + z * z)
        dx, dy, dz = scale * x, scale * y, scale * z
        along = cx * dx + cy * dy + cz * dz
        discriminant = along * along - squared + radius * radius
        if discriminant > (GRAZING_COSINE * radius) ** 2:
            depth = math.sqrt(discriminant)
            t = along - depth
            v[0] = (cx - t * dx) / radius
            v[1] = (cy - t * dy) / radius
            v[2] = (cz - t * dz) / radius
            return float(t * depth / radius)
    distance = math.sqrt(squared)
    v[0] = cx / distance
    v[1] = cy / distance
    v[2] = cz / distance
    return distance - radius


@compiled_parallel
def shot_moments(
    points: FloatArray,
    basis: FloatArray,
    axis: NDArray[np.int64],
    coefficients: FloatArray,
    starts: NDArray[np.int64],
    centres: FloatArray,
    radii: FloatArray,
    along_sight: bool,
    cutoff: float,
    moments: FloatArray,
    counts: FloatArray,
) -> None:
    """Fill `moments` (m, v, v), the weighted sums of v v' per shot, v = (u, basis * u[axis], -1, residual).

    Points (n, 3) and centres (m, 3) are in the camera frame, shot j owns points starts[j]:starts[j+1]. The weight of a
    point is Geman-McClure's 1 / (1 + (r / cutoff)²)², or 1 for an infinite cutoff; `counts` (m, 3) receives the sum of
    the weights, of r² and of the number of points.
    """
    n_terms = axis.shape[0]
    size = n_terms + 5
    for j in parallel_range(starts.shape[0] - 1):
        v = np.zeros(size)
        sums = np.zeros((size, size))
        sum_w = 0.0
        sum_r2 = 0.0
        for i in range(starts[j], starts[j + 1]):
            residual = point_residual(points, basis, axis, coefficients, i, centres[j], radii[j], along_sight, v)
            for k in range(n_terms):
                v[3 + k] = basis[i, k] * v[axis[k]]
            v[size - 2] = -1.0
            v[size - 1] = residual
            ratio = residual / cutoff
            weight = 1.0 / ((1.0 + ratio * ratio) * (1.0 + ratio * ratio))
            sum_w += weight
            sum_r2 += residual * residual
            for a in range(size):
                scaled = weight * v[a]
                for b in range(a, size):
                    sums[a, b] += scaled * v[b]
        for a in range(size):
            for b in range(a, size):
                moments[j, a, b] = sums[a, b]
                moments[j, b, a] = sums[a, b]
        counts[j, 0] = sum_w
        counts[j, 1] = sum_r2
        counts[j, 2] = starts[j + 1] - starts[j]


@compiled_parallel
def patch_sums(
    points: FloatArray,
    basis: FloatArray,
    axis: NDArray[np.int64],
    coefficients: FloatArray,
    starts: NDArray[np.int64],
    centres: FloatArray,
    radii: FloatArray,
    along_sight: bool,
    cutoff: float,
    sums: FloatArray,
) -> None:
    """Fill `sums` (m, 12, 3) with the number, the sum and the sum of squares of the residuals of each patch of a shot.

    Caps are cut into six sectors of two rings about the line of sight, profiles into twelve pieces along the arc.
    Residuals beyond the cutoff are left out.
    """
    for j in parallel_range(starts.shape[0] - 1):
        v = np.zeros(3)
        c = centres[j]
        norm = math.sqrt(c[0] * c[0] + c[1] * c[1] + c[2] * c[2])
        # two axes across the line of sight to the centre
        ax, ay, az = c[2] / norm, 0.0, -c[0] / norm
        length = math.sqrt(ax * ax + az * az)
        ax, az = ax / length, az / length
        bx, by, bz = c[1] * az / norm, (c[2] * ax - c[0] * az) / norm, -c[1] * ax / norm
        count = starts[j + 1] - starts[j]
        for i in range(starts[j], starts[j + 1]):
            residual = point_residual(points, basis, axis, coefficients, i, c, radii[j], along_sight, v)
            if abs(residual) > cutoff:
                continue
            if along_sight:
                a = v[0] * ax + v[1] * ay + v[2] * az
                b = v[0] * bx + v[1] * by + v[2] * bz
                sector = min(int((math.atan2(b, a) / math.pi + 1.0) * 3.0), 5)
                patch = sector + (6 if a * a + b * b > 0.375 else 0)
            else:
                patch = (12 * (i - starts[j])) // count
            sums[j, patch, 0] += 1.0
            sums[j, patch, 1] += residual
            sums[j, patch, 2] += residual * residual


@compiled_parallel
def denoised_points(
    points: FloatArray,
    basis: FloatArray,
    axis: NDArray[np.int64],
    coefficients: FloatArray,
    starts: NDArray[np.int64],
    centres: FloatArray,
    radii: FloatArray,
    along_sight: bool,
    result: FloatArray,
) -> None:
    """Fill `result` (n, 3) with the points moved onto their sphere along the sight: where they would be without noise."""
    for j in parallel_range(starts.shape[0] - 1):
        v = np.zeros(3)
        for i in range(starts[j], starts[j + 1]):
            residual = point_residual(points, basis, axis, coefficients, i, centres[j], radii[j], along_sight, v)
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            norm = math.sqrt(x * x + y * y + z * z)
            cosine = -(v[0] * x + v[1] * y + v[2] * z) / norm
            if along_sight and cosine > GRAZING_COSINE:
                shift = residual / cosine / norm
                result[i, 0] = x + shift * x
                result[i, 1] = y + shift * y
                result[i, 2] = z + shift * z
            else:
                result[i, 0] = x - residual * v[0]
                result[i, 1] = y - residual * v[1]
                result[i, 2] = z - residual * v[2]
