"""What every exported file says of itself, and how it writes numbers and rotations.

Conventions of other people, each once: URDF and ROS roll-pitch-yaw are `RotZ(yaw) RotY(pitch) RotX(roll)`; ROS quaternions
are x y z w, RAPID's w x y z; UR poses are metres and a rotation vector.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from drivers.errors import SettingsError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from calibrate.result import Calibration

MM_PER_M = 1000.0
_MOST_CORNERS = 1024
_NOT_CALIBRATED = {
    "cell": "NOT calibrated, for no sphere was seen: it is the cell file's own",
    "none": "unknown, for no sphere was seen: this is of the robot alone",
}


def provenance(calibration: Calibration, *, unit: str, frame: str) -> tuple[str, ...]:
    """Lines that tell where an exported file comes from and what its numbers mean: one line each, ASCII."""
    robot = "none (pose-only)" if calibration.model is None else calibration.model.name
    lines = (
        f"spherecal calibration {calibration.id}",
        f"cell {calibration.cell_name}, robot {robot}, verdict {calibration.verdict}, made {calibration.created_utc}",
        f"unit: {unit}",
        f"frame: {frame}",
        f"base: {_base_text(calibration)}",
        *hand_eye_notes(calibration),
    )
    return tuple(one_line(line) for line in lines)


def one_line(text: str) -> str:
    """Text for a comment in any of the formats: no line breaks, ASCII only."""
    return " ".join(text.split()).encode("ascii", "backslashreplace").decode("ascii")


def commented(lines: tuple[str, ...], mark: str = "#") -> str:
    """Comment lines, each begun by a mark and ended by a line break."""
    return "".join(f"{mark} {line}\n" for line in lines)


def number(value: float) -> str:
    """A number with 15 digits, without the sign of zero."""
    return format(float(value) + 0.0, ".15g")


def numbers(values: ArrayLike, separator: str = ", ") -> str:
    """Numbers in a row."""
    return separator.join(number(value) for value in np.asarray(values, dtype=np.float64))


def roll_pitch_yaw_rad(rotation: FloatArray) -> FloatArray:
    """(3,) roll, pitch, yaw of a rotation (3, 3): `RotZ(yaw) RotY(pitch) RotX(roll)`, exact at pitch = +-pi/2 too.

    Yaw and roll alone are arbitrary there, so roll is read from what is left once the chosen yaw is taken out.
    """
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    left = se3.exp_so3([0.0, 0.0, -yaw]) @ rotation
    return np.array([np.arctan2(-left[1, 2], left[1, 1]), np.arctan2(-left[2, 0], left[0, 0]), yaw])


def robot_of(calibration: Calibration, what: str) -> RobotModel:
    """The robot model of a calibration.

    Raises:
        SettingsError: the calibration is pose-only.
    """
    if calibration.model is None:
        raise SettingsError(
            f"a pose-only calibration holds no robot: it cannot be exported as {what}",
            remedy="Export the hand-eye (hand-eye-yaml, ur-pose, rapid-tooldata, ...), or calibrate sessions that hold joints_rad.",
        )
    return calibration.model


def hand_eye_notes(calibration: Calibration) -> tuple[str, ...]:
    """What is to be said of a hand-eye that was not calibrated; nothing where it was."""
    return (f"hand-eye: {_NOT_CALIBRATED[calibration.hand_eye]}",) if calibration.hand_eye in _NOT_CALIBRATED else ()


def require_hand_eye(calibration: Calibration) -> None:
    """See that a calibration knows where its camera sits: one of external points alone may not, and its identity is a placeholder.

    Raises:
        SettingsError: it does not.
    """
    if calibration.hand_eye == "none":
        raise SettingsError(
            "this calibration is of the robot alone: nothing is known of where its camera sits",
            remedy="Export the robot (urdf, mdh, targets-csv, ...), or calibrate on shots of spheres too.",
        )


def seen_joints_rad(calibration: Calibration, n: int, *, seed: int = 0) -> FloatArray:
    """(k, n_axes) axis angles spread over the seen axis ranges: up to n at random, the same for the same seed, and the corners.

    Poses beyond linear limits (a parallelogram) are left out.

    Raises:
        SettingsError: the calibration is pose-only or does not say which axis ranges it saw.
    """
    model, seen = robot_of(calibration, "anything that moves its axes"), calibration.seen_joints_rad
    if seen is None:
        raise SettingsError("the calibration does not say which axis angles it saw", remedy="Calibrate again with sessions that hold joints_rad.")
    lower, upper = seen
    drawn = np.random.default_rng(seed).uniform(lower, upper, (n, model.n_joints))
    n_corners = min(2**model.n_joints, _MOST_CORNERS)
    bits = (np.arange(n_corners)[:, None] >> np.arange(model.n_joints)) & 1
    joints = np.concatenate([drawn, np.where(bits == 1, upper, lower)])
    inside = np.ones(len(joints), dtype=np.bool_)
    for limit in model.linear_limits:
        inside &= (joints @ limit.row >= limit.lower_rad) & (joints @ limit.row <= limit.upper_rad)
    return joints[inside] if inside.any() else joints


def nominal_robot_note(calibration: Calibration) -> str:
    """How far a camera moves in the base when the hand-eye is used with the uncorrected robot."""
    if calibration.model is None:
        return "to be used with the flange poses that the controller reports"
    joints = seen_joints_rad(calibration, 500)
    corrected = calibration.base_from_flange(joints) @ calibration.flange_from_camera
    nominal = mdh.base_from_flange(calibration.model, joints) @ calibration.flange_from_camera
    off_mm = np.linalg.norm(corrected[:, :3, 3] - nominal[:, :3, 3], axis=1)
    return (
        "to be used with the corrected robot of the same calibration; with the nominal robot the camera is off by "
        f"{np.sqrt((off_mm**2).mean()):.4f} mm rms, {off_mm.max():.4f} mm at most, over the seen axis ranges"
    )


def _base_text(calibration: Calibration) -> str:
    if calibration.datum.kind == "controller":
        return "the controller's own base frame"
    return f"datum {calibration.datum.kind} of the calibration"
