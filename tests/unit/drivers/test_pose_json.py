"""Poses from JSON read as the same numbers in a table do, however nested; whatever else is JSON is an error of ours."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drivers.errors import FileError
from drivers.files.pose_list import PoseList
from drivers.files.poses import parse_poses

JOINTS = [[10.5, -20.25, 30.0, 40.0, 50.5, 60.75], [11.0, -21.0, 31.0, 41.0, 51.0, 61.0]]
PLACES = [[1000.5, -200.25, 300.0], [900.0, 10.0, 400.5]]
TURNS = Rotation.from_rotvec([[0.1, -0.2, 0.3], [0.5, 0.4, -0.1]])
MATRICES = np.tile(np.eye(4), (2, 1, 1))
MATRICES[:, :3, :3], MATRICES[:, :3, 3] = TURNS.as_matrix(), PLACES
WXYZ = TURNS.as_quat(scalar_first=True)


def read(found: Any) -> PoseList:
    return parse_poses(found if isinstance(found, str) else json.dumps(found), file="poses.json")


def each(make: Any) -> list[Any]:
    return [make(i) for i in range(2)]


WITH_QUATERNION: dict[str, Any] = {
    "flat": each(lambda i: {"x": PLACES[i][0], "y": PLACES[i][1], "z": PLACES[i][2], **dict(zip(("qw", "qx", "qy", "qz"), WXYZ[i], strict=True))}),
    "as ROS writes it": {
        "poses": each(
            lambda i: {
                "pose": {
                    "position": dict(zip("xyz", PLACES[i], strict=True)),
                    "orientation": dict(zip("xyzw", WXYZ[i][[1, 2, 3, 0]], strict=True)),
                }
            }
        )
    },
    "lists with units": each(lambda i: {"position_mm": PLACES[i], "quaternion_xyzw": WXYZ[i][[1, 2, 3, 0]].tolist()}),
    "by name": dict(zip("AB", each(lambda i: {"translation": PLACES[i], "quaternion_wxyz": WXYZ[i].tolist()}), strict=True)),
}


@pytest.mark.parametrize("shape", WITH_QUATERNION)
def test_positions_and_quaternions_are_found_however_they_are_nested(shape: str) -> None:
    found = read(WITH_QUATERNION[shape])
    assert found.positions is not None
    assert found.rotations is not None
    np.testing.assert_array_equal(found.positions, PLACES)
    np.testing.assert_array_equal(found.rotations.numbers, WXYZ)
    assert found.rotations.convention == "quaternion-wxyz"
    assert found.position_unit == ("mm" if "units" in shape else None)
    assert [label.name for label in found.labels] == (["A", "B"] if shape == "by name" else [None, None])


@pytest.mark.parametrize("matrix", [MATRICES.tolist(), [m.ravel().tolist() for m in MATRICES]])
@pytest.mark.parametrize("named", [True, False])
def test_transforms_are_found(matrix: list[Any], *, named: bool) -> None:
    found = read([{"scan": f"{i}.ply", "base_from_flange": m} for i, m in enumerate(matrix)] if named else matrix)
    assert found.positions is not None
    assert found.rotations is not None
    np.testing.assert_array_equal(found.positions, PLACES)
    np.testing.assert_array_equal(found.rotations.numbers, MATRICES[:, :3, :3].reshape(2, 9))
    assert found.labels[1].cloud == ("1.ply" if named else None)


def test_joints_and_lines_of_objects() -> None:
    lines = "\n".join(json.dumps({"id": f"p{i}", "joints_deg": JOINTS[i], "tcp_pose": [*PLACES[i], 1, 2, 3]}) for i in range(2))
    found = read(lines)
    assert found.joints is not None
    assert found.joints.tolist() == JOINTS
    assert found.joint_unit == "deg"
    assert found.positions is not None
    assert found.positions.tolist() == PLACES
    assert [label.name for label in found.labels] == ["p0", "p1"]
    assert "from JSON" in found.described[0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[{", "is no JSON"),
        ("{}", "holds no list of poses"),
        ('{"a": 1}', "holds no list of poses"),
        ('[{"joints": [1, 2, 3, 4, 5, 6]}, {"joints": [1, 2, 3, 4, 5]}]', "pose 2 differs from the first in 'j6'"),
        ('[{"joints": [1, 2, 3, 4, 5, NaN]}]', "j6: 'nan' is no finite number"),
        ('[{"joints": [1, 2, 3, 4, 5, 1e999]}]', "j6: 'inf' is no finite number"),
        ('[{"position": [1, 2, 3]}]', "neither axis angles nor a whole pose"),
    ],
)
def test_what_is_no_list_of_poses_is_told(text: str, said: str) -> None:
    with pytest.raises(FileError, match=said) as error:
        read(text)
    assert error.value.remedy


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["joints", "x", "q", "pose", "a.b", ""]), inner, max_size=4),
    max_leaves=12,
)


@settings(max_examples=150)
@given(_JSON)
def test_any_json_is_poses_or_an_error_of_ours(found: Any) -> None:
    try:
        assert len(read(json.dumps([found])))
    except FileError:
        return
