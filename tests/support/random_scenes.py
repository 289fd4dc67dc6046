"""Random cluttered scenes round a sphere, or round the place where none is: table, post, boxes, pipe, spheres of other sizes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.support.scenes import box_range_mm, frame, pipe_range_mm, plane_range_mm, rays, sphere_range_mm

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A scan and the truth about it."""

    xyz_mm: NDArray[np.float32]
    radius_mm: float
    centre_mm: FloatArray
    predicted_mm: FloatArray | None
    hidden: float
    """Share of the sphere's near side that other things hide."""


def random_scene(seed: int, *, with_sphere: bool = True) -> Scene:
    """Radius 5..60 mm at 200..1000 mm, noise 0.01..0.15 mm, flying pixels, up to 5 % outliers and 40 % holes.

    Without the sphere a pipe of its radius stands there instead.
    """
    rng = np.random.default_rng(seed)
    radius = float(np.exp(rng.uniform(np.log(5), np.log(60))))
    depth = float(rng.uniform(max(200, 5 * radius), 1000))
    across, down = (max(least, float(np.degrees(np.arctan(share * radius / depth)))) for least, share in ((9.0, 2.5), (7.0, 2.0)))
    sight = rays(640, 400, (across, down))
    margin = depth * np.tan(np.radians([across, down])) - 1.15 * radius
    centre = np.append(rng.uniform(-margin, margin), depth)
    sizes = rng.choice([0.5, 0.6, 1.5, 2.0], rng.integers(0, 3))
    others = [(centre + _away(rng) * radius * (1 + size + rng.uniform(0.3, 3)), radius * size) for size in sizes]
    surfaces = _surfaces(rng, sight, centre, radius)
    if not with_sphere:
        surfaces.append(pipe_range_mm(sight, centre, radius, 6 * radius))
    spheres = [(centre, radius), *others] if with_sphere else others
    xyz = frame(
        spheres, sight=sight, surfaces=surfaces, noise_mm=rng.uniform(0.01, 0.15), flying=rng.uniform(0, 1), outliers=rng.uniform(0, 0.05), seed=seed
    )
    xyz[rng.uniform(size=xyz.shape[:2]) < rng.uniform(0, 0.4)] = np.nan
    own = sphere_range_mm(sight, centre, radius)
    before = np.minimum.reduce([*surfaces, *(sphere_range_mm(sight, *other) for other in others)]) < own
    predicted = None if rng.uniform() < 0.4 else centre + _away(rng) * rng.uniform(0, 45)
    hidden = float((before & np.isfinite(own)).sum() / np.isfinite(own).sum())
    return Scene(xyz.reshape(-1, 3) if rng.uniform() < 0.3 else xyz, radius, centre, predicted, hidden)


def _away(rng: np.random.Generator) -> FloatArray:
    """A random direction, not towards the camera."""
    direction = rng.normal(size=3)
    direction[2] = abs(direction[2])
    return np.asarray(direction / np.linalg.norm(direction))


def _surfaces(rng: np.random.Generator, sight: FloatArray, centre: FloatArray, radius: float) -> list[FloatArray]:
    behind = np.array([0.0, 0.0, radius])
    table = plane_range_mm(sight, centre + behind * rng.uniform(1, 4), [*rng.normal(0, 0.3, 2), 1.0])
    post = pipe_range_mm(sight, np.add(centre, (0, 1.5 * radius, 0)), rng.uniform(0.2, 0.6) * radius, 3 * radius)
    places = centre + 3 * behind + rng.uniform(-6, 6, (int(rng.integers(0, 4)), 3)) * radius
    return [table, post, *(box_range_mm(sight, place, rng.uniform(0.3, 1.5, 3) * radius) for place in places)]
