"""Calibrations for other programs: every format by its name, as text that states unit, frame and calibration.

    exported = export_text(calibration, "urdf")
    exported.text, exported.residual

What each format holds and cannot hold is in docs/export.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from calibrate.export_hand_eye import (
    hand_eye_csv,
    hand_eye_json,
    hand_eye_yaml,
    quaternion_yaml,
    rapid_tooldata,
    ros_transform,
    ur_pose,
    urdf_camera_joint,
)
from calibrate.export_notes import require_hand_eye
from calibrate.export_residual import Residual
from calibrate.export_tables import mdh_csv, mdh_full_csv, ur_kinematics_yaml
from calibrate.export_target_files import Target
from calibrate.export_targets import CorrectedTarget, correct_targets, targets_csv, targets_json, targets_rapid
from calibrate.export_urdf import urdf_robot
from drivers.errors import SettingsError

if TYPE_CHECKING:
    from calibrate.result import Calibration

Writer = Callable[["Calibration"], tuple[str, Residual | None]]
TargetWriter = Callable[["Calibration", tuple[CorrectedTarget, ...]], str]


@dataclass(frozen=True, slots=True, eq=False)
class Exported:
    """The text of an export and what it cannot say."""

    text: str
    residual: Residual | None = None
    """Of robot descriptions; None for the hand-eye and for targets."""
    corrected: tuple[CorrectedTarget, ...] = ()


def _hand_eye(writer: Callable[[Calibration], str]) -> Writer:
    def write(calibration: Calibration) -> tuple[str, Residual | None]:
        require_hand_eye(calibration)
        return writer(calibration), None

    return write


def _mdh(calibration: Calibration) -> tuple[str, Residual]:
    text, table = mdh_csv(calibration)
    return text, table.residual


def _mdh_full(calibration: Calibration) -> tuple[str, Residual]:
    text, table = mdh_full_csv(calibration)
    return text, table.residual


HAND_EYE_FORMATS: dict[str, Writer] = {
    "hand-eye-yaml": _hand_eye(hand_eye_yaml),
    "hand-eye-json": _hand_eye(hand_eye_json),
    "hand-eye-csv": _hand_eye(hand_eye_csv),
    "quaternion": _hand_eye(quaternion_yaml),
    "ur-pose": _hand_eye(ur_pose),
    "rapid-tooldata": _hand_eye(rapid_tooldata),
    "ros-transform": _hand_eye(ros_transform),
    "urdf-camera": _hand_eye(urdf_camera_joint),
}
"""Of every calibration."""

ROBOT_FORMATS: dict[str, Writer] = {"urdf": urdf_robot, "mdh": _mdh, "mdh-full": _mdh_full, "ur-kinematics": ur_kinematics_yaml}
"""Of calibrations that hold a robot."""

TARGET_FORMATS: dict[str, TargetWriter] = {"targets-csv": targets_csv, "targets-json": targets_json, "targets-rapid": targets_rapid}
"""Of calibrations that hold a robot, for a list of targets."""

FORMATS = (*HAND_EYE_FORMATS, *ROBOT_FORMATS, *TARGET_FORMATS)


def export_text(
    calibration: Calibration, file_format: str, *, targets: Iterable[Target] | None = None, targets_file: str | Path | None = None
) -> Exported:
    """A calibration in another format.

    Args:
        calibration: what is exported.
        file_format: one of `FORMATS`.
        targets: what is to be corrected, for the formats of targets, and for no other.
        targets_file: where they came from, for messages.

    Raises:
        SettingsError: an unknown format, targets missing or not wanted, a pose-only calibration asked for its robot, one of the
            robot alone for its hand-eye, or a robot that the format does not fit.
        DataError: a target that the corrected robot does not reach.
    """
    if file_format not in FORMATS:
        raise SettingsError(f"no export format {file_format!r}", remedy=f"Choose one of {', '.join(FORMATS)}.")
    if (targets is not None) != (file_format in TARGET_FORMATS):
        wanted = f"Add --targets FILE for {file_format}." if targets is None else f"Targets are for {', '.join(TARGET_FORMATS)}."
        raise SettingsError(f"the format {file_format} {'needs' if targets is None else 'takes no'} targets", remedy=wanted)
    if targets is not None:
        corrected = correct_targets(calibration, targets, file=targets_file)
        return Exported(TARGET_FORMATS[file_format](calibration, corrected), corrected=corrected)
    text, residual = (HAND_EYE_FORMATS | ROBOT_FORMATS)[file_format](calibration)
    return Exported(text, residual)
