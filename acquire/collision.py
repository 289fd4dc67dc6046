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

from acquire.candidates import Blocked
from acquire.cell import Cell
from acquire.obstacles import BoxObstacle, CylinderObstacle, MeshObstacle, Obstacle
from drivers.errors import FileError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import Capsule, RobotModel
from drivers.kinematics.se3 import FloatArray

# Base and shoulder stand where they stand, with their pedestal and bolts in reach; only what swings is checked against obstacles.
_FIRST_SWINGING_LINK = 2
# Neighbours touch by construction, and the rough capsules of links two apart overlap in ordinary poses.
_LINKS_APART = 3


@dataclass(frozen=True, slots=True)
class CollisionSettings:
    """How carefully to stay away."""

    margin_mm: float = 20.0
    """Added to every capsule, for what the rough shapes miss."""
    camera_radius_mm: float = 70.0
    """Of the capsule from the flange to the camera's origin that stands for bracket and camera; 0 leaves it out."""


DEFAULT_SETTINGS = CollisionSettings()


def cell_collisions(cell: Cell, model: RobotModel, settings: CollisionSettings = DEFAULT_SETTINGS) -> Blocked:
    """The collision check of a cell, for `acquire.poses`.

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
) -> Blocked:
    """A function from axis angles (k, n) to whether the arm or camera there touches something (k,).

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

    body = _Body(model, _capsules(model, flange_from_camera, settings), settings.margin_mm)
    surroundings = fcl.DynamicAABBTreeCollisionManager()
    surroundings.registerObjects([*(_obstacle(o, folder or Path()) for o in obstacles), *(_placed(fcl.Sphere(r), c) for c, r in spheres)])
    surroundings.setup()

    def blocked(joints_rad: FloatArray) -> NDArray[np.bool_]:
        centres, rotations = body.places(joints_rad)
        touching = (body.touches(surroundings, *place) for place in zip(centres, rotations, strict=True))
        return np.fromiter(touching, dtype=np.bool_, count=len(joints_rad))

    return blocked


class _Body:
    """The capsules of an arm as objects of the collision library, moved from pose to pose."""

    def __init__(self, model: RobotModel, capsules: Sequence[Capsule], margin_mm: float) -> None:
        import fcl

        self._fcl: Any = fcl
        self._model = model
        self._links = np.array([capsule.link for capsule in capsules], dtype=np.intp)
        self._in_link = np.array([_pose_along(capsule) for capsule in capsules]).reshape(-1, 4, 4)
        lengths = [float(np.linalg.norm(np.subtract(c.end_mm, c.start_mm))) for c in capsules]
        shapes = [fcl.Capsule(c.radius_mm + margin_mm, max(length, 1e-3)) for c, length in zip(capsules, lengths, strict=True)]
        self._objects: list[Any] = [fcl.CollisionObject(shape, fcl.Transform()) for shape in shapes]
        self._swinging = np.flatnonzero(self._links >= _FIRST_SWINGING_LINK)
        self._pairs = [(i, j) for i in range(len(capsules)) for j in range(len(capsules)) if self._links[j] - self._links[i] >= _LINKS_APART]

    def places(self, joints_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Centres (k, c, 3) and orientations (k, c, 3, 3) of all capsules in the base."""
        frames = mdh.chain(self._model, joints_rad)[:, self._links] @ self._in_link
        return frames[..., :3, 3], frames[..., :3, :3]

    def touches(self, surroundings: Any, centres: FloatArray, rotations: FloatArray) -> bool:
        """Whether the arm with its capsules there (c, 3), (c, 3, 3) touches the surroundings or itself."""
        for moved, centre, rotation in zip(self._objects, centres, rotations, strict=True):
            moved.setTransform(self._fcl.Transform(rotation, centre))
        return any(self._touches_surroundings(surroundings, self._objects[i]) for i in self._swinging) or any(
            self._fcl.collide(self._objects[i], self._objects[j], self._fcl.CollisionRequest(), self._fcl.CollisionResult()) for i, j in self._pairs
        )

    def _touches_surroundings(self, surroundings: Any, moved: Any) -> bool:
        data = self._fcl.CollisionData()
        surroundings.collide(moved, data, self._fcl.defaultCollisionCallback)
        return bool(data.result.is_collision)


def _capsules(model: RobotModel, flange_from_camera: ArrayLike | None, settings: CollisionSettings) -> tuple[Capsule, ...]:
    if flange_from_camera is None or settings.camera_radius_mm <= 0:
        return model.shape
    x, y, z = np.asarray(flange_from_camera, dtype=np.float64)[:3, 3].tolist()
    return (*model.shape, Capsule(model.n_joints, (0.0, 0.0, 0.0), (x, y, z), settings.camera_radius_mm))


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
    import trimesh

    path = folder / obstacle.file
    where = f"obstacle {obstacle.name!r}"
    if not path.is_file():
        raise FileError("no such mesh", file=path, where=where, remedy="Check the path; it starts from the folder of the cell file.")
    try:
        mesh = trimesh.load_mesh(str(path))
        vertices, triangles = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    except Exception as error:  # its readers raise whatever they like on broken files
        raise FileError(f"cannot be read as a mesh ({error})", file=path, where=where, remedy="Export it again as STL, PLY or OBJ.") from error
    if len(triangles) == 0 or not np.isfinite(vertices).all():
        raise FileError("holds no triangles", file=path, where=where, remedy="Export it again as a triangle mesh.")
    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(triangles))
    model.addSubModel(vertices * obstacle.scale, triangles)
    model.endModel()
    return model
