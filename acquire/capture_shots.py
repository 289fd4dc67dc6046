"""What a capture run has taken: its shots on disk, which pose each is of, and what stands in place of what."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquire.exposure import Exposure
from acquire.motion import Stillness
from acquire.plan import PlannedPose
from acquire.session import SessionWriter
from drivers.files.shots import Shot
from drivers.protocols import Frame3D

FloatArray = NDArray[np.float64]


def diagnostics_of(frames: Sequence[Frame3D]) -> dict[str, float | int | str]:
    """What the last frame tells of the camera and the way to it, as the line of a shot may hold it."""
    return {name: value for name, value in frames[-1].diagnostics.items() if not isinstance(value, float) or math.isfinite(value)}


@dataclass(frozen=True, slots=True, eq=False)
class Take:
    """What there is of a pose when it is recorded; all of it None for a pose that was skipped."""

    before: Stillness | None = None
    joints_rad: FloatArray | None = None
    """(n,) of the exposure."""
    exposure: Exposure | None = None
    xyz_mm: NDArray[np.float32] | None = None
    approach: FloatArray | None = None
    """(n,) sign of the last motion of each axis."""


class ShotBook:
    """Puts shots on disk. A shot takes the place of its pose's earlier one, but no failure that of a good shot."""

    def __init__(self, writer: SessionWriter) -> None:
        self._writer = writer
        self._last_by_id: dict[str, Shot] = {shot.pose_id: shot for shot in writer.shots if shot.pose_id is not None}
        self.counts = {"ok": 0, "failed": 0, "skipped": 0}
        self.in_hand: PlannedPose | None = None
        """The pose that was begun and of which nothing is recorded yet."""
        self.last_taken: PlannedPose | None = None
        """The last one recorded, good or not."""

    def is_done(self, pose: PlannedPose) -> bool:
        """Whether there is a good shot of a pose."""
        shot = self._last_by_id.get(pose.id)
        return shot is not None and shot.status == "ok"

    def record(self, pose: PlannedPose, take: Take, *, status: str = "ok", reason: str | None = None) -> Shot:
        """Put the pose's shot on disk.

        Raises:
            FileError: the disk is full or the like.
        """
        earlier = self._last_by_id.get(pose.id)
        if earlier is not None and earlier.status == "ok" and status != "ok":
            earlier = None
        before, frames = take.before, () if take.exposure is None else take.exposure.frames
        shot = self._writer.append(
            sphere=pose.sphere,
            joints_rad=take.joints_rad,
            base_from_flange=None if before is None else before.last.base_from_flange,
            xyz_mm=take.xyz_mm,
            intensity=frames[0].intensity if len(frames) == 1 else None,
            frames_xyz_mm=[frame.xyz_mm for frame in frames] if len(frames) > 1 else (),
            status=status,
            reason=reason,
            pose_id=pose.id,
            replaces=None if earlier is None else earlier.index,
            target_joints_rad=pose.joints_rad,
            stillness_rad=None if before is None else before.stillness_rad,
            temperatures_c=frames[-1].temperatures_c if frames else None,
            approach=None if before is None else take.approach,
            extra={"diagnostics": diagnostics_of(frames)} if frames and frames[-1].diagnostics else None,
        )
        if status == "ok" or not self.is_done(pose):
            self._last_by_id[pose.id] = shot
        self.counts[status] += 1
        self.in_hand, self.last_taken = None, pose
        return shot

    def let_go(self) -> PlannedPose | None:
        """Give the pose in hand back, nothing recorded."""
        pose, self.in_hand = self.in_hand, None
        return pose

    @property
    def id_in_hand(self) -> str | None:
        """Its id."""
        return None if self.in_hand is None else self.in_hand.id
