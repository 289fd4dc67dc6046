"""Exact little scenes for sphere finding: spheres, planes and boxes seen by a pinhole camera at the origin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


def rays(width: int = 320, height: int = 200, half_angles_deg: tuple[float, float] = (27.5, 18.0)) -> FloatArray:
    """Unit lines of sight (height, width, 3), x right, y down, z out."""
    x = np.tan(np.radians(half_angles_deg[0])) * np.linspace(-1, 1, width)
    y = np.tan(np.radians(half_angles_deg[1])) * np.linspace(-1, 1, height)
    grid = np.stack([*np.meshgrid(x, y), np.ones((height, width))], axis=-1)
    return np.asarray(grid / np.linalg.norm(grid, axis=-1, keepdims=True))


def sphere_range_mm(sight: FloatArray, centre_mm: ArrayLike, radius_mm: float) -> FloatArray:
    """Distance along each line of sight (..., 3) to the near side of a sphere, inf where it misses."""
    centre = np.asarray(centre_mm, dtype=np.float64)
    along = sight @ centre
    squared = along**2 - centre @ centre + radius_mm**2
    return np.where(squared > 0, along - np.sqrt(np.maximum(squared, 0)), np.inf)


def plane_range_mm(sight: FloatArray, point_mm: ArrayLike, normal: ArrayLike) -> FloatArray:
    """Distance along each line of sight to a plane, inf where it is behind."""
    normal_ = np.asarray(normal, dtype=np.float64)
    with np.errstate(divide="ignore"):
        distance = (np.asarray(point_mm, dtype=np.float64) @ normal_) / (sight @ normal_)
    return np.where(distance > 0, distance, np.inf)


def box_range_mm(sight: FloatArray, centre_mm: ArrayLike, half_size_mm: ArrayLike) -> FloatArray:
    """Distance along each line of sight to a box along the camera's axes, inf where it misses."""
    centre, half = np.asarray(centre_mm, dtype=np.float64), np.asarray(half_size_mm, dtype=np.float64)
    with np.errstate(divide="ignore"):
        one, other = (centre - half) / sight, (centre + half) / sight
    near, far = np.minimum(one, other).max(axis=-1), np.maximum(one, other).min(axis=-1)
    return np.where((near < far) & (near > 0), near, np.inf)


def pipe_range_mm(sight: FloatArray, centre_mm: ArrayLike, radius_mm: float, length_mm: float) -> FloatArray:
    """Distance along each line of sight to a pipe along y, inf where it misses (no lids)."""
    centre = np.asarray(centre_mm, dtype=np.float64)
    across = np.array([1.0, 0.0, 1.0])
    a, b = (sight**2) @ across, (sight * centre) @ across
    discriminant = b**2 - a * ((centre**2) @ across - radius_mm**2)
    distance = np.where(discriminant > 0, (b - np.sqrt(np.maximum(discriminant, 0))) / a, np.inf)
    return np.where(np.abs(np.where(np.isfinite(distance), distance, 0) * sight[..., 1] - centre[1]) < length_mm / 2, distance, np.inf)


def frame(
    spheres: Sequence[tuple[ArrayLike, float]],
    *,
    sight: FloatArray | None = None,
    surfaces: Sequence[FloatArray] = (),
    noise_mm: float = 0.05,
    flying: float = 0.0,
    outliers: float = 0.0,
    seed: int = 0,
) -> NDArray[np.float32]:
    """An organised scan (height, width, 3) of spheres (centre, radius) and other ranges, nearest surface seen.

    Args:
        spheres: centres in the camera frame and radii, mm.
        sight: lines of sight, `rays()` by default.
        surfaces: ranges of other surfaces, one array of the grid's shape each.
        noise_mm: sigma along the line of sight.
        flying: share of pixels at depth steps that fall between the two surfaces.
        outliers: share of all pixels at a random range between 200 and 1000 mm.
        seed: of the noise.
    """
    rng = np.random.default_rng(seed)
    sight = rays() if sight is None else sight
    ranges = np.stack([*(sphere_range_mm(sight, centre, radius) for centre, radius in spheres), *surfaces])
    distance = ranges.min(axis=0)
    distance = distance + rng.normal(0, noise_mm, distance.shape)
    if flying:
        filled = np.where(np.isfinite(distance), distance, 1500.0)
        step = np.zeros(distance.shape, dtype=np.bool_)
        step[:, 1:] = np.abs(np.diff(filled, axis=1)) > 3.0
        mixed = step & (rng.uniform(size=step.shape) < flying)
        beside = np.roll(filled, 1, axis=1)
        share = rng.uniform(size=step.shape)
        distance = np.where(mixed, share * filled + (1 - share) * beside, distance)
    wild = rng.uniform(size=distance.shape) < outliers
    distance = np.where(wild, rng.uniform(200, 1000, distance.shape), distance)
    return np.where(np.isfinite(distance)[..., None], sight * distance[..., None], np.nan).astype(np.float32)


def cap(
    n: int,
    *,
    centre_mm: ArrayLike,
    radius_mm: float,
    half_angle_rad: float = 1.1,
    noise_mm: float = 0.08,
    seed: int = 0,
    around: ArrayLike | None = None,
) -> FloatArray:
    """(n, 3) points uniform on the cap of a sphere round the direction to the camera, with noise along z."""
    rng = np.random.default_rng(seed)
    centre = np.asarray(centre_mm, dtype=np.float64)
    axis = -centre / np.linalg.norm(centre) if around is None else np.asarray(around, dtype=np.float64)
    normals = rng.normal(size=(60 * n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals @ axis > np.cos(half_angle_rad)][:n]
    noise = np.outer(rng.normal(0, noise_mm, len(normals)), [0.0, 0.0, 1.0])
    return np.asarray(centre + radius_mm * normals + noise)
