"""Per-point loops of the sphere search (numba): import inside the function that needs them.

Nothing here allocates by the number of points but the index arrays it returns; everything is deterministic: random
picks come from a small linear congruential generator that is seeded per grid cell.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# points that one hypothesis is scored on
SCORED = 2500

# float32 or float64, (n, 3), C-contiguous
AnyPoints = NDArray[Any]


@compiled
def valid_within(points: AnyPoints, centre: FloatArray, reach_mm: float, furthest_mm: float) -> tuple[IntArray, int, float]:
    """Indices of finite, non-zero points within a ball; number of valid points in all; largest |coordinate|."""
    n = points.shape[0]
    found = np.zeros(n, dtype=np.int64)
    count = 0
    valid = 0
    largest = 0.0
    for i in range(n):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        size = max(abs(x), abs(y), abs(z))
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z) and 0.0 < size < furthest_mm):
            continue
        valid += 1
        largest = max(largest, size)
        dx, dy, dz = x - centre[0], y - centre[1], z - centre[2]
        if dx * dx + dy * dy + dz * dz <= reach_mm * reach_mm:
            found[count] = i
            count += 1
    return found[:count], valid, largest


@compiled
def find_cell(keys: IntArray, key: int) -> int:
    """Place of a key in sorted keys, or -1."""
    low, high = 0, keys.shape[0]
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    if low < keys.shape[0] and keys[low] == key:
        return low
    return -1


@compiled
def neighbourhood(keys: IntArray, starts: IntArray, dims: IntArray, key: int, ranges: IntArray) -> int:
    """Fill `ranges` (27, 2) with the point ranges of a cell and its neighbours; number of ranges filled.

    The grid has an empty border, so that keys of neighbours never wrap round.
    """
    filled = 0
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                cell = find_cell(keys, key + (dx * dims[1] + dy) * dims[2] + dz)
                if cell >= 0:
                    ranges[filled, 0] = starts[cell]
                    ranges[filled, 1] = starts[cell + 1]
                    filled += 1
    return filled


@compiled
def pick(ranges: IntArray, filled: int, number: int) -> int:
    """Index of the number-th point of a neighbourhood."""
    for r in range(filled):
        size = ranges[r, 1] - ranges[r, 0]
        if number < size:
            return int(ranges[r, 0] + number)
        number -= size
    return int(ranges[0, 0])


@compiled
def centre_of_three(
    p: FloatArray, q: FloatArray, s: FloatArray, radius_mm: float, facing: float, centre: FloatArray
) -> bool:
    """Centre of the sphere of known radius through three points whose surface there faces the origin (facing +1).

    Of the two spheres through three points one is the mirror of the other at their plane. Circumcentre:
    `p + (|a|² b x n + |b|² n x a) / 2|n|²` with `n = a x b`. Refuses triples on too small a circle, which would
    magnify noise, and on circles larger than the sphere.
    """
    ax, ay, az = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    bx, by, bz = s[0] - p[0], s[1] - p[1], s[2] - p[2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    nn = nx * nx + ny * ny + nz * nz
    if nn < 1e-6 * radius_mm**4:
        return False
    aa = ax * ax + ay * ay + az * az
    bb = bx * bx + by * by + bz * bz
    ox = (aa * (by * nz - bz * ny) + bb * (ny * az - nz * ay)) / (2 * nn)
    oy = (aa * (bz * nx - bx * nz) + bb * (nz * ax - nx * az)) / (2 * nn)
    oz = (aa * (bx * ny - by * nx) + bb * (nx * ay - ny * ax)) / (2 * nn)
    circle = ox * ox + oy * oy + oz * oz
    if circle > radius_mm * radius_mm or circle < 0.06 * radius_mm * radius_mm:
        return False
    along = np.sqrt(radius_mm * radius_mm - circle) / np.sqrt(nn)
    if (nx * p[0] + ny * p[1] + nz * p[2]) * facing < 0:
        along = -along
    centre[0] = p[0] + ox + along * nx
    centre[1] = p[1] + oy + along * ny
    centre[2] = p[2] + oz + along * nz
    return True


@compiled
def on_sphere(p: FloatArray, centre: FloatArray, radius_mm: float, tolerance_mm: float, facing: float) -> bool:
    """Whether a point lies on the sphere within the tolerance, on the side that faces the origin."""
    dx, dy, dz = p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    return bool(abs(distance - radius_mm) < tolerance_mm and (dx * p[0] + dy * p[1] + dz * p[2]) * facing < 0)


@compiled
def sample_support(
    points: FloatArray, ranges: IntArray, filled: int, step: int, first: int, centre: FloatArray, radius_mm: float, tolerance_mm: float, facing: float
) -> float:
    """Share of every step-th point of a neighbourhood that lies on the sphere."""
    hits, seen, skip = 0, 0, first
    for r in range(filled):
        i = ranges[r, 0] + skip
        while i < ranges[r, 1]:
            seen += 1
            if on_sphere(points[i], centre, radius_mm, tolerance_mm, facing):
                hits += 1
            i += step
        skip = i - ranges[r, 1]
    return hits / max(seen, 1)


@compiled
def hypotheses(
    points: FloatArray,
    keys: IntArray,
    starts: IntArray,
    dims: IntArray,
    radius_mm: float,
    tolerance_mm: float,
    facing: float,
    per_cell: int,
    tries: int,
    seed: int,
) -> tuple[FloatArray, FloatArray]:
    """RANSAC in every grid cell: centres (k, 3) and local support 0..1 (k,) of the best triple of each seed point.

    A seed point lies in the cell, its two partners in the 27 cells around it, so that a sphere which is one part in
    a thousand of the frame is found as surely as one that fills it.
    """
    n_cells = keys.shape[0]
    centres = np.zeros((n_cells * per_cell, 3))
    support = np.zeros(n_cells * per_cell)
    ranges = np.zeros((27, 2), dtype=np.int64)
    trial = np.zeros(3)
    for cell in range(n_cells):
        inside = starts[cell + 1] - starts[cell]
        filled = neighbourhood(keys, starts, dims, keys[cell], ranges)
        total = 0
        for r in range(filled):
            total += ranges[r, 1] - ranges[r, 0]
        if inside < 3 or total < 12:
            continue
        state = np.uint64(seed * 7919 + keys[cell] * 104729 + 12345)
        coarse_step, fine_step = max(total // 16, 1), max(total // 128, 1)
        for k in range(per_cell):
            slot = cell * per_cell + k
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            i = starts[cell] + int(state >> np.uint64(33)) % inside
            for _ in range(tries):
                state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
                first = pick(ranges, filled, int(state >> np.uint64(33)) % total)
                state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
                second = pick(ranges, filled, int(state >> np.uint64(33)) % total)
                if not centre_of_three(points[i], points[first], points[second], radius_mm, facing, trial):
                    continue
                offset = int(state >> np.uint64(40))
                if sample_support(points, ranges, filled, coarse_step, offset % coarse_step, trial, radius_mm, tolerance_mm, facing) < 0.08:
                    continue
                share = sample_support(points, ranges, filled, fine_step, offset % fine_step, trial, radius_mm, tolerance_mm, facing)
                if share > support[slot]:
                    support[slot] = share
                    centres[slot] = trial
    return centres, support


@compiled
def beside(p: FloatArray, centre: FloatArray) -> float:
    """How far a centre lies beside the line of sight of a point."""
    pp = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
    pc = p[0] * centre[0] + p[1] * centre[1] + p[2] * centre[2]
    cc = centre[0] * centre[0] + centre[1] * centre[1] + centre[2] * centre[2]
    return float(np.sqrt(max(cc - pc * pc / pp, 0.0)))


@compiled
def supports(
    points: FloatArray,
    keys: IntArray,
    starts: IntArray,
    dims: IntArray,
    origin: FloatArray,
    edge_mm: float,
    centres: FloatArray,
    radius_mm: float,
    tolerance_mm: float,
    facing: float,
) -> tuple[IntArray, FloatArray]:
    """About how many points lie on each of the spheres (k, 3), and their share of the points seen at its middle.

    The cell edge is at least radius + tolerance, so the 27 cells round the centre hold the whole sphere.
    """
    counts = np.zeros(centres.shape[0], dtype=np.int64)
    shares = np.zeros(centres.shape[0])
    ranges = np.zeros((27, 2), dtype=np.int64)
    for k in range(centres.shape[0]):
        c = centres[k]
        ix = np.int64(np.floor((c[0] - origin[0]) / edge_mm))
        iy = np.int64(np.floor((c[1] - origin[1]) / edge_mm))
        iz = np.int64(np.floor((c[2] - origin[2]) / edge_mm))
        if not (0 < ix < dims[0] - 1 and 0 < iy < dims[1] - 1 and 0 < iz < dims[2] - 1):
            continue
        filled = neighbourhood(keys, starts, dims, (ix * dims[1] + iy) * dims[2] + iz, ranges)
        total = 0
        for r in range(filled):
            total += ranges[r, 1] - ranges[r, 0]
        step = max(total // SCORED, 1)
        middle = 0
        hits = 0
        for r in range(filled):
            for i in range(ranges[r, 0], ranges[r, 1], step):
                on = on_sphere(points[i], c, radius_mm, tolerance_mm, facing)
                counts[k] += step * on
                if beside(points[i], c) < 0.8 * radius_mm:
                    middle += 1
                    hits += on
        shares[k] = hits / middle if middle > 0 else 1.0
    return counts, shares
