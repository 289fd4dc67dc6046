"""What an exported description of a robot cannot say: its distance from the corrected robot over the seen axis ranges."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibrate.datum import ARM_MM
from calibrate.export_notes import seen_joints_rad
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from calibrate.result import Calibration

_N_POSES = 2000


@dataclass(frozen=True, slots=True)
class Residual:
    """Distances in mm, over poses in the seen axis ranges that nothing was fitted to."""

    origin_rms_mm: float
    origin_max_mm: float
    arm_rms_mm: float
    """Of points 400 mm from the flange, where work is measured."""
    arm_max_mm: float
    n_poses: int

    def text(self) -> str:
        """One line."""
        return (
            f"what this cannot express, against the corrected robot at {self.n_poses} poses in the seen axis ranges: "
            f"flange origin rms {self.origin_rms_mm:.3e} mm, max {self.origin_max_mm:.3e} mm; "
            f"{ARM_MM:.0f} mm from it rms {self.arm_rms_mm:.3e} mm, max {self.arm_max_mm:.3e} mm"
        )


def residual_of(calibration: Calibration, base_from_flange: Callable[[FloatArray], FloatArray]) -> Residual:
    """How far a description is from the corrected robot.

    Args:
        calibration: with a robot and seen axis ranges.
        base_from_flange: the description's forward kinematics, (k, n) rad to (k, 4, 4) mm.

    Raises:
        SettingsError: the calibration is pose-only or does not say which axis ranges it saw.
    """
    joints = seen_joints_rad(calibration, _N_POSES, seed=1)
    off_mm = np.linalg.norm(corners(base_from_flange(joints)) - corners(calibration.base_from_flange(joints)), axis=-1)
    origin, arm = off_mm[:, 0], off_mm[:, 1:]
    return Residual(_rms(origin), float(origin.max()), _rms(arm), float(arm.max()), len(joints))


def corners(base_from_flange: FloatArray) -> FloatArray:
    """(k, 4, 3) the flange origin and three points at the distance of the work."""
    return se3.apply(base_from_flange[:, None], np.concatenate([np.zeros((1, 3)), ARM_MM * np.eye(3)]))


def point_rows(jacobian: FloatArray, points_mm: FloatArray) -> FloatArray:
    """(k 4 3, p): motion of points (k, 4, 3) by p left twists (k, p, 6) in the base."""
    moved = jacobian[:, None, :, :3] + np.cross(jacobian[:, None, :, 3:], points_mm[:, :, None, :])
    return np.asarray(np.swapaxes(moved, 2, 3).reshape(-1, jacobian.shape[1]))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))
