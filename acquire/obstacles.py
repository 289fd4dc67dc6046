"""Things that stand in the cell: boxes, cylinders and meshes, each with its own frame."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

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
