"""What numbers mean: every convention is found out from the axis angles, or asked for; nothing is guessed."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from acquire.import_poses import Meaning, Understood, understand
from calibrate.plausibility import likely_cause
from drivers.errors import DataError, SettingsError
from drivers.files.pose_list import AngleUnit, PoseLabel, PoseList, RotationNumbers
from drivers.kinematics import mdh, se3
from drivers.kinematics.inverse import all_branches
from drivers.kinematics.rotations import CONVENTIONS, Convention, rotations_of
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model

ROBOTS = ("ur5e", "abb_irb1410")
ANGLES = [c for c in CONVENTIONS if c.order]
UNITS: tuple[AngleUnit, ...] = ("deg", "rad")


def joints_of(n: int = 12, seed: int = 5) -> FloatArray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 6))


def poses_of(robot: str, joints: FloatArray) -> FloatArray:
    return mdh.base_from_flange(load_robot_model(robot), joints)


def numbers_of(convention: Convention, rotation: FloatArray) -> FloatArray:
    """What SciPy makes of rotations."""
    scipy = Rotation.from_matrix(rotation)
    if convention.order:
        sequence = convention.order if convention.kind == "fixed" else convention.order.upper()
        return np.asarray(scipy.as_euler(sequence))  # type: ignore[call-overload]
    if convention.kind == "rotation-vector":
        return np.asarray(scipy.as_rotvec())
    if convention.kind == "matrix":
        return rotation.reshape(-1, 9)
    xyzw = np.asarray(scipy.as_quat())
    return xyzw if convention.kind == "quaternion-xyzw" else np.roll(xyzw, 1, axis=1)


def listed(
    poses: FloatArray | None = None,
    rotations: RotationNumbers | None = None,
    joints: FloatArray | None = None,
    joint_unit: AngleUnit | None = None,
) -> PoseList:
    n = len(joints) if joints is not None else 0 if poses is None else len(poses)
    labels = tuple(PoseLabel(f"line {i + 2}") for i in range(n))
    return PoseList("poses.csv", "table", labels, joints, joint_unit, None if poses is None else poses[:, :3, 3], None, rotations)


def same(found: Understood, poses: FloatArray, tolerance: float = 1e-9) -> bool:
    return found.base_from_flange is not None and bool(np.abs(found.base_from_flange - poses).max() < tolerance)


@pytest.mark.parametrize("convention", CONVENTIONS, ids=lambda c: c.name)
@pytest.mark.parametrize("robot", ROBOTS)
def test_the_axis_angles_tell_every_convention(convention: Convention, robot: str) -> None:
    joints = joints_of()
    poses = poses_of(robot, joints)
    numbers = numbers_of(convention, poses[:, :3, :3])
    model = load_robot_model(robot)
    # in the order of the turns, in deg and rad; and in columns named after axes
    for unit in UNITS if convention.has_angles else UNITS[1:]:
        written = RotationNumbers(np.degrees(numbers) if unit == "deg" else numbers)
        found = understand(listed(poses, written, joints), model, Meaning())
        assert same(found, poses)
        assert found.units.get("angles") == (unit if convention.has_angles else None)
    if convention.order and len(set(convention.order)) == 3:
        by_axis = np.empty_like(numbers)
        by_axis[:, list(convention.places)] = numbers
        assert same(understand(listed(poses, RotationNumbers(by_axis, by_axis=True), joints), model, Meaning()), poses)


@pytest.mark.parametrize("convention", CONVENTIONS, ids=lambda c: c.name)
def test_a_name_is_enough_without_axis_angles(convention: Convention) -> None:
    poses = poses_of("ur5e", joints_of())
    written = RotationNumbers(numbers_of(convention, poses[:, :3, :3]))
    assert same(understand(listed(poses, written), None, Meaning(rotation=convention.name)), poses)


@pytest.mark.parametrize("robot", ROBOTS)
def test_rounding_and_a_factory_calibration_do_not_hide_the_convention(robot: str) -> None:
    joints = joints_of()
    poses = poses_of(robot, joints)
    rng = np.random.default_rng(1)
    real = poses @ se3.exp(np.concatenate([rng.normal(0, 1.0, (len(joints), 3)), rng.normal(0, 2e-3, (len(joints), 3))], axis=1))
    for convention in (Convention("fixed", "xyz"), Convention("moving", "xyz"), Convention("rotation-vector"), Convention("moving", "zyz")):
        degrees = np.degrees(numbers_of(convention, real[:, :3, :3])).round(2)
        found = understand(listed(real.round(1), RotationNumbers(degrees), joints), load_robot_model(robot), Meaning())
        assert found.base_from_flange is not None
        np.testing.assert_allclose(found.base_from_flange[:, :3, :3], rotations_of(convention, np.radians(degrees)), atol=1e-12)
        assert any("agree to" in note for note in found.notes)


@pytest.mark.parametrize("robot", ROBOTS)
def test_units_are_told_by_size(robot: str) -> None:
    joints = joints_of()
    poses = poses_of(robot, joints)
    metres = poses.copy()
    metres[:, :3, 3] /= 1000
    vector = RotationNumbers(numbers_of(Convention("rotation-vector"), poses[:, :3, :3]), convention="rotation-vector")
    found = understand(listed(metres, vector, np.degrees(joints)), load_robot_model(robot), Meaning())
    assert same(found, poses)
    assert found.joints_rad is not None
    np.testing.assert_allclose(found.joints_rad, joints)
    assert found.units == {"joints": "deg", "positions": "m", "angles": "rad"}


def test_what_may_be_either_is_asked_for() -> None:
    little = joints_of() * 0.1
    with pytest.raises(DataError, match="in degrees or in rad"):
        understand(listed(joints=little), load_robot_model("ur5e"), Meaning())
    for unit in UNITS:
        found = understand(listed(joints=little), load_robot_model("ur5e"), Meaning(joint_unit=unit))
        np.testing.assert_allclose(found.joints_rad, np.radians(little) if unit == "deg" else little)  # type: ignore[arg-type]
    poses = poses_of("ur5e", joints_of())
    with pytest.raises(DataError, match="angles of the rotations may be in degrees or in rad"):
        understand(listed(poses, RotationNumbers(0.01 * joints_of()[:, :3])), None, Meaning(rotation="kuka"))


def test_without_axis_angles_the_candidates_are_named() -> None:
    poses = poses_of("ur5e", joints_of())
    angles = RotationNumbers(numbers_of(Convention("fixed", "xyz"), poses[:, :3, :3]))
    with pytest.raises(DataError, match=r"3 numbers are a rotation; possible: fixed-xyx, fixed-xyz, .*rotation-vector") as caught:
        understand(listed(poses, angles), load_robot_model("ur5e"), Meaning())
    assert "--rotation" in str(caught.value.remedy)
    four = RotationNumbers(numbers_of(Convention("quaternion-wxyz"), poses[:, :3, :3]))
    with pytest.raises(DataError, match="4 numbers are a rotation; possible: quaternion-wxyz, quaternion-xyzw"):
        understand(listed(poses, four), None, Meaning())


def test_poses_that_are_too_much_alike_to_tell_are_named_with_their_candidates() -> None:
    """Turns of a few degrees about all axes: two orders of them differ by less than a factory calibration."""
    model = load_robot_model("ur5e")
    angles = np.radians(np.random.default_rng(3).uniform(-5, 5, (8, 3)))
    poses = se3.from_rotation_translation(rotations_of(Convention("fixed", "xyz"), angles), [-400.0, 100.0, 300.0])
    joints = np.array([all_branches(model, pose)[0] for pose in poses])
    with pytest.raises(DataError, match=r"the rotations may be .*fixed-xyz in deg or .*moving-xyz in deg") as caught:
        understand(listed(poses, RotationNumbers(np.degrees(angles)), joints), model, Meaning(joint_unit="rad"))
    assert "--rotation" in str(caught.value.remedy)
    assert same(understand(listed(poses, RotationNumbers(np.degrees(angles)), joints), model, Meaning("yaskawa", joint_unit="rad")), poses, 1e-6)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_convention_that_is_named_is_checked(robot: str) -> None:
    joints = joints_of()
    poses = poses_of(robot, joints)
    angles = RotationNumbers(numbers_of(Convention("moving", "xyz"), poses[:, :3, :3]))
    with pytest.raises(DataError, match=r"disagree by 0\.0 mm and .* degrees \(medians\); they agree when .* read as (moving-xyz|fixed-zyx) in rad"):
        understand(listed(poses, angles, joints), load_robot_model(robot), Meaning(rotation="fanuc"), likely_cause)


def test_columns_named_after_axes_that_hold_the_order_of_the_turns_are_seen() -> None:
    joints = joints_of()
    poses = poses_of("ur5e", joints)
    abc = RotationNumbers(np.degrees(numbers_of(Convention("moving", "zyx"), poses[:, :3, :3])), by_axis=True)
    with pytest.raises(DataError, match=r"no reading of the rotations fits .*as r1,r2,r3 in --columns, in the order of the turns, .* in deg fits"):
        understand(listed(poses, abc, joints), load_robot_model("ur5e"), Meaning())


@pytest.mark.parametrize("side", ["tool", "work object"])
def test_an_active_tool_or_work_object_is_named(side: str) -> None:
    joints = joints_of()
    offset = se3.exp([30.0, -20, 150, 0.3, 0.5, -0.7])
    poses = poses_of("ur5e", joints) @ offset if side == "tool" else offset @ poses_of("ur5e", joints)
    for convention in (Convention("fixed", "xyz"), Convention("quaternion-xyzw")):
        numbers = RotationNumbers(numbers_of(convention, poses[:, :3, :3]))
        with pytest.raises(DataError, match=f"most likely an active {side}"):
            understand(listed(poses, numbers, joints), load_robot_model("ur5e"), Meaning(), likely_cause)


def test_other_mistakes_are_named_too() -> None:
    joints = joints_of()
    poses = poses_of("ur5e", joints)
    vector = RotationNumbers(numbers_of(Convention("rotation-vector"), poses[:, :3, :3]), convention="rotation-vector")
    model = load_robot_model("ur5e")
    with pytest.raises(DataError, match="most likely the axes come in reverse order"):
        understand(listed(poses, vector, joints[:, ::-1]), model, Meaning(), likely_cause)
    with pytest.raises(DataError, match="7 axes, the robot ur5e has 6"):
        understand(listed(poses, vector, np.hstack([joints, joints[:, :1]])), model, Meaning())
    with pytest.raises(SettingsError, match="the file says that its rotations are rotation-vector, and not fixed-xyz"):
        understand(listed(poses, vector, joints), model, Meaning(rotation="fanuc"))
    broken = RotationNumbers(np.full((len(poses), 4), 0.4), convention="quaternion-wxyz")
    with pytest.raises(DataError, match=re.escape("the quaternion of row 1 has length 0.8, not 1")):
        understand(listed(poses, broken), None, Meaning())
