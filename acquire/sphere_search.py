"""Coarse search for spheres of known radius in any cloud: local RANSAC in the cells of a grid, then support.

Sampling is local because a sphere may be one point in a thousand of a frame: three points picked over the whole
frame would never all lie on it. Each triple and the known radius give two centres, of which the one behind the
surface is taken; the mirror centre on the camera's side is never proposed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_SEEDS_PER_CELL = 6
_TRIES_PER_SEED = 10
_LOCAL_SUPPORT = 0.10
_SPREAD = 0.6
_PROPOSALS = 400


@dataclass(frozen=True, slots=True, eq=False)
class ValidPoints:
    """What a scan holds near the place of interest."""

    points_mm: FloatArray
    """(m, 3) in the camera frame."""
    indices: IntArray
    """(m,) rows of the flattened scan."""
    n_valid: int
    """Finite, non-zero points in the whole scan."""
    largest_mm: float
    """Largest |coordinate| of them."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A place where a sphere may be."""

    centre_in_camera_mm: FloatArray
    support: float
    """Points on the sphere, as many as there would be at 1 m: comparable between spheres near and far."""


def valid_points(xyz_mm: NDArray[Any], *, centre_mm: FloatArray | None, reach_mm: float, furthest_mm: float) -> ValidPoints:
    """Finite points of a scan (..., 3) within reach of a centre (None: everywhere); all-zero points are holes too."""
    from acquire.sphere_kernels import valid_within

    dtype = np.float32 if xyz_mm.dtype == np.float32 else np.float64
    flat = np.ascontiguousarray(xyz_mm.reshape(-1, 3), dtype=dtype)
    place, reach = (np.zeros(3), np.inf) if centre_mm is None else (centre_mm, reach_mm)
    indices, n_valid, largest = valid_within(flat, place, reach, furthest_mm)
    return ValidPoints(points_mm=flat[indices].astype(np.float64), indices=indices, n_valid=n_valid, largest_mm=largest)


def near(points_mm: FloatArray, centre_mm: FloatArray, reach_mm: float) -> IntArray:
    """Rows of (n, 3) points within reach of a centre (3,)."""
    from acquire.sphere_kernels import valid_within

    return valid_within(points_mm, centre_mm, reach_mm, np.inf)[0]


def coarse_tolerance_mm(radius_mm: float) -> float:
    """Shell half-width of the coarse search: room for noise, a bent depth field and a triple's own error."""
    return float(np.clip(0.05 * radius_mm, 0.4, 2.0))


def search(
    points_mm: FloatArray,
    radius_mm: float,
    *,
    rng: np.random.Generator,
    least_share: float = 0.15,
    facing: float = 1.0,
    most_points: int = 120_000,
) -> list[Candidate]:
    """Places where a sphere of this radius may be, best supported first, none within half a radius of a better one.

    Args:
        points_mm: (n, 3) finite points, camera frame, camera at the origin.
        radius_mm: the certified radius.
        rng: picks the subsample and seeds the triples.
        least_share: of the points seen at a sphere's middle, the share that must lie on it (a table touches at 15 %).
        facing: +1 for surfaces that face the camera, -1 for hollows (to tell why nothing was found).
        most_points: larger clouds are thinned to about so many, or more where the sphere is small.
    """
    from acquire.sphere_kernels import hypotheses, supports

    seed = int(rng.integers(1 << 20))
    points_mm = thinned(points_mm, _enough(radius_mm, most_points), rng)
    tolerance = coarse_tolerance_mm(radius_mm)
    edge = radius_mm + tolerance
    ordered, keys, starts, dims, origin = _grid(points_mm, edge)
    centres, local = hypotheses(ordered, keys, starts, dims, radius_mm, tolerance, facing, _SEEDS_PER_CELL, _TRIES_PER_SEED, seed)
    proposals = _distinct(centres, local, 0.2 * radius_mm)
    counts, shares = supports(ordered, keys, starts, dims, origin, edge, proposals, radius_mm, tolerance, facing)
    support = np.where(shares >= least_share, counts * (proposals**2).sum(axis=1) * 1e-6, 0.0)
    return _apart(proposals, support, _SPREAD * radius_mm)


def thinned(points_mm: FloatArray, most: int, rng: np.random.Generator) -> FloatArray:
    """About `most` of (n, 3) points, chosen at random, in their order; all where there are no more."""
    if len(points_mm) <= most:
        return points_mm
    return points_mm[rng.random(len(points_mm), dtype=np.float32) < most / len(points_mm)]


def _enough(radius_mm: float, most_points: int) -> int:
    """A sphere's share of a frame falls with its radius squared; below 19 mm more points are kept."""
    return int(most_points * np.clip((19.0 / radius_mm) ** 2, 1.0, 10.0))


def _distinct(centres: FloatArray, local_support: FloatArray, distance_mm: float) -> FloatArray:
    """The best hypothesis of every small cube, best first, not more than a few hundred."""
    best = np.argsort(-local_support, kind="stable")
    best = best[local_support[best] >= _LOCAL_SUPPORT]
    _, first = np.unique(np.round(centres[best] / distance_mm).astype(np.int64), axis=0, return_index=True)
    return np.ascontiguousarray(centres[best[np.sort(first)[:_PROPOSALS]]])


def _grid(points_mm: FloatArray, edge_mm: float) -> tuple[FloatArray, IntArray, IntArray, IntArray, FloatArray]:
    """Points sorted by cell, keys of the occupied cells, where each begins, cells per axis, the grid's corner."""
    # two empty cells round the cloud: centres lie up to one edge outside it, and their neighbours one more
    origin = points_mm.min(axis=0) - 2 * edge_mm
    cells = np.floor((points_mm - origin) / edge_mm).astype(np.int64)
    dims = cells.max(axis=0) + 3
    key = (cells[:, 0] * dims[1] + cells[:, 1]) * dims[2] + cells[:, 2]
    order = np.argsort(key, kind="stable")
    keys, starts = np.unique(key[order], return_index=True)
    return np.ascontiguousarray(points_mm[order]), keys, np.append(starts, len(order)), dims, origin


def _apart(centres: FloatArray, support: FloatArray, distance_mm: float) -> list[Candidate]:
    """Greedy choice by support, each at least a distance from all better ones."""
    chosen: list[Candidate] = []
    for i in np.argsort(-support, kind="stable"):
        if support[i] <= 0 or len(chosen) >= 12:
            break
        if all(np.linalg.norm(centres[i] - c.centre_in_camera_mm) > distance_mm for c in chosen):
            chosen.append(Candidate(centre_in_camera_mm=centres[i], support=float(support[i])))
    return chosen
