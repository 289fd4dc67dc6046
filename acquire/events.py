"""What a capture run tells, and what it can be told (see `acquire.capture`)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from acquire.capture_states import RunState
from acquire.plan import PlannedPose
from acquire.sphere import ArcFinding, SphereFinding
from drivers.errors import SpherecalError
from drivers.files.shots import Shot

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RunStarted:
    """First event."""

    state: ClassVar[RunState] = RunState.READY
    n_poses: int
    """All poses of the plan."""
    n_done: int
    """Poses that the session already holds and that are not taken again."""


@dataclass(frozen=True, slots=True)
class WarmingUp:
    """The robot stands and the camera takes pictures until it no longer drifts. A Skip goes on at once."""

    state: ClassVar[RunState] = RunState.SETTLING
    seconds: float
    """Since it began."""
    drift_k_per_min: float | None
    """Of the camera's fastest sensor over the last window; None where it has none, or too early."""
    drift_mm_per_min: float | None
    """Of the median distance to what is in view."""
    warm: bool
    """The last event: all drifts are below their limits."""


@dataclass(frozen=True, slots=True)
class PoseStarted:
    """The robot stands and is about to move to a pose."""

    state: ClassVar[RunState] = RunState.READY
    pose: PlannedPose
    number: int
    """Counted from 1, over all poses that were begun or done before."""
    n_poses: int
    """As many as there will be, appended ones and repetitions included."""


@dataclass(frozen=True, slots=True, eq=False)
class Moving:
    """One reading under way; a command given here acts at once."""

    state: ClassVar[RunState] = RunState.MOVING
    pose_id: str
    joints_rad: FloatArray | None
    remaining_rad: float | None
    """Largest axis distance to the next target."""


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """The robot has arrived."""

    state: ClassVar[RunState] = RunState.SETTLING
    pose_id: str
    joints_rad: FloatArray | None
    seconds: float


@dataclass(frozen=True, slots=True)
class Settled:
    """The robot stands still."""

    state: ClassVar[RunState] = RunState.CAPTURING
    pose_id: str
    stillness_rad: float
    """Largest axis movement seen in the settling time."""
    seconds: float


@dataclass(frozen=True, slots=True)
class Retried:
    """An exposure failed and is tried once more."""

    state: ClassVar[RunState] = RunState.CAPTURING
    pose_id: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Captured:
    """A shot is on disk."""

    state: ClassVar[RunState] = RunState.READY
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

    state: ClassVar[RunState] = RunState.READY
    pose_id: str
    reason: str
    shot: Shot
    """As recorded, with its scan where there is one."""
    xyz_mm: NDArray[np.float32] | None


@dataclass(frozen=True, slots=True)
class Skipped:
    """A pose was left out by command."""

    state: ClassVar[RunState] = RunState.READY
    pose_id: str
    shot: Shot


@dataclass(frozen=True, slots=True)
class Paused:
    """The robot stands; told again and again until a Continue, Skip, Redo, Finish or Stop comes."""

    state: ClassVar[RunState] = RunState.PAUSED
    pose_id: str | None
    """The pose that was in hand."""


class Cause(StrEnum):
    """Why a run suspends itself."""

    SAFETY = "safety stop"
    """A protective, safeguard or emergency stop. It is cleared at the robot, by a person; never from here."""
    ROBOT = "robot"
    """It refuses, stands elsewhere, is late or gone."""
    CAMERA = "camera"
    """It is gone, set wrongly, or gave no frame at several poses in a row."""
    SPHERE = "sphere"
    """One sphere was not found several times in a row: did somebody take or touch it?"""
    TEMPERATURE = "temperature"
    """The camera is not as warm as it was at the first shot of the run."""
    DISK = "disk"
    """The shot in hand cannot be written: the disk is full, or a share is gone."""


@dataclass(frozen=True, slots=True, eq=False)
class Suspended:
    """Something is wrong that a person can put right; the robot stands, as far as it could be told to.

    A Continue says that it is put right (what was lost is opened again, and the pose in hand taken up), a Pause that
    somebody is at it: the event comes again. Skip, Redo, Finish and Stop do what they always do. Where nobody answers
    (None) the run ends with the error.
    """

    state: ClassVar[RunState] = RunState.PAUSED
    pose_id: str | None
    """The pose that was in hand."""
    cause: Cause
    error: SpherecalError
    """What was found and what to do."""


@dataclass(frozen=True, slots=True)
class Finished:
    """Last event; the robot stands."""

    n_ok: int
    n_failed: int
    n_skipped: int
    stopped: bool
    """Whether a Stop ended the run before its last pose."""
    n_left: int = 0
    """Poses that were not begun."""

    @property
    def state(self) -> RunState:
        """Done or aborted."""
        return RunState.ABORTED if self.stopped else RunState.DONE


Event = RunStarted | WarmingUp | PoseStarted | Moving | Moved | Settled | Retried | Captured | Failed | Skipped | Paused | Suspended | Finished


@dataclass(frozen=True, slots=True)
class Continue:
    """Go on, also after a Pause."""


@dataclass(frozen=True, slots=True)
class Skip:
    """Leave the pose in hand and go to the next one."""


@dataclass(frozen=True, slots=True)
class Redo:
    """Take the last shot's pose again, next; the new shot replaces the old one. At PoseStarted: before the pose that is about to begin."""


@dataclass(frozen=True, slots=True)
class Pause:
    """Stop the robot and wait; a Continue takes up the pose in hand from its motion on."""


@dataclass(frozen=True, slots=True)
class Stop:
    """Stop the robot and end the run; what was taken stays."""


@dataclass(frozen=True, slots=True)
class Finish:
    """It is enough: the pose in hand is finished, no other is begun, and the run is done."""


@dataclass(frozen=True, slots=True, eq=False)
class Append:
    """Take one more pose, last. Nobody has driven there before: it is approached at `CaptureSettings.first_speed_rad_s`."""

    pose: PlannedPose


Command = Continue | Skip | Redo | Pause | Stop | Finish | Append
