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

FIRST_SPEED_RAD_S = 0.1
"""Where nobody has driven before: 100 mm/s a metre from the axis, below the 250 mm/s that robots keep in manual mode."""


@dataclass(frozen=True, slots=True)
class WarmUpSettings:
    """When a camera counts as warm."""

    most_k_per_min: float = 0.3
    """Of its fastest temperature sensor, where it has one."""
    most_mm_per_min: float = 0.01
    """Of the median distance to whatever it looks at while the robot stands."""
    every_s: float = 5.0
    """Between exposures."""
    window_s: float = 60.0
    """Over which the drift is taken, and so the shortest warm-up."""
    longest_s: float = 3600.0


@dataclass(frozen=True, slots=True)
class CaptureSettings:
    """How a run moves, exposes and judges."""

    motion: MotionSettings = field(default_factory=MotionSettings)
    frames: int = 1
    """Exposures per pose; the scan is their mean."""
    frame_timeout_s: float = 10.0
    sphere: SphereSettings = field(default_factory=SphereSettings)
    most_errors_in_a_row: int = 3
    """So many poses in a row that the robot refuses or the camera does not see suspend the run."""
    most_missing_in_a_row: int | None = 3
    """So many shots in a row that should show one sphere and do not suspend the run; None never does."""
    largest_drift_k: float | None = 5.0
    """So far may a temperature of the camera be from that of the run's first shot; None for any."""
    warm_up: WarmUpSettings | None = None
    """Before the first pose; None to begin at once."""
    first_speed_rad_s: float = FIRST_SPEED_RAD_S
    """To poses that were appended: nobody has driven there before."""


def settings_of(cell: Cell) -> CaptureSettings:
    """The settings that a cell file asks for."""
    motion = MotionSettings(speed_rad_s=cell.motion.speed_rad_s, settle_s=cell.motion.settle_s)
    return CaptureSettings(
        motion=motion,
        frames=cell.motion.frames,
        most_missing_in_a_row=cell.suspend.missing_spheres,
        largest_drift_k=cell.suspend.temperature_drift_k,
    )


def planned_seconds(poses: Sequence[PlannedPose], settings: CaptureSettings, exposure_s: float = 1.0) -> float:
    """About how long a run takes: motion at full speed, settling, exposures."""
    points = [point for pose in poses for point in (*pose.via_rad, pose.joints_rad)]
    way = sum(float(np.abs(b - a).max()) for a, b in pairwise(points))
    return way / settings.motion.speed_rad_s + len(poses) * (settings.motion.settle_s + settings.frames * exposure_s + 0.5)
