"""What a capture run tells, and what it can be told (see `acquire.capture`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquire.plan import PlannedPose
from acquire.sphere import ArcFinding, SphereFinding
from drivers.files.shots import Shot

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RunStarted:
    """First event."""

    n_poses: int
    """All poses of the plan."""
    n_done: int
    """Poses that the session already holds and that are not taken again."""


@dataclass(frozen=True, slots=True)
class PoseStarted:
    """The robot stands and is about to move to a pose."""

    pose: PlannedPose
    number: int
    """Counted from 1, over all poses that were begun or done before."""
    n_poses: int
    """As many as there will be, appended ones and repetitions included."""


@dataclass(frozen=True, slots=True, eq=False)
class Moving:
    """One reading under way; a command given here acts at once."""

    pose_id: str
    joints_rad: FloatArray | None
    remaining_rad: float | None
    """Largest axis distance to the next target."""


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """The robot has arrived."""

    pose_id: str
    joints_rad: FloatArray | None
    seconds: float


@dataclass(frozen=True, slots=True)
class Settled:
    """The robot stands still."""

    pose_id: str
    stillness_rad: float
    """Largest axis movement seen in the settling time."""
    seconds: float


@dataclass(frozen=True, slots=True)
class Retried:
    """An exposure failed and is tried once more."""

    pose_id: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Captured:
    """A shot is on disk."""

    pose_id: str
    shot: Shot
    xyz_mm: NDArray[np.float32]
    """The scan, (height, width, 3) camera frame."""
    finding: SphereFinding | ArcFinding | None
    """None for poses without a sphere."""
    prediction_error_mm: float | None
    """How far the sphere was from its predicted place."""


@dataclass(frozen=True, slots=True, eq=False)
class Failed:
    """No usable shot at this pose; the run goes on."""

    pose_id: str
    reason: str
    shot: Shot
    """As recorded, with its scan where there is one."""
    xyz_mm: NDArray[np.float32] | None


@dataclass(frozen=True, slots=True)
class Skipped:
    """A pose was left out by command."""

    pose_id: str
    shot: Shot


@dataclass(frozen=True, slots=True)
class Paused:
    """The robot stands; told again and again until a Continue, Skip or Stop comes."""

    pose_id: str | None
    """The pose that was in hand."""


@dataclass(frozen=True, slots=True)
class Finished:
    """Last event; the robot stands."""

    n_ok: int
    n_failed: int
    n_skipped: int
    stopped: bool
    """Whether a Stop ended the run before its last pose."""


Event = RunStarted | PoseStarted | Moving | Moved | Settled | Retried | Captured | Failed | Skipped | Paused | Finished


@dataclass(frozen=True, slots=True)
class Continue:
    """Go on, also after a Pause."""


@dataclass(frozen=True, slots=True)
class Skip:
    """Leave the pose in hand and go to the next one."""


@dataclass(frozen=True, slots=True)
class Redo:
    """Take the last shot's pose again, next; the new shot replaces the old one."""


@dataclass(frozen=True, slots=True)
class Pause:
    """Stop the robot and wait; a Continue takes up the pose in hand from its motion on."""


@dataclass(frozen=True, slots=True)
class Stop:
    """Stop the robot and end the run; what was taken stays."""


@dataclass(frozen=True, slots=True, eq=False)
class Append:
    """Take one more pose, last."""

    pose: PlannedPose


Command = Continue | Skip | Redo | Pause | Stop | Append
