"""Compiled kernels that look at one scan before it is fused; import inside functions (numba)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, vectorised
from measure.fuse_kernels import NORMAL_STEPS, UNIT_WEIGHT, VARIANCE_STEP_MM2

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LINK_RIGHT, LINK_DOWN = 1, 2
INVALID, EDGE, GRAZING, SPECK = 0, 1, 2, 3
FATES = 4
MEAN_SQUARE_COSINE = 7.0 / 12.0
"""Of the incidence over a cap of 60 degrees: for points whose normal is not known."""
_MOST_VARIANCE = 4e9


class PointNoise(NamedTuple):
    """Random variance of a point along its normal; a tuple, because numba takes no dataclass."""

    pose_mm2: float
    pose_rad2: float
    form_mm2: float
    point_mm2: float
    flat: float
    steep: float
    range_power: float
    range_mm: float
    unit_mm2: float
    """Variance of a point of weight 1."""


class View(NamedTuple):
    """Where a scan was seen from, in the base."""

    camera_in_base_mm: FloatArray
    """(3,)."""
    sight_in_base: FloatArray
    """(3,) unit vector of the camera's z axis."""
    flange_in_base_mm: FloatArray
    """(3,) about which pose noise turns."""


@vectorised
def _weight(noise: PointNoise, range2_mm2: float, lever2_mm2: float, cosine2: float) -> float:
    """Inverse of the predicted random variance along the normal, 1 to 255 in units of 1 / UNIT_WEIGHT.

    A turn of the flange moves a point along its normal by the part of the lever that is square to the normal.
    """
    point = noise.point_mm2 * max(noise.flat + noise.steep * cosine2, 0.05)
    if noise.range_power != 0.0:
        point *= (range2_mm2 / noise.range_mm**2) ** noise.range_power
    variance = noise.pose_mm2 + noise.pose_rad2 * lever2_mm2 + noise.form_mm2 + point
    return float(min(max(np.floor(UNIT_WEIGHT * noise.unit_mm2 / variance + 0.5), 1.0), 255.0))


@vectorised
def _distance2(points: FloatArray, v: int, u: int, at: FloatArray) -> float:
    x, y, z = points[v, u, 0] - at[0], points[v, u, 1] - at[1], points[v, u, 2] - at[2]
    return float(x * x + y * y + z * z)


@vectorised
def _take_row(points: FloatArray, v: int, row: FloatArray) -> None:
    """Row v of a grid (h, w, 3) as planes (3, w + 2) with a hole at either end; a row outside is all holes."""
    inside = 0 <= v < points.shape[0]
    for axis in range(3):
        plane = row[axis]
        plane[0] = plane[points.shape[1] + 1] = np.nan
        for u in range(points.shape[1]):
            plane[u + 1] = points[v, u, axis] if inside else np.nan


@vectorised
def _look_round(above: FloatArray, here: FloatArray, below: FloatArray, reach2: FloatArray, found: FloatArray, linked: NDArray[np.bool_]) -> None:
    """Number of near neighbours, steps to the right and down, for a row of planes (3, w + 2).

    Steps are summed over the pairs of opposite neighbours of which both are near, the point itself having no share.
    `found` (7, w), `linked` (4, w): whether the right, lower, left and upper neighbour is near. No branches: this loop
    must run in vector instructions.
    """
    ax, ay, az = above[0], above[1], above[2]
    hx, hy, hz = here[0], here[1], here[2]
    bx, by, bz = below[0], below[1], below[2]
    for u in range(reach2.shape[0]):
        x, y, z, r = hx[u + 1], hy[u + 1], hz[u + 1], reach2[u]
        # a comparison with NaN is false
        nw = (ax[u] - x) ** 2 + (ay[u] - y) ** 2 + (az[u] - z) ** 2 <= r
        no = (ax[u + 1] - x) ** 2 + (ay[u + 1] - y) ** 2 + (az[u + 1] - z) ** 2 <= r
        ne = (ax[u + 2] - x) ** 2 + (ay[u + 2] - y) ** 2 + (az[u + 2] - z) ** 2 <= r
        we = (hx[u] - x) ** 2 + (hy[u] - y) ** 2 + (hz[u] - z) ** 2 <= r
        ea = (hx[u + 2] - x) ** 2 + (hy[u + 2] - y) ** 2 + (hz[u + 2] - z) ** 2 <= r
        sw = (bx[u] - x) ** 2 + (by[u] - y) ** 2 + (bz[u] - z) ** 2 <= r
        so = (bx[u + 1] - x) ** 2 + (by[u + 1] - y) ** 2 + (bz[u + 1] - z) ** 2 <= r
        se = (bx[u + 2] - x) ** 2 + (by[u + 2] - y) ** 2 + (bz[u + 2] - z) ** 2 <= r
        found[0, u] = 1.0 * nw + no + ne + we + ea + sw + so + se
        a, h, b = nw & ne, we & ea, sw & se
        found[1, u] = (ax[u + 2] - ax[u] if a else 0.0) + (hx[u + 2] - hx[u] if h else 0.0) + (bx[u + 2] - bx[u] if b else 0.0)
        found[2, u] = (ay[u + 2] - ay[u] if a else 0.0) + (hy[u + 2] - hy[u] if h else 0.0) + (by[u + 2] - by[u] if b else 0.0)
        found[3, u] = (az[u + 2] - az[u] if a else 0.0) + (hz[u + 2] - hz[u] if h else 0.0) + (bz[u + 2] - bz[u] if b else 0.0)
        a, h, b = nw & sw, no & so, ne & se
        found[4, u] = (bx[u] - ax[u] if a else 0.0) + (bx[u + 1] - ax[u + 1] if h else 0.0) + (bx[u + 2] - ax[u + 2] if b else 0.0)
        found[5, u] = (by[u] - ay[u] if a else 0.0) + (by[u + 1] - ay[u + 1] if h else 0.0) + (by[u + 2] - ay[u + 2] if b else 0.0)
        found[6, u] = (bz[u] - az[u] if a else 0.0) + (bz[u + 1] - az[u + 1] if h else 0.0) + (bz[u + 2] - az[u + 2] if b else 0.0)
        linked[0, u], linked[1, u], linked[2, u], linked[3, u] = ea, so, we, no


@compiled
def _one_sided(above: FloatArray, here: FloatArray, below: FloatArray, u: int, linked: NDArray[np.bool_], found: FloatArray) -> None:
    """Steps from the point to one neighbour, or from it, where no opposite pair is near."""
    if found[1, u] == 0.0 and found[2, u] == 0.0 and found[3, u] == 0.0:
        for axis in range(3):
            if linked[0, u]:
                found[1 + axis, u] = here[axis, u + 2] - here[axis, u + 1]
            elif linked[2, u]:
                found[1 + axis, u] = here[axis, u + 1] - here[axis, u]
    if found[4, u] == 0.0 and found[5, u] == 0.0 and found[6, u] == 0.0:
        for axis in range(3):
            if linked[1, u]:
                found[4 + axis, u] = below[axis, u + 1] - here[axis, u + 1]
            elif linked[3, u]:
                found[4 + axis, u] = here[axis, u + 1] - above[axis, u + 1]


@vectorised
def _judge_row(
    here: FloatArray,
    found: FloatArray,
    linked: NDArray[np.bool_],
    view: View,
    noise: PointNoise,
    min_neighbours: int,
    min_cosine: float,
    weights: NDArray[np.uint8],
    normals: NDArray[np.int16],
    links: NDArray[np.uint8],
) -> tuple[int, int]:
    """Weights (w,), normals (w, 3) and links (w,) of a row; returns the number of valid points, and of those with neighbours."""
    ex, ey, ez = view.camera_in_base_mm[0], view.camera_in_base_mm[1], view.camera_in_base_mm[2]
    fx, fy, fz = view.flange_in_base_mm[0], view.flange_in_base_mm[1], view.flange_in_base_mm[2]
    hx, hy, hz = here[0], here[1], here[2]
    count, rx, ry, rz, dx, dy, dz = found[0], found[1], found[2], found[3], found[4], found[5], found[6]
    right, down = linked[0], linked[1]
    n_valid, n_surface, least_cosine2 = 0, 0, min_cosine * min_cosine
    for u in range(weights.shape[0]):
        x, y, z = hx[u + 1], hy[u + 1], hz[u + 1]
        nx, ny, nz = ry[u] * dz[u] - rz[u] * dy[u], rz[u] * dx[u] - rx[u] * dz[u], rx[u] * dy[u] - ry[u] * dx[u]
        cx, cy, cz = x - ex, y - ey, z - ez
        length2, range2 = nx * nx + ny * ny + nz * nz, cx * cx + cy * cy + cz * cz
        along = nx * cx + ny * cy + nz * cz
        known = length2 > 0.0
        cosine2 = along * along / (length2 * range2) if known else MEAN_SQUARE_COSINE
        lx, ly, lz = x - fx, y - fy, z - fz
        across = nx * lx + ny * ly + nz * lz
        lever2 = lx * lx + ly * ly + lz * lz - (across * across / length2 if known else 0.0)
        weight = _weight(noise, range2, lever2, cosine2)
        surface = (count[u] >= min_neighbours) & (not np.isnan(x))
        kept = surface & (cosine2 >= least_cosine2)
        scale = (NORMAL_STEPS if along < 0.0 else -NORMAL_STEPS) / np.sqrt(length2) if known & kept else 0.0
        normals[u, 0] = np.int16(np.rint(nx * scale))
        normals[u, 1] = np.int16(np.rint(ny * scale))
        normals[u, 2] = np.int16(np.rint(nz * scale))
        weights[u] = np.uint8(weight if kept else 0.0)
        links[u] = (LINK_RIGHT * right[u] + LINK_DOWN * down[u]) if kept else 0
        n_valid += not np.isnan(x)
        n_surface += surface
    return n_valid, n_surface


@vectorised
def _reach2(here: FloatArray, view: View, reach_per_depth: float, reach2: FloatArray) -> None:
    eye, sight = view.camera_in_base_mm, view.sight_in_base
    for u in range(reach2.shape[0]):
        depth = (here[0, u + 1] - eye[0]) * sight[0] + (here[1, u + 1] - eye[1]) * sight[1] + (here[2, u + 1] - eye[2]) * sight[2]
        reach2[u] = (reach_per_depth * depth) ** 2


@compiled
def examine_grid(
    points_mm: FloatArray,
    view: View,
    noise: PointNoise,
    reach_per_depth: float,
    min_neighbours: int,
    min_cosine: float,
    weights: NDArray[np.uint8],
    normals: NDArray[np.int16],
    links: NDArray[np.uint8],
    fates: IntArray,
) -> None:
    """Weight, normal and links to the next pixels of an organised scan (h, w, 3) in the base; weight 0 where a point is dropped.

    A point is kept when enough of its 8 neighbours are nearer than `reach_per_depth` times its depth (else it hangs at an
    edge), and the surface through them is not seen at a grazing angle. Normals (h, w, 3) are the cross product of
    differences over three rows and three columns; the point itself has no share in them, so that its noise does not
    choose its own weight.
    """
    height, width = points_mm.shape[0], points_mm.shape[1]
    above, here, below = np.empty((3, width + 2)), np.empty((3, width + 2)), np.empty((3, width + 2))
    reach2, found, linked = np.empty(width), np.empty((7, width)), np.empty((4, width), dtype=np.bool_)
    _take_row(points_mm, -1, here)
    _take_row(points_mm, 0, below)
    for v in range(height):
        above, here, below = here, below, above
        _take_row(points_mm, v + 1, below)
        _reach2(here, view, reach_per_depth, reach2)
        _look_round(above, here, below, reach2, found, linked)
        for u in range(width):
            if found[0, u] >= min_neighbours and (found[1, u] == 0.0 or found[5, u] == 0.0):
                _one_sided(above, here, below, u, linked, found)
        n_valid, n_surface = _judge_row(here, found, linked, view, noise, min_neighbours, min_cosine, weights[v], normals[v], links[v])
        fates[INVALID] += width - n_valid
        fates[EDGE] += n_valid - n_surface
        n_kept = 0
        for u in range(width):
            n_kept += weights[v, u] != 0
        fates[GRAZING] += n_surface - n_kept


@compiled
def _root(parents: NDArray[np.int32], i: int) -> int:
    while parents[i] != i:
        parents[i] = parents[parents[i]]
        i = parents[i]
    return i


@compiled
def _label(weights: NDArray[np.uint8], links: NDArray[np.uint8], patch: NDArray[np.int32], parents: NDArray[np.int32]) -> int:
    """Number (h * w,) of the patch that each point begins or joins, and which patches are one; returns how many there are."""
    height, width = weights.shape
    n_patches = 0
    for v in range(height):
        for u in range(width):
            i = v * width + u
            if weights[v, u] == 0:
                continue
            left = u > 0 and weights[v, u - 1] > 0 and links[v, u - 1] & LINK_RIGHT
            above = v > 0 and weights[v - 1, u] > 0 and links[v - 1, u] & LINK_DOWN
            if left:
                patch[i] = patch[i - 1]
                if above and patch[i - width] != patch[i]:
                    a, b = _root(parents, patch[i]), _root(parents, patch[i - width])
                    parents[max(a, b)] = min(a, b)
            elif above:
                patch[i] = patch[i - width]
            else:
                parents[n_patches] = patch[i] = n_patches
                n_patches += 1
    return n_patches


@compiled
def drop_specks(weights: NDArray[np.uint8], links: NDArray[np.uint8], least: int, fates: IntArray) -> None:
    """Set the weight (h, w) of points in linked patches of fewer than `least` points to 0: union-find along the links."""
    height, width = weights.shape
    patch, parents = np.empty(height * width, dtype=np.int32), np.empty(height * width, dtype=np.int32)
    n_patches = _label(weights, links, patch, parents)
    sizes = np.zeros(n_patches, dtype=np.int64)
    for v in range(height):
        for u in range(width):
            if weights[v, u]:
                sizes[_root(parents, patch[v * width + u])] += 1
    for v in range(height):
        for u in range(width):
            if weights[v, u] and sizes[_root(parents, patch[v * width + u])] < least:
                weights[v, u] = 0
                fates[SPECK] += 1


@compiled
def weigh_loose(points_mm: FloatArray, view: View, noise: PointNoise, weights: NDArray[np.uint8], fates: IntArray) -> None:
    """Weights (1, n) of points (1, n, 3) without a grid: by their range alone."""
    for i in range(points_mm.shape[1]):
        weights[0, i] = 0
        if not np.isfinite(points_mm[0, i, 0]):
            fates[INVALID] += 1
            continue
        range2 = _distance2(points_mm, 0, i, view.camera_in_base_mm)
        weights[0, i] = np.uint8(_weight(noise, range2, _distance2(points_mm, 0, i, view.flange_in_base_mm), MEAN_SQUARE_COSINE))


@compiled
def _interpolated(
    point_in_camera_mm: NDArray[np.float32], lattice_low: FloatArray, lattice_step: FloatArray, covariances: FloatArray, mean: FloatArray
) -> None:
    z = np.float64(point_in_camera_mm[2])
    i, fi = _cell((point_in_camera_mm[0] / z - lattice_low[0]) / lattice_step[0], covariances.shape[0])
    j, fj = _cell((point_in_camera_mm[1] / z - lattice_low[1]) / lattice_step[1], covariances.shape[1])
    k, fk = _cell((z - lattice_low[2]) / lattice_step[2], covariances.shape[2])
    mean[:] = 0.0
    for di in range(2):
        for dj in range(2):
            share = (fi if di else 1.0 - fi) * (fj if dj else 1.0 - fj)
            near, far = share * (1.0 - fk), share * fk
            for entry in range(6):
                mean[entry] += near * covariances[i + di, j + dj, k, entry] + far * covariances[i + di, j + dj, k + 1, entry]


@compiled
def variances_along_normals(
    points_in_camera_mm: NDArray[np.float32],
    points_mm: FloatArray,
    view: View,
    lattice_low: FloatArray,
    lattice_step: FloatArray,
    covariances: FloatArray,
    taken_every: int,
    weights: NDArray[np.uint8],
    normals: NDArray[np.int16],
    variances: NDArray[np.uint32],
) -> None:
    """The calibration's variance (h, w) along the normal, along the sight where there is none, in steps of VARIANCE_STEP_MM2.

    Covariances (a, b, c, 6) stand on a lattice over x/z, y/z and z of the camera frame, as xx xy xz yy yz zz; between its
    nodes they are interpolated, which keeps them covariances. Neighbours in a row share the one taken at the first of
    `taken_every` of them.
    """
    mean = np.zeros(6)
    for v in range(points_mm.shape[0]):
        until = 0
        for u in range(points_mm.shape[1]):
            variances[v, u] = 0
            if weights[v, u] == 0:
                continue
            if u >= until:
                until = u + taken_every
                _interpolated(points_in_camera_mm[v, u], lattice_low, lattice_step, covariances, mean)
            nx, ny, nz = np.float64(normals[v, u, 0]), np.float64(normals[v, u, 1]), np.float64(normals[v, u, 2])
            if nx == 0.0 and ny == 0.0 and nz == 0.0:
                eye = view.camera_in_base_mm
                nx, ny, nz = points_mm[v, u, 0] - eye[0], points_mm[v, u, 1] - eye[1], points_mm[v, u, 2] - eye[2]
            total = nx * nx * mean[0] + ny * ny * mean[3] + nz * nz * mean[5] + 2.0 * (nx * ny * mean[1] + nx * nz * mean[2] + ny * nz * mean[4])
            steps = total / (nx * nx + ny * ny + nz * nz) / VARIANCE_STEP_MM2
            variances[v, u] = np.uint32(min(max(steps, 0.0), _MOST_VARIANCE))


@compiled
def _cell(place: float, n: int) -> tuple[int, float]:
    """Cell of a lattice of n nodes, and the place in it, held inside."""
    inside = min(max(place, 0.0), n - 1.0)
    cell = min(int(inside), n - 2)
    return cell, inside - cell
