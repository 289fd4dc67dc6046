"""Feasible robot poses that look at a sphere or a workpiece. Which of them tell most is not decided here.

The law of METHOD.md section 4: the sphere uniform in depth and across the field of view, the view direction tilted
from a preferred one about a random axis, roll uniform. Depth and lateral spread in the camera are what makes the
length scale and the hand-eye rotation observable, so they are drawn first and the robot follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from acquire.candidates import Blocked, BoolArray, CandidatePool, feasible
from acquire.ordering import choose_spread, order_by_travel, travel_rad
from acquire.visibility import CameraView, draw_centres, sees_sphere
from drivers.errors import SettingsError
from drivers.kinematics import se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

__all__ = ["CandidatePool", "PoseLaw", "choose_spread", "order_by_travel", "sphere_candidates", "travel_rad", "workpiece_poses"]


@dataclass(frozen=True, slots=True)
class PoseLaw:
    """How views are drawn."""

    largest_tilt_rad: float = float(np.radians(45))
    """From the preferred direction; the tilt is uniform from 0."""
    direction_in_base: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """Preferred view direction (camera z), straight down by default."""
    depth_mm: tuple[float, float] | None = None
    """Of the sphere's centre in the camera; the whole working range if None."""
    limit_margin_rad: float = float(np.radians(2))
    """Distance kept from every axis and linear limit."""
    floor_mm: float | None = None
    """Height in the base below which neither camera nor wrist may go; if None the base plane, or the object's underside where that is lower."""


DEFAULT_LAW = PoseLaw()


def sphere_candidates(
    model: RobotModel,
    flange_from_camera: ArrayLike,
    centre_in_base_mm: ArrayLike,
    radius_mm: float,
    view: CameraView,
    n: int,
    rng: np.random.Generator,
    *,
    law: PoseLaw = DEFAULT_LAW,
    other_spheres: Sequence[tuple[ArrayLike, float]] = (),
    blocked: Blocked | None = None,
) -> CandidatePool:
    """Feasible poses out of n random views of one sphere.

    Args:
        model: the nominal robot.
        flange_from_camera: (4, 4) first guess.
        centre_in_base_mm: (3,) the sphere's centre, also a guess; or (n, 3), one place a view.
        radius_mm: of the sphere.
        view: what the camera sees.
        n: views to draw; how many are feasible depends on the cell.
        rng: seeded by the caller; the same generator state gives the same pool.
        law: how views are drawn.
        other_spheres: (centre in base (3,), radius) of spheres that may hide this one.
        blocked: collision check, e.g. of `acquire.collision`.

    Raises:
        SettingsError: the camera can never see the sphere, or the robot has no closed-form inverse.
    """
    centre = np.asarray(centre_in_base_mm, dtype=np.float64)
    in_camera = draw_centres(view, radius_mm, n, rng, law.depth_mm)
    rotation = _draw_rotations(law, n, rng)
    base_from_camera = se3.from_rotation_translation(rotation, centre - (rotation @ in_camera[..., None])[..., 0])
    visible = sees_sphere(view, in_camera, radius_mm)
    for other, other_radius in other_spheres:
        visible &= ~_hides(base_from_camera[:, :3, 3], centre, radius_mm, np.asarray(other, dtype=np.float64), other_radius)
    floor_mm = min(0.0, centre[..., 2].min() - radius_mm) if law.floor_mm is None else law.floor_mm
    return feasible(model, flange_from_camera, base_from_camera, in_camera, visible, law.limit_margin_rad, floor_mm, blocked)


def workpiece_poses(
    model: RobotModel,
    flange_from_camera: ArrayLike,
    view: CameraView,
    box_in_base_mm: ArrayLike,
    n: int,
    rng: np.random.Generator,
    *,
    law: PoseLaw = DEFAULT_LAW,
    overlap: float = 0.25,
    tries: int = 40,
    blocked: Blocked | None = None,
) -> CandidatePool:
    """Up to n poses whose views cover a box region, e.g. the bounds of a workpiece.

    The region is tiled, as seen along the preferred direction from the middle of the working range; every tile gets its straight view
    first (any roll), and more views, tilted by up to the law's largest tilt, while n allows.

    Args:
        model: the nominal robot.
        flange_from_camera: (4, 4) first guess.
        view: what the camera sees.
        box_in_base_mm: (2, 3) lower and upper corner in the base.
        n: poses wanted, at least one per tile.
        rng: seeded by the caller.
        law: direction, tilt and margins; its depth is not used.
        overlap: share of a view that neighbours see too, 0 to 0.9.
        tries: views drawn for one wanted pose before a tile is given up.
        blocked: collision check.

    Raises:
        SettingsError: n is smaller than the number of tiles, the box is no box, or the sensor sees single profiles only.
    """
    tiles = _tiles(view, np.asarray(box_in_base_mm, dtype=np.float64), law, overlap)
    if n < len(tiles):
        message = f"{n} poses cannot cover the region, which takes {len(tiles)} views"
        raise SettingsError(message, remedy=f"Ask for {len(tiles)} or more, or a smaller region.")
    per_tile = -(-n // len(tiles))
    rotation = _draw_rotations(law, len(tiles) * per_tile * tries, rng).reshape(len(tiles), per_tile, tries, 3, 3)
    rotation[:, 0] = _draw_rotations(_untilted(law), len(tiles) * tries, rng).reshape(len(tiles), tries, 3, 3)
    aim = np.array([0.0, 0.0, view.middle_mm])
    base_from_camera = se3.from_rotation_translation(rotation, tiles[:, None, None] - rotation @ aim).reshape(-1, 4, 4)
    floor_mm = min(0.0, float(np.min(box_in_base_mm))) if law.floor_mm is None else law.floor_mm
    seen = np.ones(len(base_from_camera), dtype=np.bool_)
    in_camera = np.broadcast_to(aim, (len(base_from_camera), 3))
    pool = feasible(model, flange_from_camera, base_from_camera, in_camera, seen, law.limit_margin_rad, floor_mm, blocked)
    _, first = np.unique(pool.view // tries, return_index=True)
    slots = pool.view[first] // tries
    by_round = np.lexsort((slots // per_tile, slots % per_tile))
    uncovered = np.delete(tiles, np.unique(slots // per_tile), axis=0)
    return replace(pool.take(first[by_round][:n]), uncovered_in_base_mm=uncovered)


def _hides(eye_mm: FloatArray, centre_mm: FloatArray, radius_mm: float, other_mm: FloatArray, other_radius_mm: float) -> BoolArray:
    """Whether another sphere stands in the cone from camera origins (k, 3) to a sphere, taken as a cylinder to be safe."""
    sight = centre_mm - eye_mm
    length = np.linalg.norm(sight, axis=-1)
    along = ((other_mm - eye_mm) * sight).sum(-1) / length
    beside = np.linalg.norm(other_mm - eye_mm - along[:, None] * sight / length[:, None], axis=-1)
    return np.asarray((along > 0) & (along < length) & (beside < radius_mm + other_radius_mm))


def _draw_rotations(law: PoseLaw, n: int, rng: np.random.Generator) -> FloatArray:
    """Camera orientations (n, 3, 3) in the base: tilt uniform about a random axis across the preferred direction, roll uniform."""
    tilt, azimuth, roll = rng.uniform(0, law.largest_tilt_rad, n), rng.uniform(-np.pi, np.pi, n), rng.uniform(-np.pi, np.pi, n)
    about_z, about_x = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
    turn = se3.exp_so3(azimuth[:, None] * about_z) @ se3.exp_so3(tilt[:, None] * about_x) @ se3.exp_so3(roll[:, None] * about_z)
    return np.asarray(_frame_along(law.direction_in_base) @ turn)


def _frame_along(direction: ArrayLike) -> FloatArray:
    """A right-handed frame (3, 3) whose z is a direction (3,)."""
    z = np.asarray(direction, dtype=np.float64)
    length = np.linalg.norm(z)
    if not np.isfinite(length) or length == 0:
        raise SettingsError("the preferred view direction has no length", remedy="Give e.g. (0, 0, -1) for straight down.")
    z = z / length
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _untilted(law: PoseLaw) -> PoseLaw:
    return PoseLaw(largest_tilt_rad=0.0, direction_in_base=law.direction_in_base)


def _tiles(view: CameraView, box_mm: FloatArray, law: PoseLaw, overlap: float) -> FloatArray:
    """Points (t, 3) in the base to aim at: a grid across the preferred direction, on the middle of the box."""
    if view.kind == "line_profile":
        raise SettingsError("a line profile sensor covers no region from single poses", remedy="Plan profile by profile by hand.")
    if box_mm.shape != (2, 3) or not np.isfinite(box_mm).all() or (box_mm[0] > box_mm[1]).any():
        raise SettingsError("the region is no box", where="box_in_base_mm", remedy="Give its lower corner, then its upper one, in mm.")
    frame = _frame_along(law.direction_in_base)
    corners = np.stack(np.meshgrid(*box_mm.T, indexing="ij"), axis=-1).reshape(-1, 3) - box_mm.mean(axis=0)
    *half, half_depth = np.abs(corners @ frame).max(axis=0)
    # any roll is allowed, so a view is worth the square inside the circle inside it; at the near side of the region it is smallest
    nearest_mm = max(view.working_range_mm[0], view.middle_mm - half_depth)
    footprint_mm = np.sqrt(2) * nearest_mm * np.tan(min(view.half_angle_rad))
    counts = np.maximum(1, np.ceil(2 * np.array(half) / (footprint_mm * (1 - np.clip(overlap, 0.0, 0.9)))).astype(int))
    axes = [half_width * (2 * (np.arange(count) + 0.5) / count - 1) for half_width, count in zip(half, counts, strict=True)]
    across = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.asarray(box_mm.mean(axis=0) + across @ frame[:, :2].T)
