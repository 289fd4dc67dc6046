"""Early warning of collisions: the arm and the camera as rough capsules against obstacles, spheres and the arm itself.

Distances come from the Flexible Collision Library (python-fcl). What stands in no file is not seen: sphere stands, cables, people.
A pose that passes is a candidate, never a promise; the controller's own limits and a slow first run remain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquire.arm_body import ArmBody
from acquire.candidates import BoolArray
from acquire.cell import Cell
from acquire.obstacles import BoxObstacle, CylinderObstacle, MeshObstacle, Obstacle, mesh_of
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import Capsule, RobotModel
from drivers.kinematics.se3 import FloatArray

# Base and shoulder stand where they stand, with their pedestal and bolts in reach; only what swings is checked against obstacles.
_FIRST_SWINGING_LINK = 2


@dataclass(frozen=True, slots=True)
class CollisionSettings:
    """How carefully to stay away."""

    margin_mm: float = 20.0
    """Added to every capsule, for what the rough shapes miss."""
    way_margin_mm: float = 10.0
    """What is left of it everywhere on a way between two poses (`CollisionCheck.trouble`)."""
    camera_radius_mm: float = 70.0
    """Of the capsule from the flange to the camera's origin that stands for bracket and camera; 0 leaves it out."""


DEFAULT_SETTINGS = CollisionSettings()

# Added to the margin, mm: a way is first looked at with much fatter capsules, which clear long pieces of it at once.
_LADDER_MM = (0.0, 15.0, 50.0, 120.0)
# The finest piece of a way where the margins leave no room for any.
_FINEST_MM = 1.0


def cell_collisions(cell: Cell, model: RobotModel, settings: CollisionSettings = DEFAULT_SETTINGS) -> CollisionCheck:
    """The collision check of a cell, for `acquire.poses` and the ways between poses.

    Raises:
        FileError: a mesh of an obstacle cannot be read.
    """
    spheres = [(np.array(s.centre_in_base_mm), s.radius_mm) for s in cell.spheres.values() if s.centre_in_base_mm is not None]
    return collision_check(
        model, flange_from_camera=cell.flange_from_camera, obstacles=cell.obstacles, spheres=spheres, folder=cell.folder, settings=settings
    )


def collision_check(
    model: RobotModel,
    *,
    flange_from_camera: ArrayLike | None = None,
    obstacles: Sequence[Obstacle] = (),
    spheres: Sequence[tuple[ArrayLike, float]] = (),
    folder: Path | None = None,
    settings: CollisionSettings = DEFAULT_SETTINGS,
) -> CollisionCheck:
    """What the arm and the camera touch.

    Args:
        model: the robot; without a `shape` only the camera is checked.
        flange_from_camera: (4, 4), for the capsule that stands for the camera; none without it.
        obstacles: of the cell file.
        spheres: (centre in base (3,), radius).
        folder: where paths of mesh obstacles start from.
        settings: margins.

    Raises:
        FileError: a mesh cannot be read.
    """
    import fcl

    surroundings = fcl.DynamicAABBTreeCollisionManager()
    surroundings.registerObjects([*(_obstacle(o, folder or Path()) for o in obstacles), *(_placed(fcl.Sphere(r), c) for c, r in spheres)])
    surroundings.setup()
    return CollisionCheck(model, ArmBody(model, flange_from_camera, settings.camera_radius_mm), surroundings, settings)


class CollisionCheck:
    """Called with axis angles (k, n): whether the arm or camera there touches something, (k,), margin included."""

    def __init__(self, model: RobotModel, arm: ArmBody, surroundings: Any, settings: CollisionSettings) -> None:
        self._model, self._arm, self._surroundings, self._settings = model, arm, surroundings, settings
        self._bodies = [_Body(arm, settings.margin_mm + more) for more in _LADDER_MM]
        self._most_mm = np.array([max(settings.margin_mm - settings.way_margin_mm, _FINEST_MM) + more for more in _LADDER_MM])

    def __call__(self, joints_rad: FloatArray) -> BoolArray:
        """Whether something is touched at axis angles (k, n), (k,)."""
        frames = mdh.chain(self._model, joints_rad)
        touching: BoolArray = np.asarray((self._arm.gaps_mm(frames) < 2 * self._settings.margin_mm).any(axis=1))
        for i in np.flatnonzero(~touching):
            touching[i] = self._bodies[0].touches(self._surroundings, frames[i])
        return touching

    def trouble(self, first_rad: FloatArray, second_rad: FloatArray) -> float | None:
        """Where the straight way between two axis angles (n,) comes too near to something: its share of the way, None if nowhere.

        Nothing is left out between samples: in a piece of the way no point of the arm gets further from its place in the
        middle than `ArmBody.excursions_mm`, so the piece is clear when nothing is as near as that there. Other pieces are
        halved; the finest are judged by the whole margin. `way_margin_mm` is kept everywhere on a way that is clear.
        """
        pieces, turns = np.array([[0.0, 1.0]]), np.abs(self._model.coupling @ (second_rad - first_rad))
        while len(pieces):
            middles, halves = pieces.mean(axis=1), 0.5 * np.ptp(pieces, axis=1)
            frames = mdh.chain(self._model, first_rad + middles[:, None] * (second_rad - first_rad))
            open_pieces = self._open(frames, halves[:, None] * turns)
            if isinstance(open_pieces, int):
                return float(middles[open_pieces])
            split, middle = pieces[open_pieces], middles[open_pieces]
            pieces = np.concatenate([np.stack([split[:, 0], middle], axis=1), np.stack([middle, split[:, 1]], axis=1)])
        return None

    def _open(self, frames: FloatArray, turns_rad: FloatArray) -> NDArray[np.intp] | int:
        """Which pieces of a way with these middles (k, n + 1, 4, 4) are to be halved; a single number is of one that touches."""
        margin_mm, way_margin_mm = self._settings.margin_mm, self._settings.way_margin_mm
        excursion, between = self._arm.excursions_mm(frames, turns_rad, way_margin_mm)
        gaps = self._arm.gaps_mm(frames)
        # within the whole margin, and too fine a piece for an end of it to be out of the margin of ways
        touches = ((gaps < 2 * margin_mm) & ((between <= 2 * self._most_mm[0]) | (gaps < 2 * way_margin_mm))).any(axis=1)
        if touches.any():
            return int(touches.argmax())
        is_open: BoolArray = np.asarray((gaps < 2 * way_margin_mm + between).any(axis=1))
        for i, level in enumerate(np.searchsorted(self._most_mm, excursion)):
            if level < len(_LADDER_MM) and not self._bodies[level].touches(self._surroundings, frames[i]):
                continue
            if level == 0 or self._bodies[0].touches(self._surroundings, frames[i]):
                return i
            is_open[i] = True
        return np.flatnonzero(is_open)


class _Body:
    """The capsules of an arm as objects of the collision library, moved from pose to pose."""

    def __init__(self, arm: ArmBody, margin_mm: float) -> None:
        import fcl

        self._fcl: Any = fcl
        self._links = arm.links[arm.links >= _FIRST_SWINGING_LINK]
        capsules = [capsule for capsule in arm.capsules if capsule.link >= _FIRST_SWINGING_LINK]
        self._in_link = np.array([_pose_along(capsule) for capsule in capsules]).reshape(-1, 4, 4)
        lengths = [float(np.linalg.norm(np.subtract(c.end_mm, c.start_mm))) for c in capsules]
        shapes = [fcl.Capsule(c.radius_mm + margin_mm, max(length, 1e-3)) for c, length in zip(capsules, lengths, strict=True)]
        self._objects: list[Any] = [fcl.CollisionObject(shape, fcl.Transform()) for shape in shapes]

    def touches(self, surroundings: Any, frames: FloatArray) -> bool:
        """Whether the arm with its links there (n + 1, 4, 4) touches the surroundings."""
        placed = frames[self._links] @ self._in_link
        return any(self._touches(surroundings, *pair) for pair in zip(self._objects, placed, strict=True))

    def _touches(self, surroundings: Any, moved: Any, pose: FloatArray) -> bool:
        moved.setTransform(self._fcl.Transform(pose[:3, :3], pose[:3, 3]))
        data = self._fcl.CollisionData()
        surroundings.collide(moved, data, self._fcl.defaultCollisionCallback)
        return bool(data.result.is_collision)


def _pose_along(capsule: Capsule) -> FloatArray:
    """The pose (4, 4) in its link of a capsule that lies along its own z."""
    start, end = np.array(capsule.start_mm), np.array(capsule.end_mm)
    along = end - start
    length = float(np.linalg.norm(along))
    z = along / length if length > 0 else np.array([0.0, 0.0, 1.0])
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return se3.from_rotation_translation(np.stack([x, np.cross(z, x), z], axis=-1), 0.5 * (start + end))


def _placed(shape: Any, centre_mm: ArrayLike, rotation: FloatArray | None = None) -> Any:
    import fcl

    return fcl.CollisionObject(shape, fcl.Transform(np.eye(3) if rotation is None else rotation, np.asarray(centre_mm, dtype=np.float64)))


def _obstacle(obstacle: Obstacle, folder: Path) -> Any:
    import fcl

    pose = obstacle.base_from_obstacle
    if isinstance(obstacle, BoxObstacle):
        shape = fcl.Box(*obstacle.size_mm)
    elif isinstance(obstacle, CylinderObstacle):
        shape = fcl.Cylinder(obstacle.diameter_mm / 2, obstacle.height_mm)
    else:
        shape = _mesh(obstacle, folder)
    return _placed(shape, pose[:3, 3], pose[:3, :3])


def _mesh(obstacle: MeshObstacle, folder: Path) -> Any:
    """The triangles of a mesh: its surface only, so an arm wholly inside is not noticed."""
    import fcl

    vertices, triangles = mesh_of(obstacle, folder)
    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(triangles))
    model.addSubModel(vertices, triangles)
    model.endModel()
    return model
