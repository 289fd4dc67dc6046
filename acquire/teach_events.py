"""What teaching poses tells, and what it can be told (see `acquire.teach`)."""

from __future__ import annotations

from dataclasses import dataclass

from acquire.plan import PlannedPose
from acquire.sphere import ArcFinding, SphereFinding
from drivers.kinematics.se3 import FloatArray


@dataclass(frozen=True, slots=True)
class Record:
    """Keep this pose; `anyway` also where the sphere is not seen."""

    anyway: bool = False


@dataclass(frozen=True, slots=True)
class Via:
    """Keep this point of the way to the next pose."""


@dataclass(frozen=True, slots=True)
class Undo:
    """Forget the last pose or point of a way."""


@dataclass(frozen=True, slots=True)
class NextSphere:
    """Look at the next sphere of the cell."""


@dataclass(frozen=True, slots=True)
class Guide:
    """Let the arm be led by hand, or hold it."""

    on: bool


@dataclass(frozen=True, slots=True)
class Jog:
    """Move one axis (from 0) by so much."""

    axis: int
    by_rad: float


@dataclass(frozen=True, slots=True)
class Finish:
    """End; what was taught stays."""


TeachCommand = Record | Via | Undo | NextSphere | Guide | Jog | Finish


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """What robot and camera say now."""

    joints_rad: FloatArray | None
    sphere: str | None
    finding: SphereFinding | ArcFinding | None
    reason: str | None
    """Why the sphere is not seen, or what stops the robot."""
    guided: bool
    """Whether the arm can be led by hand at this moment."""
    alike: str | None
    """A pose that is nearly the same."""
    poses: tuple[PlannedPose, ...]
    """Kept so far."""
    n_via: int
    """Points kept of the way to the next pose."""


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """A pose was kept."""

    pose: PlannedPose
    finding: SphereFinding | ArcFinding | None
    touches: bool
    """Whether the straight way from the pose before, as a run will drive it, touches something that the cell file knows."""


@dataclass(frozen=True, slots=True)
class Told:
    """What else is to be said: a point kept, something undone or refused."""

    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Taught:
    """Last event."""

    poses: tuple[PlannedPose, ...]


TeachEvent = Looked | Recorded | Told | Taught
