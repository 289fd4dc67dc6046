"""Exact rays against spheres and boxes, and depth edges, pixel by pixel."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, compiled_parallel, parallel_range

FloatArray = NDArray[np.float64]


@compiled
def sphere_depth(dx: float, dy: float, cx: float, cy: float, cz: float, radius: float) -> float:
    """Depth z of the nearer crossing of the ray (dx, dy, 1) from the origin with a sphere, infinite where it misses.

    The discriminant by way of |d x c|² keeps twelve digits where b² - ac would lose seven.
    """
    a = dx * dx + dy * dy + 1.0
    ex, ey, ez = dy * cz - cy, cx - dx * cz, dx * cy - dy * cx
    discriminant = a * radius * radius - (ex * ex + ey * ey + ez * ez)
    if discriminant < 0.0:
        return math.inf
    depth = (dx * cx + dy * cy + cz - math.sqrt(discriminant)) / a
    return depth if depth > 0.0 else math.inf


@compiled
def box_depth(dx: float, dy: float, box_from_camera: FloatArray, half: FloatArray) -> tuple[float, int]:
    """Depth z and the axis of the face where the ray (dx, dy, 1) enters a box, infinite where it misses (slab method)."""
    enter, leave, face = -math.inf, math.inf, 0
    for i in range(3):
        origin = box_from_camera[i, 3]
        slope = box_from_camera[i, 0] * dx + box_from_camera[i, 1] * dy + box_from_camera[i, 2]
        if slope == 0.0:
            if abs(origin) > half[i]:
                return math.inf, 0
            continue
        near = (-math.copysign(half[i], slope) - origin) / slope
        far = (math.copysign(half[i], slope) - origin) / slope
        if near > enter:
            enter, face = near, i
        leave = min(leave, far)
    if enter > leave or enter <= 0.0:
        return math.inf, 0
    return enter, face


@compiled_parallel
def cast_rays(
    x_slopes: FloatArray,
    y_slopes: FloatArray,
    centres: FloatArray,
    radii: FloatArray,
    box_from_camera: FloatArray,
    half_sizes: FloatArray,
    bounds: FloatArray,
    depth: FloatArray,
    cos_incidence: FloatArray,
) -> None:
    """Nearest hit of every ray (x_slopes[u], y_slopes[v], 1) with spheres (k, 3), (k,) and boxes (m, 4, 4), (m, 3).

    `depth` (h, w) comes in holding what is already hit (infinite elsewhere) and keeps the nearer; `cos_incidence` (h, w)
    is written where a hit is taken. `bounds` (m, 4) are spheres around the boxes, for a quick miss. Camera frame, mm.
    """
    for v in parallel_range(y_slopes.shape[0]):
        dy = y_slopes[v]
        for u in range(x_slopes.shape[0]):
            dx = x_slopes[u]
            norm = math.sqrt(dx * dx + dy * dy + 1.0)
            for k in range(radii.shape[0]):
                z = sphere_depth(dx, dy, centres[k, 0], centres[k, 1], centres[k, 2], radii[k])
                if z < depth[v, u]:
                    depth[v, u] = z
                    inward = (centres[k, 0] - z * dx) * dx + (centres[k, 1] - z * dy) * dy + centres[k, 2] - z
                    cos_incidence[v, u] = inward / (radii[k] * norm)
            for m in range(bounds.shape[0]):
                if sphere_depth(dx, dy, bounds[m, 0], bounds[m, 1], bounds[m, 2], bounds[m, 3]) == math.inf and (
                    bounds[m, 0] ** 2 + bounds[m, 1] ** 2 + bounds[m, 2] ** 2 > bounds[m, 3] ** 2
                ):
                    continue
                z, face = box_depth(dx, dy, box_from_camera[m], half_sizes[m])
                if z < depth[v, u]:
                    depth[v, u] = z
                    row = box_from_camera[m, face]
                    cos_incidence[v, u] = abs(row[0] * dx + row[1] * dy + row[2]) / norm


@compiled_parallel
def depth_gaps(depth: FloatArray, jump: float, longest: float, gap: FloatArray) -> None:
    """For every hit (h, w): how far the scene falls back at one of its four neighbours, at most `longest`; 0 inside surfaces."""
    height, width = depth.shape
    for v in parallel_range(height):
        for u in range(width):
            z = depth[v, u]
            gap[v, u] = 0.0
            if z == math.inf:
                continue
            behind = z
            if u > 0:
                behind = max(behind, depth[v, u - 1])
            if u + 1 < width:
                behind = max(behind, depth[v, u + 1])
            if v > 0:
                behind = max(behind, depth[v - 1, u])
            if v + 1 < height:
                behind = max(behind, depth[v + 1, u])
            if behind - z > jump:
                gap[v, u] = min(behind - z, longest)
