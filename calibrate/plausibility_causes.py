"""Likely mistakes in recorded data, each as a change that would undo it. Nothing is judged here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, product

import numpy as np

from calibrate.plausibility_rotations import rotation_causes
from calibrate.problem import IntArray
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model, shipped_models

_MOST_SHIFT = 3


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """What m shots say: where the flange was, and where in the camera frame the sphere."""

    model: RobotModel | None
    joints_rad: FloatArray | None
    """(m, n), or None for pose-only data."""
    base_from_flange: FloatArray
    """(m, 4, 4): of the nominal model where there are joints, else as reported."""
    centres_in_camera_mm: FloatArray
    """(m, 3)"""
    sphere: IntArray
    """(m,)"""
    session: IntArray
    """(m,) number of the shot's session."""
    index: IntArray
    """(m,) index of the shot in it."""

    def part(self, keep: IntArray) -> Recorded:
        """Some of the shots."""
        joints = None if self.joints_rad is None else self.joints_rad[keep]
        return Recorded(
            self.model,
            joints,
            self.base_from_flange[keep],
            self.centres_in_camera_mm[keep],
            self.sphere[keep],
            self.session[keep],
            self.index[keep],
        )


Change = Callable[[Recorded], Recorded]


@dataclass(frozen=True, slots=True)
class Cause:
    """A mistake: its name, what undoes it in the data, and what the user has to do."""

    name: str
    undo: Change
    remedy: str


def causes(data: Recorded) -> tuple[Cause, ...]:
    """Every cause that may be tried on such data, the plain ones first."""
    found = (*plain_causes(data), *_scan_causes())
    if data.model is None or data.joints_rad is None:
        return found
    # several turned axes come last: they can stand for a mirror, and a wrist has two ways to reach every pose
    return (*found, *_sign_causes(data.model.n_joints, 2, data.model.n_joints))


def plain_causes(data: Recorded) -> tuple[Cause, ...]:
    """Those that change poses or axis angles only, one thing at a time."""
    return tuple(_pose_causes() if data.model is None or data.joints_rad is None else _joint_causes(data.model))


def shifts() -> tuple[Cause, ...]:
    """The scans belong to the poses of the shots after or before them; shots without such a neighbour fall out."""
    remedy = "Pair every scan with the pose at which it was taken: a shot too many or too few at the start moves all later ones."
    found = []
    for by in (k for size in range(1, _MOST_SHIFT + 1) for k in (size, -size)):
        shots = "one shot" if abs(by) == 1 else f"{abs(by)} shots"
        found.append(Cause(f"scans and poses are shifted by {shots} (scan i belongs to the pose of shot i{by:+d})", _shifted(by), remedy))
    found.append(Cause("scans and poses are in opposite order", _reversed, remedy))
    return tuple(found)


def _joint_causes(model: RobotModel) -> Iterator[Cause]:
    degrees = "Write joints_rad in rad: the angles in degrees times pi / 180, once."
    yield Cause("the axis angles are in degrees", _joints(np.radians), degrees)
    yield Cause("the axis angles were converted from degrees to rad twice", _joints(np.degrees), degrees)
    yield from _model_causes(model)
    yield from _order_causes(model.n_joints)
    yield from _sign_causes(model.n_joints, 1, 1)
    yield from _zero_causes(model)


def _model_causes(model: RobotModel) -> Iterator[Cause]:
    yield from _coupling_causes(model)
    for name in shipped_models():
        if name != model.name and (other := load_robot_model(name)).n_joints == model.n_joints:
            yield Cause(f"the robot is a {name}, not a {model.name}", _model(other), "Name the right robot model in the cell file.")


def _order_causes(n: int) -> Iterator[Cause]:
    remedy = "Write the axis angles in the order from base to flange."
    yield Cause("the axes come in reverse order", _reordered(np.arange(n)[::-1]), remedy)
    for first, second in combinations(range(n), 2):
        order = np.arange(n)
        order[[first, second]] = second, first
        yield Cause(f"axes {first + 1} and {second + 1} are exchanged", _reordered(order), remedy)
    yield Cause("the first axis comes last", _reordered(np.roll(np.arange(n), 1)), remedy)
    yield Cause("the last axis comes first", _reordered(np.roll(np.arange(n), -1)), remedy)


def _sign_causes(n: int, fewest: int, most: int) -> Iterator[Cause]:
    """Every choice of so many turned axes, few before many."""
    remedy = "Turn the sign of that axis where the angles are recorded, or in the robot model's coupling."
    for size in range(fewest, most + 1):
        for axes in combinations(range(n), size):
            signs = np.ones(n)
            signs[list(axes)] = -1.0
            yield Cause(f"{_axes_text(axes)} with the opposite sign", _joints(partial(np.multiply, signs)), remedy)


def _zero_causes(model: RobotModel) -> Iterator[Cause]:
    remedy = "Correct theta_offset_rad of the robot model, or the zero position of that axis."
    n = model.n_joints
    for degrees_off, axis in product((90.0, -90.0, 180.0), range(n)):
        offset = np.radians(degrees_off) * np.eye(n)[axis]
        yield Cause(f"axis {axis + 1} has its zero {abs(degrees_off):.0f} degrees off", _joints(partial(np.add, offset)), remedy)
        if not np.array_equal(model.coupling, np.eye(n)):
            changed = replace(model, theta_offset_rad=model.theta_offset_rad + offset)
            yield Cause(f"theta_offset_rad of link {axis + 1} in the robot model is {abs(degrees_off):.0f} degrees off", _model(changed), remedy)


def _coupling_causes(model: RobotModel) -> Iterator[Cause]:
    remedy = "Correct coupling in the robot model: the IRB 1410 and its like have row 3 = [0, -1, 1, 0, 0, 0], most robots none."
    plain = np.eye(model.n_joints)
    if not np.array_equal(model.coupling, plain):
        yield Cause("the coupling of the robot model does not belong to these axis angles", _model(replace(model, coupling=plain)), remedy)
    if model.n_joints > 2:
        for sign, text in ((-1.0, "q_3 - q_2"), (1.0, "q_3 + q_2")):
            coupling = plain.copy()
            coupling[2, 1] = sign
            name = f"the parallelogram coupling theta_3 = {text} is missing from the robot model"
            yield Cause(name, _model(replace(model, coupling=coupling)), remedy)


def _pose_causes() -> Iterator[Cause]:
    for factor, unit in ((1000.0, "metres"), (10.0, "centimetres"), (25.4, "inches")):
        yield Cause(f"the poses are in {unit}", _poses(_scaled(factor)), f"Write the translations of base_from_flange in mm (times {factor:g}).")
    yield Cause("the poses are flange_from_base, the inverse", _poses(se3.inverse), "Invert the recorded poses.")
    yield Cause("the poses are flange_from_base in metres", _poses(lambda t: se3.inverse(_scaled(1000.0)(t))), "Write them in mm and invert them.")
    remedy = "Transpose the rotations of the recorded poses: columns are the flange's axes in the base."
    yield Cause("the rotations of the poses are transposed", _rotations(lambda r: np.swapaxes(r, -1, -2)), remedy)
    for name, change, convert in rotation_causes():
        yield Cause(name, _rotations(change), convert)


def _scan_causes() -> Iterator[Cause]:
    for factor, unit in ((1000.0, "metres"), (25.4, "inches")):
        yield Cause(f"the scans are in {unit}", _centres(partial(np.multiply, factor)), f"Write the clouds in mm (times {factor:g}).")
    remedy = "Write the clouds in a right-handed camera frame: x right, y down, z away from the camera."
    yield Cause("the scans are mirrored: their frame is left-handed", _centres(partial(np.multiply, [-1.0, 1.0, 1.0])), remedy)


def _shifted(by: int) -> Change:
    def change(data: Recorded) -> Recorded:
        row = {(int(s), int(i)): k for k, (s, i) in enumerate(zip(data.session, data.index, strict=True))}
        pairs = [(k, row[s, i + by]) for (s, i), k in row.items() if (s, i + by) in row]
        return with_poses_of(data, np.array([a for a, _ in pairs], dtype=np.int64), np.array([b for _, b in pairs], dtype=np.int64))

    return change


def _reversed(data: Recorded) -> Recorded:
    row = {(int(s), int(i)): k for k, (s, i) in enumerate(zip(data.session, data.index, strict=True))}
    last = {int(s): int(data.index[data.session == s].max()) for s in np.unique(data.session)}
    pairs = [(k, row[s, last[s] - i]) for (s, i), k in row.items() if (s, last[s] - i) in row]
    return with_poses_of(data, np.array([a for a, _ in pairs], dtype=np.int64), np.array([b for _, b in pairs], dtype=np.int64))


def with_poses_of(data: Recorded, scans: IntArray, poses: IntArray) -> Recorded:
    """The centres of some shots (rows) with the poses of others (rows)."""
    seen, moved = data.part(scans), data.part(poses)
    return replace(seen, joints_rad=moved.joints_rad, base_from_flange=moved.base_from_flange)


def _joints(change: Callable[[FloatArray], FloatArray]) -> Change:
    def apply(data: Recorded) -> Recorded:
        if data.model is None or data.joints_rad is None:
            return data
        joints = change(data.joints_rad)
        return replace(data, joints_rad=joints, base_from_flange=mdh.base_from_flange(data.model, joints))

    return apply


def _model(model: RobotModel) -> Change:
    return lambda data: data if data.joints_rad is None else replace(data, model=model, base_from_flange=mdh.base_from_flange(model, data.joints_rad))


def _poses(change: Callable[[FloatArray], FloatArray]) -> Change:
    return lambda data: replace(data, base_from_flange=change(data.base_from_flange))


def _rotations(change: Callable[[FloatArray], FloatArray]) -> Change:
    return _poses(lambda pose: se3.from_rotation_translation(change(pose[:, :3, :3]), pose[:, :3, 3]))


def _centres(change: Callable[[FloatArray], FloatArray]) -> Change:
    return lambda data: replace(data, centres_in_camera_mm=np.asarray(change(data.centres_in_camera_mm)))


def _scaled(factor: float) -> Callable[[FloatArray], FloatArray]:
    return lambda pose: se3.from_rotation_translation(pose[:, :3, :3], factor * pose[:, :3, 3])


def _reordered(order: IntArray) -> Change:
    return _joints(lambda joints: joints[:, order])


def _axes_text(axes: tuple[int, ...]) -> str:
    names = [str(i + 1) for i in axes]
    if len(names) == 1:
        return f"axis {names[0]} is recorded"
    return f"axes {', '.join(names[:-1])} and {names[-1]} are recorded"
