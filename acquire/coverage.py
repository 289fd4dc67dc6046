"""Which parts of a workpiece's surface a camera sees from where, and the views that cover it.

A point of the surface is seen from a view where it is in range and field of view, where the line of sight meets the surface not
too flatly, and where neither the part itself nor anything of the cell stands in between (rays, by Open3D). What the projector of
the camera does not reach is not known here: stay below the camera's own limit of incidence.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquire.visibility import CameraView
from drivers.errors import SettingsError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

Triangles = NDArray[np.int64]
Stages = NDArray[np.uint8]

LARGEST_INCIDENCE_RAD = float(np.radians(60))
OVERLAP = 0.15
"""Share of what a view sees that views before it have seen too, where one so good is to be had."""
OUT_OF_VIEW, TOO_FLAT, OCCLUDED, SEEN = 0, 1, 2, 3
_REASONS = {OUT_OF_VIEW: "not in view", TOO_FLAT: "incidence", OCCLUDED: "occluded"}
NO_POSE, TOO_FEW, TOO_LITTLE = "no pose of the arm", "too few poses", "too little for a pose"
_LEAST_GAIN = 0.002
"""Of the surface: a view that adds less is not taken."""
_NEAR_MM = 0.3
"""Before a point: hits of a ray as near as that are the point's own surface."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Points spread evenly over a surface."""

    points_in_base_mm: FloatArray
    """(m, 3)."""
    normals_in_base: FloatArray
    """(m, 3) outward."""


@dataclass(frozen=True, slots=True, eq=False)
class Cover:
    """Chosen views."""

    rows: tuple[int, ...]
    """Of the views, the one that adds most first."""
    not_covered: Mapping[str, float]
    """Shares of the surface by reason."""


def surface_of(vertices_in_base_mm: FloatArray, triangles: Triangles, n: int, rng: np.random.Generator) -> Surface:
    """N points on triangles, each as likely as its area.

    Raises:
        SettingsError: the triangles have no area.
    """
    corners = vertices_in_base_mm[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    if not areas.sum() > 0:
        raise SettingsError("the part has no surface", remedy="Export it again as a mesh of triangles.")
    # evenly along the running area, so that no large face is left with few points
    at = (np.arange(n) + rng.uniform(0, 1, n)) / n * areas.sum()
    which = np.minimum(np.searchsorted(np.cumsum(areas), at), len(areas) - 1)
    u, v = rng.uniform(0, 1, (2, n))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    first, second, third = np.moveaxis(corners[which], 1, 0)
    points = first + u[:, None] * (second - first) + v[:, None] * (third - first)
    return Surface(points, normals[which] / areas[which, None])


class Sights:
    """Lines of sight among the solids of a cell."""

    def __init__(self, solids: Sequence[tuple[FloatArray, Triangles]]) -> None:
        import open3d as o3d

        self._o3d: Any = o3d
        self._scene: Any = self._o3d.t.geometry.RaycastingScene()
        tensor = self._o3d.core.Tensor
        for vertices, triangles in solids:
            self._scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(triangles.astype(np.uint32)))

    def stages(self, view: CameraView, base_from_camera: FloatArray, surface: Surface, incidence_rad: float = LARGEST_INCIDENCE_RAD) -> Stages:
        """(k, m) how far points of a surface come from views (k, 4, 4): OUT_OF_VIEW, TOO_FLAT, OCCLUDED or SEEN."""
        return np.array([self._stages_of(view, pose, surface, incidence_rad) for pose in base_from_camera], dtype=np.uint8).reshape(
            len(base_from_camera), len(surface.points_in_base_mm)
        )

    def _stages_of(self, view: CameraView, base_from_camera: FloatArray, surface: Surface, incidence_rad: float) -> Stages:
        x, y, z = se3.apply(se3.inverse(base_from_camera), surface.points_in_base_mm).T
        across, down = np.tan(view.half_angle_rad)
        in_view = (z >= view.working_range_mm[0]) & (z <= view.working_range_mm[1]) & (np.abs(x) <= z * across) & (np.abs(y) <= z * down)
        eye = base_from_camera[:3, 3]
        sights = surface.points_in_base_mm - eye
        lengths = np.linalg.norm(sights, axis=1)
        steep = -(sights * surface.normals_in_base).sum(axis=1) >= lengths * np.cos(incidence_rad)
        stages = np.where(in_view, np.where(steep, OCCLUDED, TOO_FLAT), OUT_OF_VIEW).astype(np.uint8)
        tried = np.flatnonzero(stages == OCCLUDED)
        if len(tried):
            rays = np.concatenate([np.broadcast_to(eye, (len(tried), 3)), sights[tried]], axis=1)
            hits = self._scene.cast_rays(self._o3d.core.Tensor(rays.astype(np.float32)), nthreads=1)["t_hit"].numpy()
            stages[tried[hits * lengths[tried] >= lengths[tried] - _NEAR_MM]] = SEEN
        return stages


def looking_poses(surface: Surface, view: CameraView, n: int, rng: np.random.Generator) -> FloatArray:
    """N camera poses (n, 4, 4) in the base that look at random points of a surface, half along its normals and half from above; any roll.

    Raises:
        SettingsError: the sensor sees single profiles only.
    """
    if view.kind == "line_profile":
        raise SettingsError("a line profile sensor covers no surface from single poses", remedy="Plan profile by profile by hand.")
    which = rng.integers(0, len(surface.points_in_base_mm), n)
    towards = np.where((np.arange(n) % 2 == 0)[:, None], surface.normals_in_base[which], [0.0, 0.0, 1.0])
    tilted = towards + np.tan(rng.uniform(0, np.radians(50), n))[:, None] * _across(towards, rng)
    z = -tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
    x = _across(z, rng)
    rotation = np.stack([x, np.cross(z, x), z], axis=-1)
    near, far = view.working_range_mm
    distance = rng.uniform(near + 0.1 * (far - near), near + 0.8 * (far - near), n)
    return se3.from_rotation_translation(rotation, surface.points_in_base_mm[which] - distance[:, None] * z)


def _across(directions: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Random unit vectors (n, 3) across directions (n, 3)."""
    drawn = np.cross(directions, rng.standard_normal(directions.shape))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def choose_cover(stages: Stages, feasible: NDArray[np.bool_], n: int) -> Cover:
    """Up to n feasible views that see as much as possible, one after the other, each overlapping those before where that can be.

    Args:
        stages: (k, m) of `Sights.stages`.
        feasible: (k,) views that the arm can take.
        n: the most views.
    """
    seen = (stages == SEEN) & feasible[:, None]
    covered = np.zeros(stages.shape[1], dtype=np.bool_)
    rows: list[int] = []
    while len(rows) < n:
        gains = (seen & ~covered).sum(axis=1)
        if gains.max(initial=0) < max(1, _LEAST_GAIN * stages.shape[1]):
            break
        overlaps = (seen & covered).sum(axis=1) >= OVERLAP * seen.sum(axis=1)
        worth = np.where(overlaps, gains, 0) if rows and gains[overlaps].max(initial=0) >= 0.25 * gains.max() else gains
        rows.append(int(np.argmax(worth)))
        covered |= seen[rows[-1]]
    reasons = Counter(_reasons(stages[:, ~covered], feasible, TOO_FEW if len(rows) == n else TOO_LITTLE))
    return Cover(tuple(rows), {reason: count / stages.shape[1] for reason, count in reasons.items()})


def _reasons(stages: Stages, feasible: NDArray[np.bool_], left_out: str) -> list[str]:
    """Why points (k, m) that no chosen view sees are not seen: the last stage that one of the feasible views came to."""
    by_arm, by_any = stages[feasible].max(axis=0, initial=0), stages.max(axis=0, initial=0)
    return [left_out if arm == SEEN else NO_POSE if any_ == SEEN else _REASONS[int(max(arm, any_))] for arm, any_ in zip(by_arm, by_any, strict=True)]
