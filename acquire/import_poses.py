"""What the numbers of a list of poses mean: units, and by which convention angles are a rotation.

What is given is taken; what is not is found out, from the sizes of the numbers and, where there are axis angles and a
robot model, by trying every convention. What stays open is an error that names the candidates, never a guess.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.errors import DataError, SettingsError
from drivers.files.pose_list import AngleUnit, LengthUnit, PoseList, RotationNumbers
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.rotations import Convention, convention_named, conventions_of, rotations_of
from drivers.kinematics.se3 import FloatArray

AGREES_RAD = np.radians(1.0)
"""A factory calibration turns the flange less than this against the nominal robot."""
FACTORY_MM = 20.0

_FULL_TURNS_RAD = 7.0
"""No robot's axis or angle is larger in rad: ABB's sixth axis counts to 400 degrees."""
_LEAST_SPREAD = 0.3
"""Axis angles that differ by less than this in every axis tell no unit: 0.3 degrees, or 0.3 rad."""
_LEAST_TURN = 1.0
"""The same for angles of rotations: tilts of a degree or two are common, and of a radian or two as well."""
_METRES_BELOW = 10.0
_SAME_RAD = 1e-6
_AGREEING_SHARE = 0.8

Explain = Callable[[RobotModel, FloatArray, FloatArray], str]
"""Says, of a model, axis angles (m, n) and poses (m, 4, 4), why they may disagree."""


@dataclass(frozen=True, slots=True)
class Meaning:
    """What the user says of the numbers; None is to be found out."""

    rotation: str | None = None
    """A convention, or a controller's make."""
    length_unit: LengthUnit | None = None
    joint_unit: AngleUnit | None = None
    angle_unit: AngleUnit | None = None
    """Of the angles of rotations."""


@dataclass(frozen=True, slots=True, eq=False)
class Understood:
    """Poses in our units."""

    joints_rad: FloatArray | None
    """(m, n)"""
    base_from_flange: FloatArray | None
    """(m, 4, 4)"""
    rotation: str | None
    """The convention's name."""
    units: dict[str, str]
    """Of what the file holds: joints, positions, angles."""
    notes: tuple[str, ...]
    """How what was not said was found out, for the user."""


def understand(poses: PoseList, model: RobotModel | None, meaning: Meaning, explain: Explain | None = None) -> Understood:
    """Bring a list of poses to mm and rad.

    Raises:
        DataError: units or convention cannot be told, poses and axis angles disagree, or the number of axes is wrong.
        SettingsError: a convention that does not fit the numbers, or contradicts the file.
    """
    notes: list[str] = []
    units: dict[str, str] = {}
    joints = _joints_rad(poses, model, meaning, notes, units)
    if poses.positions is None or poses.rotations is None:
        return Understood(joints, None, None, units, tuple(notes))
    length = meaning.length_unit or poses.position_unit or _length_unit(poses.positions, notes)
    units["positions"] = length
    expected = None if joints is None or model is None else mdh.base_from_flange(model, joints)
    convention, angle, rotation = _rotations(poses, poses.rotations, expected, meaning, notes)
    if angle is not None:
        units["angles"] = angle
    pose = se3.from_rotation_translation(rotation, poses.positions * (1000.0 if length == "m" else 1.0))
    if model is not None and joints is not None and expected is not None:
        cause = _Cause(poses, model, joints, expected, pose, explain)
        notes.append(cause.checked())
    return Understood(joints, pose, convention.name, units, tuple(notes))


def _joints_rad(poses: PoseList, model: RobotModel | None, meaning: Meaning, notes: list[str], units: dict[str, str]) -> FloatArray | None:
    if poses.joints is None:
        return None
    if model is not None and poses.joints.shape[1] != model.n_joints:
        message = f"{poses.joints.shape[1]} axes, the robot {model.name} has {model.n_joints}"
        raise DataError(message, file=poses.file, remedy="Name the columns with --columns, or the right model in the cell file.")
    unit = meaning.joint_unit or poses.joint_unit
    if unit is None:
        unit = _angle_unit(poses.joints, _FULL_TURNS_RAD, _LEAST_SPREAD)
        if unit is None:
            raise DataError("the axis angles may be in degrees or in rad", file=poses.file, remedy="Say --joint-unit deg or --joint-unit rad.")
        notes.append(f"axis angles in {unit}: the largest is {np.abs(poses.joints).max():.4g}")
    units["joints"] = unit
    return np.radians(poses.joints) if unit == "deg" else poses.joints


def _angle_unit(values: FloatArray, largest_rad: float, least_spread: float) -> AngleUnit | None:
    """What the sizes of angles tell; None where they may be either."""
    largest = np.abs(values).max()
    if largest > _FULL_TURNS_RAD:
        return "deg"
    return "rad" if largest <= largest_rad and np.ptp(values, axis=0).max() > least_spread else None


def _length_unit(positions: FloatArray, notes: list[str]) -> LengthUnit:
    largest = float(np.abs(positions).max())
    unit: LengthUnit = "m" if largest < _METRES_BELOW else "mm"
    notes.append(f"positions in {unit}: the largest number is {largest:.4g}")
    return unit


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    convention: Convention
    unit: AngleUnit | None
    rotation: FloatArray
    """(m, 3, 3)"""

    @property
    def told(self) -> str:
        return self.convention.name if self.unit is None else f"{self.convention.name} in {self.unit}"


def _rotations(
    poses: PoseList, numbers: RotationNumbers, expected: FloatArray | None, meaning: Meaning, notes: list[str]
) -> tuple[Convention, AngleUnit | None, FloatArray]:
    """The convention, the unit of its angles, and rotations (m, 3, 3)."""
    named = _named(numbers, meaning)
    candidates = _candidates(poses, numbers, named, meaning)
    if expected is not None and len(candidates) > 1:
        chosen = _fitting(poses, numbers, candidates, expected)
        notes.append(f"rotations are {chosen.told}: of {len(candidates)} readings the one that fits the axis angles")
    elif len(candidates) == 1:
        chosen = candidates[0]
        if numbers.unit is None and meaning.angle_unit is None and chosen.unit is not None:
            notes.append(f"angles of the rotations in {chosen.unit}")
    else:
        raise _open_question(poses, numbers, candidates)
    return chosen.convention, chosen.unit, chosen.rotation


def _named(numbers: RotationNumbers, meaning: Meaning) -> Convention | None:
    """The convention that the user or the file names."""
    k = numbers.numbers.shape[1]
    by_file = None if numbers.convention is None else convention_named(numbers.convention, k)
    if meaning.rotation is None:
        return by_file
    by_user = convention_named(meaning.rotation, k)
    if by_file is not None and by_user != by_file:
        message = f"the file says that its rotations are {by_file.name}, and not {by_user.name}"
        raise SettingsError(message, where="--rotation", remedy="Leave --rotation out, or name the columns anew with --columns.")
    return by_user


def _candidates(poses: PoseList, numbers: RotationNumbers, named: Convention | None, meaning: Meaning) -> list[_Candidate]:
    """Every reading that is possible so far, those that say the same of these poses counted once."""
    unit = meaning.angle_unit or numbers.unit or _angle_unit(numbers.numbers, np.pi + 0.01, _LEAST_TURN)
    found: list[_Candidate] = []
    for convention in conventions_of(numbers.numbers.shape[1]) if named is None else (named,):
        units: Sequence[AngleUnit | None] = [None] if not convention.has_angles else ["deg", "rad"] if unit is None else [unit]
        for tried in units:
            candidate = _Candidate(convention, tried, _turned(poses, numbers, convention, tried))
            if not any(_largest_rad(candidate.rotation, other.rotation) < _SAME_RAD for other in found):
                found.append(candidate)
    return found


def _turned(poses: PoseList, numbers: RotationNumbers, convention: Convention, unit: AngleUnit | None, *, in_order: bool = False) -> FloatArray:
    values = np.radians(numbers.numbers) if unit == "deg" else numbers.numbers
    if numbers.by_axis and convention.order and not in_order:
        values = values[:, list(convention.places)]
    try:
        return rotations_of(convention, values)
    except DataError as error:
        raise DataError(error.message, file=poses.file, remedy=error.remedy) from error


def _fitting(poses: PoseList, numbers: RotationNumbers, candidates: Sequence[_Candidate], expected: FloatArray) -> _Candidate:
    """The one reading that fits the robot, by itself or with a constant tool or work object."""
    wanted = expected[:, :3, :3]
    for apart in (_apart, _apart_but_for_tool, _apart_but_for_frame):
        fitting = [candidate for candidate in candidates if apart(candidate.rotation, wanted) <= AGREES_RAD]
        if len(fitting) == 1:
            return fitting[0]
        if fitting:
            names = " or ".join(candidate.told for candidate in fitting)
            remedy = "Say which with --rotation: these poses are too much alike to tell."
            raise DataError(f"the rotations may be {names}", file=poses.file, remedy=remedy)
    best = min(candidates, key=lambda candidate: _apart(candidate.rotation, wanted))
    off = np.degrees(_apart(best.rotation, wanted))
    message = f"no reading of the rotations fits the axis angles; the best, {best.told}, is {off:.1f} degrees off{_in_order(poses, numbers, wanted)}"
    raise DataError(message, file=poses.file, remedy="Check the columns, the robot model and the unit and order of the axes.")


def _in_order(poses: PoseList, numbers: RotationNumbers, wanted: FloatArray) -> str:
    """Whether columns named after axes hold the angles in the order of the turns instead."""
    if not numbers.by_axis:
        return ""
    units: tuple[AngleUnit, ...] = ("deg", "rad")
    for convention in conventions_of(3):
        for unit in units:
            if convention.order and _apart(_turned(poses, numbers, convention, unit, in_order=True), wanted) <= AGREES_RAD:
                return f" (as r1,r2,r3 in --columns, in the order of the turns, {convention.name} in {unit} fits)"
    return ""


def _apart(first: FloatArray, second: FloatArray) -> float:
    """An angle in rad that most pairs of rotations (m, 3, 3) keep."""
    angles = np.linalg.norm(se3.log_so3(np.swapaxes(first, -1, -2) @ second), axis=1)
    return float(np.quantile(angles, _AGREEING_SHARE))


def _apart_but_for_tool(first: FloatArray, second: FloatArray) -> float:
    turn = se3.nearest_rotation((np.swapaxes(first, -1, -2) @ second).mean(axis=0))
    return _apart(first @ turn, second) if len(first) > 2 else np.inf


def _apart_but_for_frame(first: FloatArray, second: FloatArray) -> float:
    turn = se3.nearest_rotation((second @ np.swapaxes(first, -1, -2)).mean(axis=0))
    return _apart(turn @ first, second) if len(first) > 2 else np.inf


def _largest_rad(first: FloatArray, second: FloatArray) -> float:
    # the distance of the matrices, without the rounding that an arc cosine has near zero
    return float(np.linalg.norm(first - second, axis=(1, 2)).max() / np.sqrt(2))


def _open_question(poses: PoseList, numbers: RotationNumbers, candidates: Sequence[_Candidate]) -> DataError:
    names = list(dict.fromkeys(candidate.convention.name for candidate in candidates))
    if len(names) == 1:
        return DataError("the angles of the rotations may be in degrees or in rad", file=poses.file, remedy="Say --angle-unit deg or rad.")
    shown = ", ".join(names)
    remedy = (
        "Name it with --rotation: the controller's make (abb, fanuc, kuka, staubli, ur, yaskawa, ...) or the convention. "
        "With axis angles and a robot model it is found out."
    )
    k = numbers.numbers.shape[1]
    return DataError(f"nothing tells by which convention {k} numbers are a rotation; possible: {shown}", file=poses.file, remedy=remedy)


@dataclass(frozen=True, slots=True, eq=False)
class _Cause:
    """Poses beside those that the axis angles make."""

    poses: PoseList
    model: RobotModel
    joints: FloatArray
    expected: FloatArray
    pose: FloatArray
    explain: Explain | None

    def checked(self) -> str:
        """What is to be said of poses that agree with the axis angles.

        Raises:
            DataError: they do not, by more than a factory calibration.
        """
        mm = float(np.median(np.linalg.norm(self.expected[:, :3, 3] - self.pose[:, :3, 3], axis=1)))
        turn = np.swapaxes(self.expected[:, :3, :3], -1, -2) @ self.pose[:, :3, :3]
        rad = float(np.median(np.linalg.norm(se3.log_so3(turn), axis=1)))
        if mm <= FACTORY_MM and rad <= AGREES_RAD:
            return f"poses and axis angles agree to {mm:.3g} mm and {np.degrees(rad):.2g} degrees (medians)"
        raise DataError(
            f"poses and axis angles disagree by {mm:.1f} mm and {np.degrees(rad):.2f} degrees (medians){self._told(mm)}",
            file=self.poses.file,
            remedy="Correct the list or what was said of it; --use joints imports the axis angles alone.",
        )

    def _told(self, mm: float) -> str:
        """Why, as far as it can be found out by trying."""
        fitting = self._fitting_conventions() if mm <= FACTORY_MM else []
        if fitting:
            return f"; they agree when the rotations are read as {' or '.join(fitting)}"
        return "" if self.explain is None else f"; {self.explain(self.model, self.joints, self.pose)}"

    def _fitting_conventions(self) -> list[str]:
        numbers = self.poses.rotations
        if numbers is None:
            return []
        candidates = _candidates(self.poses, numbers, None, Meaning())
        return [candidate.told for candidate in candidates if _apart(candidate.rotation, self.expected[:, :3, :3]) <= AGREES_RAD]
