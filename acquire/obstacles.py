"""Things that stand in the cell: boxes, cylinders and meshes, each with its own frame."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.errors import FileError
from drivers.files.schema import Positive, StrictModel, Text, Vector3
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray


class _Placed(StrictModel):
    name: Text
    centre_in_base_mm: Vector3
    """Of a box or cylinder its centre, of a mesh the origin of its coordinates."""
    rotation_deg: Vector3 = (0.0, 0.0, 0.0)
    """Turns about the fixed base axes, x first, then y, then z."""

    @property
    def base_from_obstacle(self) -> FloatArray:
        """(4, 4) pose of the obstacle's own frame."""
        x, y, z = (se3.exp_so3(angle * axis) for angle, axis in zip(np.radians(self.rotation_deg), np.eye(3), strict=True))
        return se3.from_rotation_translation(z @ y @ x, self.centre_in_base_mm)


class BoxObstacle(_Placed):
    """A box, full edge lengths along its own axes."""

    kind: Literal["box"]
    size_mm: tuple[Positive, Positive, Positive] = Field(strict=False)


class CylinderObstacle(_Placed):
    """A cylinder along its own z axis."""

    kind: Literal["cylinder"]
    diameter_mm: Positive
    height_mm: Positive


class MeshObstacle(_Placed):
    """A triangle mesh (STL, PLY, OBJ) from a path relative to the cell file, its numbers times `scale` being mm."""

    kind: Literal["mesh"]
    file: Text
    centre_in_base_mm: Vector3 = (0.0, 0.0, 0.0)
    scale: Positive = 1.0


Obstacle = Annotated[BoxObstacle | CylinderObstacle | MeshObstacle, Field(discriminator="kind")]


def mesh_of(obstacle: MeshObstacle, folder: Path) -> tuple[FloatArray, NDArray[np.int64]]:
    """Vertices (v, 3) in its own frame, mm, and triangles (t, 3) of a mesh whose path starts from a folder.

    Raises:
        FileError: it cannot be read, or holds no triangles.
    """
    import trimesh

    path, where = folder / obstacle.file, f"obstacle {obstacle.name!r}"
    if not path.is_file():
        raise FileError("no such mesh", file=path, where=where, remedy="Check the path; it starts from the folder of the cell file.")
    try:
        mesh = trimesh.load_mesh(str(path))
        vertices, triangles = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    except Exception as error:  # its readers raise whatever they like on broken files
        raise FileError(f"cannot be read as a mesh ({error})", file=path, where=where, remedy="Export it again as STL, PLY or OBJ.") from error
    if len(triangles) == 0 or not np.isfinite(vertices).all():
        raise FileError("holds no triangles", file=path, where=where, remedy="Export it again as a triangle mesh.")
    return vertices * obstacle.scale, triangles


def solid_of(obstacle: Obstacle, folder: Path) -> tuple[FloatArray, NDArray[np.int64]]:
    """Vertices (v, 3) in the base, mm, and triangles (t, 3) of the surface of any obstacle.

    Raises:
        FileError: as `mesh_of`.
    """
    import trimesh

    if isinstance(obstacle, MeshObstacle):
        vertices, triangles = mesh_of(obstacle, folder)
    else:
        if isinstance(obstacle, BoxObstacle):
            mesh = trimesh.creation.box(extents=obstacle.size_mm)
        else:
            mesh = trimesh.creation.cylinder(radius=obstacle.diameter_mm / 2, height=obstacle.height_mm)
        vertices, triangles = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    return se3.apply(obstacle.base_from_obstacle, vertices), triangles
