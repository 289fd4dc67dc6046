"""Compiled kernels of the voxel table and of the organised-grid edge filter; import inside functions (numba)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

EMPTY = 0
"""Key of a free slot: a fresh table is plain zeros, whose pages cost nothing until they are used."""

INDEX_BITS = 21
HALF_RANGE = 1 << (INDEX_BITS - 1)
"""Voxel indices lie strictly between -HALF_RANGE and HALF_RANGE - 1: 21 bits each, and no key is 0."""

FRACTION = 1 << 18
"""Steps that a voxel's edge is divided into for the integer sums."""

COUNT_LIMIT = 1 << 26
"""Points of one voxel beyond which its sum of squares could leave 63 bits: 3 * (2^17)^2 * 2^26 < 2^62."""

KEY, SUM_X, SUM_Y, SUM_Z, SUM_SQUARES, COUNT = 0, 1, 2, 3, 4, 5
COLUMNS = 6

ADDED, INVALID, OUTSIDE, CROWDED = 0, 1, 2, 3
FATES = 4


@compiled
def slot_of(table: IntArray, key: np.int64) -> np.int64:
    """Slot that holds the key, or the free slot where it belongs; the table must have a free slot.

    The hash is the finaliser of splitmix64 (Steele, Lea, Flood 2014): voxel keys of a surface differ in few bits,
    and without a real mixer they pile up in runs.
    """
    h = np.uint64(key)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    h = h ^ (h >> np.uint64(31))
    mask = np.int64(table.shape[0] - 1)
    slot = np.int64(h & np.uint64(mask))
    while table[slot, KEY] != EMPTY and table[slot, KEY] != key:
        slot = (slot + 1) & mask
    return slot


@compiled
def insert(table: IntArray, fates: IntArray, points_mm: FloatArray, start: int, n_used: int, limit: int, voxel_mm: float) -> tuple[int, int]:
    """Add points (n, 3) from row `start` on, until all are in or `limit` slots are used.

    Returns the next row and the number of used slots; `fates` counts what happened to the rows. Fractions of a
    voxel are summed as integers, so that no order of the points can change a bit of the result.
    """
    n = points_mm.shape[0]
    row = start
    while row < n and n_used < limit:
        px, py, pz = points_mm[row, 0], points_mm[row, 1], points_mm[row, 2]
        row += 1
        if not (np.isfinite(px) and np.isfinite(py) and np.isfinite(pz)):
            fates[INVALID] += 1
            continue
        x, y, z = px / voxel_mm, py / voxel_mm, pz / voxel_mm
        floor_x, floor_y, floor_z = np.floor(x), np.floor(y), np.floor(z)
        if max(abs(floor_x + 0.5), abs(floor_y + 0.5), abs(floor_z + 0.5)) > HALF_RANGE - 1:
            fates[OUTSIDE] += 1
            continue
        ix, iy, iz = np.int64(floor_x) + HALF_RANGE, np.int64(floor_y) + HALF_RANGE, np.int64(floor_z) + HALF_RANGE
        key = (ix << (2 * INDEX_BITS)) | (iy << INDEX_BITS) | iz
        slot = slot_of(table, key)
        if table[slot, KEY] == EMPTY:
            table[slot, KEY] = key
            n_used += 1
        if table[slot, COUNT] >= COUNT_LIMIT:
            fates[CROWDED] += 1
            continue
        fx = np.int64(np.rint((x - floor_x - 0.5) * FRACTION))
        fy = np.int64(np.rint((y - floor_y - 0.5) * FRACTION))
        fz = np.int64(np.rint((z - floor_z - 0.5) * FRACTION))
        table[slot, SUM_X] += fx
        table[slot, SUM_Y] += fy
        table[slot, SUM_Z] += fz
        table[slot, SUM_SQUARES] += fx * fx + fy * fy + fz * fz
        table[slot, COUNT] += 1
        fates[ADDED] += 1
    return row, n_used


@compiled
def absorb(table: IntArray, rows: IntArray) -> int:
    """Add the rows (m, 6) of another table, free slots skipped; returns the number of slots newly used.

    The table must have a free slot for each of them.
    """
    n_new = 0
    for i in range(rows.shape[0]):
        key = rows[i, KEY]
        if key == EMPTY:
            continue
        slot = slot_of(table, key)
        if table[slot, KEY] == EMPTY:
            table[slot, KEY] = key
            n_new += 1
        for column in range(SUM_X, COLUMNS):
            table[slot, column] += rows[i, column]
    return n_new


@compiled
def summarise(table: IntArray, slots: IntArray, voxel_mm: float, points_mm: FloatArray, spread_mm: FloatArray) -> None:
    """Mean point (n, 3) and rms distance from it (n,) of some used slots (n,), written into the last two arguments.

    Mean square minus squared mean loses at most 1e-8 of a voxel here, since both are below 2^36 steps.
    """
    ones = (1 << INDEX_BITS) - 1
    for i in range(slots.shape[0]):
        row = table[slots[i]]
        squared_mean = 0.0
        for axis in range(3):
            index = ((row[KEY] >> (INDEX_BITS * (2 - axis))) & ones) - HALF_RANGE
            mean = row[SUM_X + axis] / row[COUNT]
            points_mm[i, axis] = (index + 0.5 + mean / FRACTION) * voxel_mm
            squared_mean += mean * mean
        variance = row[SUM_SQUARES] / row[COUNT] - squared_mean
        spread_mm[i] = np.sqrt(max(variance, 0.0)) / FRACTION * voxel_mm


@compiled
def supported(xyz_mm: NDArray[np.float32], reach_per_depth: float, min_neighbours: int) -> NDArray[np.bool_]:
    """Mask (h, w) of grid points with at least `min_neighbours` of 8 neighbours within `reach_per_depth * z`."""
    height, width = xyz_mm.shape[0], xyz_mm.shape[1]
    keep = np.zeros((height, width), dtype=np.bool_)
    for v in range(height):
        for u in range(width):
            x, y, z = xyz_mm[v, u, 0], xyz_mm[v, u, 1], xyz_mm[v, u, 2]
            if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
                continue
            reach = reach_per_depth * z
            n_near = 0
            for dv in range(max(0, v - 1), min(height, v + 2)):
                for du in range(max(0, u - 1), min(width, u + 2)):
                    dx, dy, dz = xyz_mm[dv, du, 0] - x, xyz_mm[dv, du, 1] - y, xyz_mm[dv, du, 2] - z
                    if dx * dx + dy * dy + dz * dz <= reach * reach:
                        n_near += 1
            keep[v, u] = n_near > min_neighbours  # the point itself was counted as well
    return keep
