"""Hand-eye formats: read back by others' conventions, for any rotation, half turns and gimbal lock included."""

from __future__ import annotations

import csv
import json
import shlex
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calibrate import Calibration
from calibrate.export import HAND_EYE_FORMATS, export_text
from drivers.errors import SettingsError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from tests.support.exporting import assert_same_poses, calibration_of, shipped_calibration
from tests.support.foreign_readers import Urdf, load_plain_yaml, rapid_numbers, transform_mm, ur_pose_mm


def read_matrix(data: Any) -> FloatArray:
    assert data["unit"] == "mm"
    return np.array(data["flange_from_camera"], dtype=np.float64)


def read_quaternion_xyzw(data: Any, translation_per_mm: float, translation: Any) -> FloatArray:
    assert set(data) == set("wxyz")
    return transform_mm(Rotation.from_quat([data[c] for c in "xyzw"]), [translation[c] for c in "xyz"], per_mm=translation_per_mm)


def read_quaternion(text: str) -> FloatArray:
    data: Any = load_plain_yaml(text)
    return read_quaternion_xyzw(data["quaternion"], 1.0, data["translation_mm"])


def read_csv(text: str) -> FloatArray:
    return np.array([[float(cell) for cell in row] for row in csv.reader(line for line in text.splitlines() if not line.startswith("#"))])


def read_tooldata(text: str) -> FloatArray:
    (line,) = [line for line in text.splitlines() if not line.startswith("!")]
    assert line.startswith("PERS tooldata tCamera:=[TRUE,[[")
    assert line.endswith("]];")
    x, y, z, q1, q2, q3, q4, *load = rapid_numbers(line)
    assert load == [0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0]
    return transform_mm(Rotation.from_quat([q2, q3, q4, q1]), [x, y, z])


def read_ros(text: str) -> FloatArray:
    data: Any = load_plain_yaml(text)
    assert (data["header"]["frame_id"], data["child_frame_id"]) == ("flange", "camera")
    return read_quaternion_xyzw(data["transform"]["rotation"], 1e-3, data["transform"]["translation"])


def read_ros_command(text: str) -> FloatArray:
    (command,) = [line for line in text.splitlines() if "static_transform_publisher" in line]
    words = shlex.split(command)
    given_ = {words[i].lstrip("-"): words[i + 1] for i in range(len(words) - 1) if words[i].startswith("--")}
    quaternion = [float(given_[f"q{c}"]) for c in "xyzw"]
    return transform_mm(Rotation.from_quat(quaternion), [float(given_[c]) for c in "xyz"], per_mm=1e-3)


READERS: list[tuple[str, Callable[[str], FloatArray]]] = [
    ("hand-eye-yaml", lambda text: read_matrix(load_plain_yaml(text))),
    ("hand-eye-json", lambda text: read_matrix(json.loads(text))),
    ("hand-eye-csv", read_csv),
    ("hand-eye-yaml", read_quaternion),
    ("quaternion", read_quaternion),
    ("ur-pose", ur_pose_mm),
    ("rapid-tooldata", read_tooldata),
    ("ros-transform", read_ros),
    ("ros-transform", read_ros_command),
    ("urdf-camera", lambda text: Urdf(text).pose_mm("camera", {})),
]

UNIT = st.floats(-1, 1)
VECTOR = st.tuples(UNIT, UNIT, UNIT).filter(lambda v: np.linalg.norm(v) > 1e-3)
# half turns to the last digit, and a little less, are where rotation vectors and quaternions change their sign
ANGLE = st.one_of(st.floats(0, np.pi), st.sampled_from([0.0, 1e-9, np.pi, np.pi - 1e-12, np.pi - 1e-8, np.pi - 1e-5]))
# and pitch of a quarter turn is where roll and yaw are one
RPY = st.tuples(st.floats(-np.pi, np.pi), st.sampled_from([np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, -np.pi / 2 + 1e-7]), st.floats(-np.pi, np.pi))
ROTATION = st.one_of(
    st.builds(lambda v, angle: Rotation.from_rotvec(np.array(v) / np.linalg.norm(v) * angle), VECTOR, ANGLE),
    st.builds(lambda rpy: Rotation.from_euler("xyz", rpy), RPY),
)
TRANSFORM = st.builds(lambda rotation, v: transform_mm(rotation, np.array(v) * 500), ROTATION, st.tuples(UNIT, UNIT, UNIT))


@pytest.mark.parametrize(("name", "read"), READERS, ids=lambda value: value if isinstance(value, str) else "")
@given(transform=TRANSFORM)
@example(transform=transform_mm(Rotation.from_rotvec([np.pi, 0, 0]), [1e-7, -0.0, 250]))
@example(transform=transform_mm(Rotation.from_rotvec([0, 0, -np.pi]), [0, 0, 0]))
@example(transform=transform_mm(Rotation.identity(), [1e-12, 0, 1234.56789012345]))
def test_a_format_is_read_back_by_its_own_convention(name: str, read: Callable[[str], FloatArray], transform: FloatArray) -> None:
    calibration = calibration_of(None, flange_from_camera=transform)
    assert_same_poses(read(export_text(calibration, name).text), transform)


def test_every_format_has_a_reader() -> None:
    assert {name for name, _ in READERS} == set(HAND_EYE_FORMATS)


@pytest.fixture(params=["robot", "pose-only"])
def either(request: pytest.FixtureRequest) -> Calibration:
    return shipped_calibration("abb_irb1410") if request.param == "robot" else calibration_of(None)


@pytest.mark.parametrize("name", HAND_EYE_FORMATS)
def test_every_format_says_unit_frame_and_calibration(name: str, either: Calibration) -> None:
    text = export_text(either, name).text
    assert either.id in text
    assert "unit" in text
    assert "pose of the camera frame in the flange frame" in text
    assert either.verdict in text
    assert text.isascii()
    assert text.endswith("\n")


def test_what_is_to_be_filled_is_marked() -> None:
    assert "TO BE FILLED" in export_text(calibration_of(None), "rapid-tooldata").text


def test_the_note_tells_what_the_nominal_robot_would_cost() -> None:
    """A hand-eye belongs to its robot: the note's figure is that of cameras placed by hand."""
    calibration = shipped_calibration("abb_irb1410")
    (note,) = [line for line in export_text(calibration, "hand-eye-csv").text.splitlines() if "nominal robot the camera" in line]
    said_mm = float(note.split("off by ")[1].split()[0])
    assert calibration.model is not None
    rng = np.random.default_rng(0)
    seen = calibration.seen_joints_rad
    assert seen is not None
    from drivers.kinematics import mdh

    joints = rng.uniform(seen[0], seen[1], size=(4000, 6))
    joints = joints[mdh.within_limits(calibration.model, joints)]
    off = (calibration.base_from_flange(joints) - mdh.base_from_flange(calibration.model, joints)) @ calibration.flange_from_camera
    assert said_mm == pytest.approx(np.sqrt((off[:, :3, 3] ** 2).sum(axis=1).mean()), rel=0.2)
    assert "flange poses that the controller reports" in export_text(calibration_of(None), "hand-eye-csv").text
    assert se3.is_rigid(calibration.flange_from_camera)


@pytest.mark.parametrize("name", HAND_EYE_FORMATS)
def test_a_hand_eye_that_nobody_knows_is_refused_and_one_of_the_cell_file_says_so(name: str) -> None:
    """Of external points alone the file holds the identity as a placeholder: nobody may take it for a tool."""
    of_robot = shipped_calibration("ur5e")
    with pytest.raises(SettingsError, match="of the robot alone"):
        export_text(replace(of_robot, hand_eye="none"), name)
    assert "NOT calibrated" in export_text(replace(of_robot, hand_eye="cell"), name).text
    assert "NOT calibrated" not in export_text(of_robot, name).text


def test_a_robot_whose_camera_nobody_knows_is_exported_without_one() -> None:
    of_robot = replace(shipped_calibration("ur5e"), hand_eye="none")
    assert 'link name="camera"' not in export_text(of_robot, "urdf").text
    data: Any = load_plain_yaml(export_text(of_robot, "ur-kinematics").text)
    assert data["spherecal"]["tool0_from_camera"] is None
