"""Which shots repeat a pose: of the calibration, or of the other end of a length."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibrate.observations import SphereShot
from drivers.files.session import Session
from drivers.files.shots import Shot
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.placing import TrainingShot

_SAME_POSE_MM, _SAME_POSE_RAD = 5.0, 0.02
"""Flange poses nearer than this are the same pose of the robot, taught twice or repeated."""
_SAME_AXES_RAD = 0.01
"""Axis angles nearer than this on every axis are; the same flange pose by another branch of the arm is another pose."""


class TrainingPoint(Protocol):
    """One external reference point that a calibration was made from."""

    @property
    def reference(self) -> str:
        """Frame in which it was measured."""
        ...

    @property
    def target(self) -> str:
        """Point on the flange."""
        ...

    @property
    def point_in_reference_mm(self) -> FloatArray:
        """(3,) as measured."""
        ...

    @property
    def joints_rad(self) -> FloatArray | None:
        """(n,) where the robot stood; None where it is not known."""
        ...


def training_shots(known: Sequence[TrainingShot], sessions: Sequence[Session], points: Sequence[TrainingPoint] = ()) -> list[tuple[Session, int]]:
    """Shots (session, index) whose scans or external points a calibration was made from, wherever they lie now."""
    digests = {shot.scan_sha256 for shot in known}
    measured = {(point.reference, point.target, *point.point_in_reference_mm.tolist()) for point in points}

    def is_known(shot: Shot) -> bool:
        if shot.point_in_reference_mm is not None:
            return (shot.reference, shot.target, *shot.point_in_reference_mm.tolist()) in measured
        return shot.sha256 in digests

    return [(session, shot.index) for session in sessions for shot in session.shots if is_known(shot)]


def repeated_poses(known: Sequence[TrainingShot], sessions: Sequence[Session], points: Sequence[TrainingPoint] = ()) -> list[tuple[Session, int]]:
    """Shots (session, index) of a sphere or an external target, taken where the robot stood for one of the calibration, of either kind.

    Empty for calibrations of older versions, which did not keep their poses.
    """
    stood = [*(shot.joints_rad for shot in known), *(point.joints_rad for point in points)]
    joints = [joints_rad for joints_rad in stood if joints_rad is not None]
    flanges = [shot.base_from_flange for shot in known if shot.base_from_flange is not None]
    found = []
    for session in sessions:
        for shot in session.shots:
            if shot.status == "ok" and (shot.sphere is not None or shot.is_reference_point) and _repeats(shot, joints, flanges):
                found.append((session, shot.index))
    return found


def _repeats(shot: Shot, joints: Sequence[FloatArray], flanges: Sequence[FloatArray]) -> bool:
    if shot.joints_rad is not None and joints:
        return bool((np.abs(np.stack(joints) - shot.joints_rad).max(axis=1) < _SAME_AXES_RAD).any())
    if shot.base_from_flange is not None and flanges:
        return bool(near(shot.base_from_flange, np.stack(flanges)).any())
    return False


def same_poses(first: Sequence[SphereShot], second: Sequence[SphereShot]) -> bool:
    """Whether most shots of one end repeat a flange pose of the other."""
    poses = np.stack([shot.base_from_flange for shot in second])
    repeated = [bool(near(shot.base_from_flange, poses).any()) for shot in first]
    return float(np.mean(repeated)) > 0.5


def near(pose: FloatArray, others: FloatArray) -> NDArray[np.bool_]:
    """(m,) whether a flange pose (4, 4) is the same as others (m, 4, 4)."""
    step = np.linalg.norm(others[:, :3, 3] - pose[:3, 3], axis=1)
    turn = np.linalg.norm(se3.log_so3(np.swapaxes(others[:, :3, :3], -1, -2) @ pose[:3, :3]), axis=1)
    return np.asarray((step < _SAME_POSE_MM) & (turn < _SAME_POSE_RAD))
