"""How a capture run moves, exposes and judges, and how long it will take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from acquire.cell import Cell
from acquire.motion import MotionSettings
from acquire.plan import PlannedPose
from acquire.sphere import SphereSettings


@dataclass(frozen=True, slots=True)
class CaptureSettings:
    """How a run moves, exposes and judges."""

    motion: MotionSettings = field(default_factory=MotionSettings)
    frames: int = 1
    """Exposures per pose; the scan is their mean."""
    frame_timeout_s: float = 10.0
    sphere: SphereSettings = field(default_factory=SphereSettings)
    most_errors_in_a_row: int = 3
    """So many poses in a row that the robot refuses or the camera does not see end the run with the last error."""


def settings_of(cell: Cell) -> CaptureSettings:
    """The settings that a cell file asks for."""
    motion = MotionSettings(speed_rad_s=cell.motion.speed_rad_s, settle_s=cell.motion.settle_s)
    return CaptureSettings(motion=motion, frames=cell.motion.frames)


def planned_seconds(poses: Sequence[PlannedPose], settings: CaptureSettings, exposure_s: float = 1.0) -> float:
    """About how long a run takes: motion at full speed, settling, exposures."""
    points = [point for pose in poses for point in (*pose.via_rad, pose.joints_rad)]
    way = sum(float(np.abs(b - a).max()) for a, b in pairwise(points))
    return way / settings.motion.speed_rad_s + len(poses) * (settings.motion.settle_s + settings.frames * exposure_s + 0.5)
