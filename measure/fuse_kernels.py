"""Compiled kernels of the voxel table; import inside functions (numba).

A voxel is a row of 64-bit integers: key, halves (count and weight; scans and the last scan), then sums. An index of
32-bit entries leads from a key to its row. Everything that is summed is an integer, so no order of the points can
change a bit of the result.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

INDEX_BITS = 21
HALF_RANGE = 1 << (INDEX_BITS - 1)
"""Voxel indices lie strictly between -HALF_RANGE and HALF_RANGE - 1: 21 bits each, and no key is 0."""

FRACTION = 1 << 16
"""Steps that a voxel's edge is divided into for the integer sums."""
UNIT_WEIGHT = 128
"""Integer weight of a point of weight 1; 1 to 255 are used."""
NORMAL_STEPS = 1 << 14
VARIANCE_STEP_MM2 = 1e-9
WEIGHT_LIMIT = (1 << 31) - 256
"""Sum of weights beyond which sums of squares could leave 63 bits: (2^15)^2 * 2^31 = 2^61. 8 million points at least."""

KEY, SUM, MOMENT, NORMAL, VARIANCE = 0, 3, 6, 12, 15
"""Words of a row: sums of x y z; of xx xy xz yy yz zz; of the normal; of the calibration's variance along it."""
MEAN_WORDS, FULL_WORDS = 6, 16
"""Words of a row that holds means only, and of a full one: two cache lines."""
COUNT, WEIGHT, SCANS, LAST_SCAN = 2, 3, 4, 5
"""The same row seen as 32-bit halves."""

PARTS = 16
"""Tables that blocks of voxels are dealt to, so that threads fill different ones."""
BAND = 2048
"""Points that are looked at together: most bands hold points of few parts."""
_BLOCK_BITS = 5
_NEAR_BITS = 11

FIRST_CAPACITY = 1 << 9
_ROW_BITS = 24
ROW_LIMIT = (1 << _ROW_BITS) - 1
_ROW_MASK = ROW_LIMIT

ADDED, INVALID, OUTSIDE, CROWDED = 0, 1, 2, 3
FATES = 4


@compiled
def _mixed(key: np.int64) -> np.uint64:
    """The finaliser of splitmix64 (Steele, Lea, Flood 2014).

    Voxel keys of a surface differ in few bits, and without a real mixer they pile up in runs.
    """
    h = np.uint64(key)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(31))


@compiled
def quantise(
    points_mm: FloatArray,
    weights: NDArray[np.uint8],
    voxel_mm: float,
    keys: IntArray,
    fractions: NDArray[np.int16],
    parts: NDArray[np.uint8],
    present: NDArray[np.uint32],
    fates: IntArray,
) -> None:
    """Voxel and place within it of points (n, 3): keys (n,), fractions (n, 3), parts (n,), and the parts of each band.

    Points of weight 0 were cleaned away before; `fates` counts what happened to the others. Part PARTS means: not used.
    """
    for i in range(points_mm.shape[0]):
        parts[i] = PARTS
        px, py, pz = points_mm[i, 0], points_mm[i, 1], points_mm[i, 2]
        if not (np.isfinite(px) and np.isfinite(py) and np.isfinite(pz)):
            fates[INVALID] += 1
            continue
        if weights[i] == 0:
            continue
        x, y, z = px / voxel_mm, py / voxel_mm, pz / voxel_mm
        floor_x, floor_y, floor_z = np.floor(x), np.floor(y), np.floor(z)
        if max(abs(floor_x + 0.5), abs(floor_y + 0.5), abs(floor_z + 0.5)) > HALF_RANGE - 1:
            fates[OUTSIDE] += 1
            continue
        ix, iy, iz = np.int64(floor_x) + HALF_RANGE, np.int64(floor_y) + HALF_RANGE, np.int64(floor_z) + HALF_RANGE
        keys[i] = (ix << (2 * INDEX_BITS)) | (iy << INDEX_BITS) | iz
        # the last step of a voxel may round up to the first of the next
        fractions[i, 0] = np.int16(min(int((x - floor_x) * FRACTION), FRACTION - 1) - FRACTION // 2)
        fractions[i, 1] = np.int16(min(int((y - floor_y) * FRACTION), FRACTION - 1) - FRACTION // 2)
        fractions[i, 2] = np.int16(min(int((z - floor_z) * FRACTION), FRACTION - 1) - FRACTION // 2)
        block = ((ix >> _BLOCK_BITS) << (2 * INDEX_BITS)) | ((iy >> _BLOCK_BITS) << INDEX_BITS) | (iz >> _BLOCK_BITS)
        part = np.int64(_mixed(block) >> np.uint64(60))
        parts[i] = part
        present[i // BAND] |= np.uint32(1 << part)
        fates[ADDED] += 1


@compiled
def _slot_of(index: NDArray[np.uint32], rows: IntArray, key: np.int64) -> np.int64:
    """Slot that leads to the key's row, or the free slot where it belongs; the index must have a free slot.

    An entry is the row's number plus 1, with eight bits of the hash above it that clear most wrong rows unseen.
    """
    h = _mixed(key)
    mask = np.int64(index.shape[0] - 1)
    slot = np.int64(h & np.uint64(mask))
    tag = np.uint32(h >> np.uint64(56))
    while True:
        entry = index[slot]
        if entry == 0 or ((entry >> np.uint32(_ROW_BITS)) == tag and rows[np.int64(entry & np.uint32(_ROW_MASK)) - 1, KEY] == key):
            return slot
        slot = (slot + 1) & mask


@compiled
def _new_row(index: NDArray[np.uint32], slot: np.int64, rows: IntArray, n_rows: int, key: np.int64) -> None:
    index[slot] = np.uint32(n_rows + 1) | (np.uint32(_mixed(key) >> np.uint64(56)) << np.uint32(_ROW_BITS))
    for word in range(rows.shape[1]):
        rows[n_rows, word] = 0
    rows[n_rows, KEY] = key


@compiled
def _add_place(rows: IntArray, row: np.int64, w: np.int64, fractions: NDArray[np.int16], i: int) -> None:
    x, y, z = np.int64(fractions[i, 0]), np.int64(fractions[i, 1]), np.int64(fractions[i, 2])
    wx, wy, wz = w * x, w * y, w * z
    rows[row, SUM] += wx
    rows[row, SUM + 1] += wy
    rows[row, SUM + 2] += wz
    if rows.shape[1] == FULL_WORDS:
        rows[row, MOMENT] += wx * x
        rows[row, MOMENT + 1] += wx * y
        rows[row, MOMENT + 2] += wx * z
        rows[row, MOMENT + 3] += wy * y
        rows[row, MOMENT + 4] += wy * z
        rows[row, MOMENT + 5] += wz * z


@compiled
def insert(
    index: NDArray[np.uint32],
    rows: IntArray,
    halves: NDArray[np.int32],
    n_rows: int,
    part: int,
    start: int,
    keys: IntArray,
    fractions: NDArray[np.int16],
    parts: NDArray[np.uint8],
    present: NDArray[np.uint32],
    weights: NDArray[np.uint8],
    normals: NDArray[np.int16],
    variances: NDArray[np.uint32],
    scan: int,
    fates: IntArray,
) -> tuple[int, int]:
    """Add the points of one part from point `start` on, until all are in or the table must grow.

    `halves` is `rows` seen as 32-bit numbers. Normals (n, 3) and variances (n,) may be empty: then they count as zero.
    Returns the next point and the number of rows.
    """
    limit, n = min(rows.shape[0], index.shape[0] // 2), keys.shape[0]
    full = rows.shape[1] == FULL_WORDS
    with_normals, with_variances = full and normals.shape[0] > 0, full and variances.shape[0] > 0
    # the voxels of the row of pixels before: most are met again, and need no search then
    near_keys, near_rows = np.zeros(1 << _NEAR_BITS, dtype=np.int64), np.empty(1 << _NEAR_BITS, dtype=np.int32)
    last_key, row = np.int64(0), np.int64(0)
    i = start
    while i < n:
        end = min(n, (i // BAND + 1) * BAND)
        if not (present[i // BAND] >> np.uint32(part)) & np.uint32(1):
            i = end
            continue
        while i < end:
            if parts[i] != part:
                i += 1
                continue
            key = keys[i]
            if key != last_key:
                near = np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(64 - _NEAR_BITS))
                if near_keys[near] != key:
                    slot = _slot_of(index, rows, key)
                    if index[slot] == 0:
                        if n_rows >= limit:
                            return i, n_rows
                        _new_row(index, slot, rows, n_rows, key)
                        n_rows += 1
                    near_keys[near], near_rows[near] = key, np.int32(np.int64(index[slot] & np.uint32(_ROW_MASK)) - 1)
                row = np.int64(near_rows[near])
                last_key = key
                if halves[row, LAST_SCAN] != scan:
                    halves[row, LAST_SCAN] = scan
                    halves[row, SCANS] += 1
            w = np.int64(weights[i])
            if halves[row, WEIGHT] >= WEIGHT_LIMIT:
                fates[CROWDED] += 1
                i += 1
                continue
            # in this loop and in no function of its own: a call with seven arrays costs more than the sums
            halves[row, COUNT] += 1
            halves[row, WEIGHT] += np.int32(w)
            _add_place(rows, row, w, fractions, i)
            if with_normals:
                rows[row, NORMAL] += w * np.int64(normals[i, 0])
                rows[row, NORMAL + 1] += w * np.int64(normals[i, 1])
                rows[row, NORMAL + 2] += w * np.int64(normals[i, 2])
            if with_variances:
                rows[row, VARIANCE] += w * np.int64(variances[i])
            i += 1
    return n, n_rows


@compiled
def gather(tables: tuple[IntArray, ...], starts: IntArray, chosen: IntArray, found: IntArray) -> None:
    """Rows (n, words) by their numbers (n,) in all tables one after the other; `starts` holds the number at which each begins, and their end."""
    for k in range(chosen.shape[0]):
        at, beyond = 0, starts.shape[0] - 1
        while beyond - at > 1:
            middle = (at + beyond) // 2
            if starts[middle] <= chosen[k]:
                at = middle
            else:
                beyond = middle
        table, row = tables[at], chosen[k] - starts[at]
        for word in range(found.shape[1]):
            found[k, word] = table[row, word]


@compiled
def absorb(
    index: NDArray[np.uint32], rows: IntArray, halves: NDArray[np.int32], n_rows: int, others: IntArray, other_halves: NDArray[np.int32]
) -> int:
    """Add rows (m, words) of another table of other scans; returns the number of rows. There must be room for all."""
    for i in range(others.shape[0]):
        key = others[i, KEY]
        slot = _slot_of(index, rows, key)
        if index[slot] == 0:
            _new_row(index, slot, rows, n_rows, key)
            n_rows += 1
        row = np.int64(index[slot] & np.uint32(_ROW_MASK)) - 1
        for half in (COUNT, WEIGHT, SCANS):
            halves[row, half] += other_halves[i, half]
        for word in range(SUM, rows.shape[1]):
            rows[row, word] += others[i, word]
    return n_rows


@compiled
def index_rows(index: NDArray[np.uint32], rows: IntArray, n_rows: int) -> None:
    """Fill an empty index with the first n rows."""
    mask = np.int64(index.shape[0] - 1)
    for row in range(n_rows):
        h = _mixed(rows[row, KEY])
        slot = np.int64(h & np.uint64(mask))
        while index[slot] != 0:
            slot = (slot + 1) & mask
        index[slot] = np.uint32(row + 1) | (np.uint32(h >> np.uint64(56)) << np.uint32(_ROW_BITS))


@compiled
def sum_equal_keys(rows: IntArray, halves: NDArray[np.int32]) -> int:
    """Add up rows (n, words) of equal keys that stand together, into the first ones; returns how many are left."""
    n_left = 0
    for i in range(rows.shape[0]):
        if n_left and rows[n_left - 1, KEY] == rows[i, KEY]:
            for half in (COUNT, WEIGHT, SCANS):
                halves[n_left - 1, half] += halves[i, half]
            for word in range(SUM, rows.shape[1]):
                rows[n_left - 1, word] += rows[i, word]
        else:
            for word in range(rows.shape[1]):
                rows[n_left, word] = rows[i, word]
            n_left += 1
    return n_left


def voxel_index(keys: IntArray, axis: int) -> IntArray:
    """(n,) index along an axis of the voxels with some keys (n,)."""
    return ((keys >> (INDEX_BITS * (2 - axis))) & ((1 << INDEX_BITS) - 1)) - HALF_RANGE


@compiled
def means(rows: IntArray, halves: NDArray[np.int32], voxel_mm: float, points_mm: FloatArray) -> None:
    """Weighted mean point (n, 3) of rows (n, words)."""
    ones = (1 << INDEX_BITS) - 1
    for i in range(rows.shape[0]):
        for axis in range(3):
            at = ((rows[i, KEY] >> (INDEX_BITS * (2 - axis))) & ones) - HALF_RANGE
            points_mm[i, axis] = (at + 0.5 + (rows[i, SUM + axis] / halves[i, WEIGHT] + 0.5) / FRACTION) * voxel_mm


@compiled
def details(
    rows: IntArray,
    halves: NDArray[np.int32],
    voxel_mm: float,
    unit_variance_mm2: float,
    spread_mm: NDArray[np.float32],
    normals: NDArray[np.float32],
    uncertainty_mm: NDArray[np.float32],
) -> None:
    """Spread (n,), unit normal (n, 3) and standard uncertainty along it (n,) of full rows.

    The random part is what was predicted for one scan (`unit_variance_mm2` for a point of weight 1), or the scatter along
    the normal where that is larger, over the number of scans: points of one scan share its pose and are not independent.
    """
    step = voxel_mm / FRACTION
    for i in range(rows.shape[0]):
        weight = np.float64(halves[i, WEIGHT])
        mx, my, mz = rows[i, SUM] / weight, rows[i, SUM + 1] / weight, rows[i, SUM + 2] / weight
        xx, yy, zz = rows[i, MOMENT] / weight - mx * mx, rows[i, MOMENT + 3] / weight - my * my, rows[i, MOMENT + 5] / weight - mz * mz
        xy, xz, yz = rows[i, MOMENT + 1] / weight - mx * my, rows[i, MOMENT + 2] / weight - mx * mz, rows[i, MOMENT + 4] / weight - my * mz
        spread_mm[i] = np.sqrt(max(xx + yy + zz, 0.0)) * step
        a, b, c = np.float64(rows[i, NORMAL]), np.float64(rows[i, NORMAL + 1]), np.float64(rows[i, NORMAL + 2])
        length = np.sqrt(a * a + b * b + c * c)
        scatter = 0.0
        if length > 0:
            a, b, c = a / length, b / length, c / length
            normals[i, 0], normals[i, 1], normals[i, 2] = a, b, c
            along = a * a * xx + b * b * yy + c * c * zz + 2 * (a * b * xy + a * c * xz + b * c * yz)
            scatter = max(along, 0.0) * step * step
        else:
            normals[i, :] = np.nan
        predicted = unit_variance_mm2 * UNIT_WEIGHT * halves[i, COUNT] / weight
        systematic = rows[i, VARIANCE] / weight * VARIANCE_STEP_MM2
        uncertainty_mm[i] = np.sqrt(systematic + max(predicted, scatter) / halves[i, SCANS])
