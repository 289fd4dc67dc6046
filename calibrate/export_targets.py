"""Corrected targets: axis angles with which the real robot goes where the nominal one was meant to go.

Controllers cannot take link twists; they can take other axis angles. A target is a pose of the flange in the base, given as such or as
the axis angles of the nominal robot; its correction is the inverse kinematics of the calibrated robot, nearest to the nominal angles.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calibrate.datum import ARM_MM
from calibrate.export_notes import commented, number, numbers, provenance, robot_of
from calibrate.export_target_files import Target, json_data
from drivers.errors import DataError, SettingsError
from drivers.kinematics import mdh, se3
from drivers.kinematics.inverse import all_branches, inverse_near
from drivers.kinematics.jacobian import joint_jacobian
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from calibrate.result import Calibration

FRAME = "axis angles as the controller reports and takes them; poses of the flange (tool0) in the base (wobj0)"
LARGE_CHANGE_RAD = 0.05
"""A correction of mm and mrad changes axes by more than this only near singular poses: look before you move."""
LARGEST_CHANGE_RAD = 0.5
"""Beyond this it is another posture of the arm and no correction."""
_ARRIVED_MM, _ARRIVED_RAD = 1e-7, 1e-10
_ROUNDS = 20
_QUADRANT_MARGIN_RAD = np.radians(0.5)
_QUADRANT_AXES = (0, 3, 5)


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedTarget:
    """A target and the axis angles that reach it in truth."""

    target: Target
    base_from_flange: FloatArray
    """(4, 4) the nominal pose, which the real robot takes at `joints_rad`."""
    nominal_joints_rad: FloatArray
    joints_rad: FloatArray
    uncorrected_mm: float
    """By how much the real flange would miss with the nominal angles."""
    in_seen_range: bool
    """Whether the calibration saw such axis angles; beyond them a correction is a guess."""

    @property
    def largest_change_rad(self) -> float:
        """Of any axis; large near singular poses."""
        return float(np.abs(self.joints_rad - self.nominal_joints_rad).max())


def correct_targets(calibration: Calibration, targets: Iterable[Target], *, file: str | Path | None = None) -> tuple[CorrectedTarget, ...]:
    """Corrected axis angles of targets, in their order.

    A flange pose without angles takes the branch that its quadrants name, nearest to the target before it (the first: to the
    middle of the seen axis ranges).

    Raises:
        SettingsError: the calibration is pose-only.
        DataError: a target is out of reach or outside limits; `file` and its place are named.
    """
    model = robot_of(calibration, "corrected targets")
    near = _middle(calibration, model)
    corrected = []
    for target in targets:
        try:
            corrected.append(_correct(calibration, model, target, near))
        except DataError as error:
            raise DataError(f"target {target.name}: {error.message}", file=file, where=target.where, remedy=error.remedy) from error
        near = corrected[-1].nominal_joints_rad
    return tuple(corrected)


def targets_csv(calibration: Calibration, corrected: tuple[CorrectedTarget, ...]) -> str:
    """CSV: name, corrected angles, and what was changed. `parse_targets` refuses it: nothing is to be corrected twice."""
    n = robot_of(calibration, "corrected targets").n_joints
    head = ["name", *(f"joint{i + 1}_rad" for i in range(n)), "uncorrected_mm", "largest_change_rad", "in_seen_range"]
    lines = [",".join(head)]
    for c in corrected:
        values = [*map(number, c.joints_rad), f"{c.uncorrected_mm:.6f}", f"{c.largest_change_rad:.9f}", str(c.in_seen_range).lower()]
        lines.append(",".join([_csv_name(c.target.name), *values]))
    return commented(provenance(calibration, unit="rad, mm", frame=FRAME)) + "\n".join(lines) + "\n"


def targets_json(calibration: Calibration, corrected: tuple[CorrectedTarget, ...]) -> str:
    """JSON: the same figures; the target's nominal pose is not repeated."""
    head = {"calibration": calibration.id, "verdict": calibration.verdict, "unit": "rad, mm", "frame": FRAME}
    rows: list[dict[str, object]] = [
        {
            "name": c.target.name,
            "joints_rad": c.joints_rad.tolist(),
            "uncorrected_mm": c.uncorrected_mm,
            "largest_change_rad": c.largest_change_rad,
            "in_seen_range": c.in_seen_range,
        }
        for c in corrected
    ]
    return json_data(head, rows)


def targets_rapid(calibration: Calibration, corrected: tuple[CorrectedTarget, ...]) -> str:
    """RAPID jointtargets in degrees, names and external axes kept.

    Raises:
        SettingsError: the robot has other than six axes, or a name is no RAPID identifier.
    """
    if robot_of(calibration, "corrected targets").n_joints != 6:
        raise SettingsError("RAPID jointtargets are for robots with six axes", remedy="Export targets-csv or targets-json.")
    notes = (*provenance(calibration, unit="degrees", frame=FRAME), "for MoveAbsJ: MoveJ and MoveL to robtargets do not use these angles")
    lines = [_rapid_line(c) for c in corrected]
    return commented(notes, "!") + "".join(lines)


def _rapid_line(c: CorrectedTarget) -> str:
    name = c.target.name
    if not (name.isascii() and name.isidentifier() and name[0].isalpha() and len(name) <= 32):
        raise SettingsError(f"{name!r} is no name that RAPID takes", where=c.target.where, remedy="Use up to 32 letters, digits and underscores.")
    external = ",".join("9E9" if value == 9e9 else number(value) for value in c.target.external)
    remark = "" if c.in_seen_range else "! outside the axis ranges that the calibration saw\n"
    return f"{remark}CONST jointtarget {name}:=[[{numbers(np.degrees(c.joints_rad), ',')}],[{external}]];\n"


def _csv_name(name: str) -> str:
    return '"' + name.replace('"', '""') + '"' if set(name) & set(',"\r\n#') else name


def _correct(calibration: Calibration, model: RobotModel, target: Target, near: FloatArray) -> CorrectedTarget:
    nominal = _nominal_joints(model, target, near)
    pose = mdh.base_from_flange(model, nominal) if target.joints_rad is not None else np.asarray(target.base_from_flange)
    joints = _solve(calibration, model, pose, nominal)
    _refuse_other_posture(joints - nominal)
    seen = calibration.seen_joints_rad
    miss_mm = float(np.linalg.norm(calibration.base_from_flange(nominal)[:3, 3] - pose[:3, 3]))
    in_range = seen is not None and bool(((joints >= seen[0]) & (joints <= seen[1])).all())
    return CorrectedTarget(target, pose, nominal, joints, miss_mm, in_range)


def _solve(calibration: Calibration, model: RobotModel, pose: FloatArray, nominal: FloatArray) -> FloatArray:
    """Axis angles of the calibrated robot, whatever it consists of: beside the nominal ones, or else the nearest there are."""
    beside = _newton(calibration, model, pose, nominal)
    if beside is not None and mdh.within_limits(model, beside):
        return beside
    # the inverse knows limits and other postures, of link twists alone; Newton takes what else bends the robot from there
    found = inverse_near(model, se3.inverse(calibration.datum.base_from_solver) @ pose, nominal, calibration.link_twists)
    joints = _newton(calibration, model, pose, found)
    if joints is None or not mdh.within_limits(model, joints):
        remedy = "Move the target away from limits and singular poses."
        raise DataError("the corrected robot does not reach the pose within its limits", remedy=remedy)
    return joints


def _newton(calibration: Calibration, model: RobotModel, pose: FloatArray, joints_rad: FloatArray) -> FloatArray | None:
    """Axis angles that reach a pose to rounding, by Newton steps from some that nearly do; None where there are none beside them."""
    joints = joints_rad.copy()
    weight = np.array([1.0, 1, 1, ARM_MM, ARM_MM, ARM_MM])
    for _ in range(_ROUNDS):
        flange = calibration.base_from_flange(joints)
        miss = se3.log(se3.inverse(flange) @ pose)
        if np.abs(miss[:3]).max() < _ARRIVED_MM and np.abs(miss[3:]).max() < _ARRIVED_RAD:
            return joints
        in_solver = se3.inverse(calibration.datum.base_from_solver) @ flange
        jacobian = se3.adjoint(se3.inverse(in_solver)) @ joint_jacobian(model, joints, calibration.link_twists)
        step = np.linalg.lstsq(weight[:, None] * jacobian, weight * miss, rcond=1e-8)[0]
        if np.abs(joints + step - joints_rad).max() > LARGEST_CHANGE_RAD:
            return None
        joints = joints + step
    return None


def _refuse_other_posture(change_rad: FloatArray) -> None:
    axis = int(np.argmax(np.abs(change_rad)))
    if abs(change_rad[axis]) > LARGEST_CHANGE_RAD:
        raise DataError(
            f"the corrected robot reaches the pose only in another posture (axis {axis + 1} {np.degrees(change_rad[axis]):+.0f} degrees)",
            remedy="The target is at a singular pose (arm stretched, or wrist axes in line): move it by some mm or degrees.",
        )


def _nominal_joints(model: RobotModel, target: Target, near: FloatArray) -> FloatArray:
    if target.joints_rad is not None:
        return target.joints_rad
    pose = np.asarray(target.base_from_flange)
    if target.near_joints_rad is not None:
        return inverse_near(model, pose, target.near_joints_rad)
    if target.quadrants is None:
        return inverse_near(model, pose, near)
    branches = all_branches(model, pose)
    if not len(branches):
        return inverse_near(model, pose, near)
    fitting = branches[[_in_quadrants(q, target.quadrants) for q in branches]]
    if not len(fitting):
        found = ", ".join(str(list(_quadrants(q))) for q in branches)
        raise DataError(
            f"no solution in the quadrants cf1, cf4, cf6 = {list(target.quadrants)} (there are {found})",
            remedy="Correct confdata, or give the target as a jointtarget.",
        )
    return np.asarray(fitting[np.argmin(np.abs(fitting - near).max(axis=-1))])


def _quadrants(joints_rad: FloatArray) -> tuple[int, ...]:
    return tuple(int(np.floor(joints_rad[i] / (np.pi / 2))) for i in _QUADRANT_AXES)


def _in_quadrants(joints_rad: FloatArray, quadrants: tuple[int, int, int]) -> bool:
    """Whether axes 1, 4 and 6 stand in quadrants, half a degree of grace at their borders."""
    middle = (np.array(quadrants) + 0.5) * np.pi / 2
    return bool((np.abs(joints_rad[list(_QUADRANT_AXES)] - middle) <= np.pi / 4 + _QUADRANT_MARGIN_RAD).all())


def _middle(calibration: Calibration, model: RobotModel) -> FloatArray:
    seen = calibration.seen_joints_rad
    return np.zeros(model.n_joints) if seen is None else np.asarray(seen.mean(axis=0))
