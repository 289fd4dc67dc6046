"""A list of robot poses as some program wrote it: numbers with what is known of their meaning, nothing guessed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from drivers.kinematics.se3 import FloatArray

AngleUnit = Literal["deg", "rad"]
LengthUnit = Literal["mm", "m"]


@dataclass(frozen=True, slots=True, eq=False)
class RotationNumbers:
    """The numbers of m rotations."""

    numbers: FloatArray
    """(m, k): three angles, four of a quaternion, or nine of a matrix row by row."""
    by_axis: bool = False
    """Whether three columns are named after the axes x, y, z; otherwise they come in the order of the turns."""
    convention: str | None = None
    """As `drivers.kinematics.rotations.convention_named` takes it, where the file says it."""
    unit: AngleUnit | None = None


@dataclass(frozen=True, slots=True)
class PoseLabel:
    """What belongs to one pose besides its numbers."""

    where: str
    """Its place in the file, for messages."""
    name: str | None = None
    number: int | None = None
    cloud: str | None = None
    sphere: str | None = None
    time: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PoseList:
    """Poses in the order of their file; joints, or positions with rotations, or both."""

    file: str
    kind: Literal["table", "rapid", "ur"]
    labels: tuple[PoseLabel, ...]
    joints: FloatArray | None = None
    """(m, n) axis angles in `joint_unit`."""
    joint_unit: AngleUnit | None = None
    positions: FloatArray | None = None
    """(m, 3) in `position_unit`."""
    position_unit: LengthUnit | None = None
    rotations: RotationNumbers | None = None
    described: tuple[str, ...] = ()
    """How the file was read, for the user."""

    def __len__(self) -> int:
        """How many poses."""
        return len(self.labels)
