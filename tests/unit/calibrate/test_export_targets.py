"""Corrected targets: the real robot goes where the nominal one was meant to go; lists of targets are read strictly."""

from __future__ import annotations

import csv
import json
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calibrate import Calibration
from calibrate.export import export_text
from calibrate.export_target_files import Target, parse_targets
from calibrate.export_targets import correct_targets
from drivers.errors import DataError, FileError, SettingsError, SpherecalError
from drivers.kinematics import mdh
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model
from tests.support.exporting import YieldingCalibration, assert_same_poses, calibration_of, seen_poses, shipped_calibration
from tests.support.foreign_readers import rapid_numbers

ROBOTS = ("abb_irb1410", "ur5e")
JOINTS = "name,joint1_rad,joint2_rad,joint3_rad,joint4_rad,joint5_rad,joint6_rad"
POSE = "x_mm,y_mm,z_mm,qw,qx,qy,qz"


def nominal_poses(calibration: Calibration, joints: FloatArray) -> FloatArray:
    assert calibration.model is not None
    return mdh.base_from_flange(calibration.model, joints)


def regular_poses(calibration: Calibration, n: int) -> FloatArray:
    """Seen poses with elbow and wrist well bent."""
    joints = seen_poses(calibration, 10 * n)
    return np.asarray(joints[(np.abs(joints[:, 2]) > 0.15) & (np.abs(joints[:, 4]) > 0.2)][:n])


def joints_csv(joints: FloatArray) -> str:
    return "\n".join([JOINTS, *(f"p{i}," + ",".join(map(repr, q.tolist())) for i, q in enumerate(joints))])


def pose_csv(poses: FloatArray) -> str:
    rows = [[*pose[:3, 3], *np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)] for pose in poses]
    return "\n".join([POSE, *(",".join(repr(float(v)) for v in row) for row in rows)])


def read_csv(text: str) -> FloatArray:
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    return np.array([[float(row[f"joint{i}_rad"]) for i in range(1, 7)] for row in rows])


def read_json(text: str) -> FloatArray:
    return np.array([target["joints_rad"] for target in json.loads(text)["targets"]])


def read_rapid(text: str) -> FloatArray:
    lines = [line for line in text.splitlines() if line.startswith("CONST jointtarget")]
    return np.radians([rapid_numbers(line)[:6] for line in lines])


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize(("file_format", "read"), [("targets-csv", read_csv), ("targets-json", read_json), ("targets-rapid", read_rapid)])
def test_the_real_robot_reaches_the_nominal_pose(name: str, file_format: str, read: object) -> None:
    calibration = shipped_calibration(name)
    joints = regular_poses(calibration, 6)
    targets = parse_targets(joints_csv(joints), 6, file="targets.csv")
    exported = export_text(calibration, file_format, targets=targets)
    assert callable(read)
    corrected = read(exported.text)
    assert_same_poses(calibration.base_from_flange(corrected), nominal_poses(calibration, joints))
    # a correction, not another branch
    assert 1e-5 < np.abs(corrected - joints).max() < 0.05
    for c, q in zip(exported.corrected, joints, strict=True):
        off = calibration.base_from_flange(q)[:3, 3] - nominal_poses(calibration, q)[:3, 3]
        assert c.uncorrected_mm == pytest.approx(np.linalg.norm(off), abs=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_that_yields_reaches_it_too(name: str) -> None:
    calibration = calibration_of(load_robot_model(name), kind=YieldingCalibration)
    joints = regular_poses(calibration, 6)
    corrected = correct_targets(calibration, parse_targets(joints_csv(joints), 6, file="x"))
    reached = calibration.base_from_flange(np.array([c.joints_rad for c in corrected]))
    assert_same_poses(reached, nominal_poses(calibration, joints))


@pytest.mark.parametrize("name", ROBOTS)
def test_flange_poses_follow_one_another_without_changing_branch(name: str) -> None:
    calibration = shipped_calibration(name)
    seen = calibration.seen_joints_rad
    assert seen is not None
    joints = seen.mean(axis=0) + np.linspace(0, 1, 8)[:, None] * 0.3 * (seen[1] - seen[0]) / 2
    poses = nominal_poses(calibration, joints)
    as_json = json.dumps([{"base_from_flange": pose.tolist()} for pose in poses])
    for text in (pose_csv(poses), as_json):
        corrected = correct_targets(calibration, parse_targets(text, 6, file="targets"))
        assert_same_poses(calibration.base_from_flange(np.array([c.joints_rad for c in corrected])), poses)
        assert np.abs([c.nominal_joints_rad - q for c, q in zip(corrected, joints, strict=True)]).max() < 1e-6
        assert [c.target.name for c in corrected] == [f"target_{i + 1}" for i in range(8)]


def test_a_pose_may_say_which_angles_it_is_near() -> None:
    calibration = shipped_calibration("ur5e")
    joints = regular_poses(calibration, 1)[0]
    near = joints - np.array([0, 0, 0, 0, 0, np.sign(joints[5]) * 2 * np.pi])
    pose = nominal_poses(calibration, joints)
    text = json.dumps({"targets": [{"name": "a", "base_from_flange": pose.tolist(), "near_joints_rad": near.tolist()}]})
    (c,) = correct_targets(calibration, parse_targets(text, 6, file="targets"))
    assert np.abs(c.joints_rad - near).max() < 0.05


def robtarget(name: str, pose: FloatArray, cf: tuple[int, ...], ext: str = "9E9,9E9,9E9,9E9,9E9,9E9") -> str:
    x, y, z = pose[:3, 3]
    qx, qy, qz, qw = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return f"CONST robtarget {name}:=[[{x},{y},{z}],[{qw},{qx},{qy},{qz}],[{','.join(map(str, cf))},0],[{ext}]];"


def test_a_robtarget_takes_the_branch_of_its_confdata() -> None:
    calibration = shipped_calibration("abb_irb1410")
    for q in regular_poses(calibration, 8):
        cf = tuple(int(np.floor(q[i] / (np.pi / 2))) for i in (0, 3, 5))
        text = robtarget("p10", nominal_poses(calibration, q), cf)
        (c,) = correct_targets(calibration, parse_targets(text, 6, file="m.mod"))
        assert np.array_equal(np.floor(c.nominal_joints_rad[[0, 3, 5]] / (np.pi / 2)), cf)
        assert_same_poses(calibration.base_from_flange(c.joints_rad), nominal_poses(calibration, q))


def test_the_other_wrist_is_another_target() -> None:
    """The same pose, axes 4 and 6 half a turn on and axis 5 mirrored: told apart by confdata alone."""
    calibration = shipped_calibration("abb_irb1410")
    q = np.array([0.3, 0.1, 0.2, 0.9, -0.8, 0.5])
    flipped = q * [1, 1, 1, 1, -1, 1] + [0, 0, 0, -np.pi, 0, -np.pi]
    pose = nominal_poses(calibration, q)
    assert_same_poses(nominal_poses(calibration, flipped), pose)
    for joints, cf in ((q, (0, 0, 0)), (flipped, (0, -2, -2))):
        (c,) = correct_targets(calibration, parse_targets(robtarget("p10", pose, cf), 6, file="m.mod"))
        assert np.abs(c.joints_rad - joints).max() < 0.05
    with pytest.raises(DataError, match=r"no solution in the quadrants .* \[1, 0, 0\] \(there are \[0, "):
        correct_targets(calibration, parse_targets(robtarget("p10", pose, (1, 0, 0)), 6, file="m.mod"))


MODULE = """MODULE Targets
  ! robtarget old:=[[0,0,0],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
  CONST jointtarget home := [[0, -10, 20.5, 0,
      30, 0], [1500.5,9E+09,9E9,9E9,9E9,9E9]];
  PERS RobTarget p20:=[[800,0,900],[0.0,0.70711,0,0.70711],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]; ! the second
  VAR robtarget later;
  PROC main()
    MoveAbsJ home,v100,fine,tool0;
  ENDPROC
ENDMODULE
"""


def test_rapid_declarations_are_found_in_a_module() -> None:
    home, p20 = parse_targets(MODULE, 6, file="m.mod")
    assert (home.name, p20.name, home.where) == ("home", "p20", "line 3, home")
    assert home.joints_rad is not None
    np.testing.assert_allclose(np.degrees(home.joints_rad), [0, -10, 20.5, 0, 30, 0])
    assert home.external[0] == 1500.5
    assert p20.base_from_flange is not None
    np.testing.assert_allclose(p20.base_from_flange[:3, :3], Rotation.from_quat([1, 0, 1, 0]).as_matrix(), atol=1e-12)
    exported = export_text(shipped_calibration("abb_irb1410"), "targets-rapid", targets=[home])
    assert re.search(r"^CONST jointtarget home:=\[\[.*\],\[1500.5,9E9,9E9,9E9,9E9,9E9\]\];$", exported.text, re.MULTILINE)


def test_text_says_unit_frame_and_calibration_and_is_never_corrected_again() -> None:
    calibration = shipped_calibration("abb_irb1410")
    targets = parse_targets(joints_csv(regular_poses(calibration, 2)), 6, file="x")
    for file_format in ("targets-csv", "targets-json", "targets-rapid"):
        text = export_text(calibration, file_format, targets=targets).text
        assert calibration.id in text
        assert "unit" in text
        assert "the base (wobj0)" in text
        with pytest.raises(FileError):
            parse_targets(text, 6, file="again")


def test_what_is_outside_the_seen_range_is_marked() -> None:
    calibration = shipped_calibration("abb_irb1410")
    far = np.array([[-2.0, 0.1, 0.2, 0.4, -0.8, 0.5]])
    exported = export_text(calibration, "targets-rapid", targets=parse_targets(joints_csv(far), 6, file="x"))
    assert "! outside the axis ranges that the calibration saw" in exported.text
    assert not exported.corrected[0].in_seen_range


def test_a_target_out_of_reach_is_named_with_its_place() -> None:
    calibration = shipped_calibration("abb_irb1410")
    text = f"name,{POSE}\n# far away\nfar,5000,0,0,1,0,0,0\n"
    with pytest.raises(DataError, match="target far: the robot cannot reach") as caught:
        correct_targets(calibration, parse_targets(text, 6, file="t.csv"), file="t.csv")
    assert (caught.value.file, caught.value.where) == ("t.csv", "line 3")


def test_another_posture_is_no_correction() -> None:
    """The nominal arm is stretched out fully, the real one is shorter: it gets there only with the wrist turned round, or not at all."""
    calibration = shipped_calibration("ur5e")
    stretched = Target("s", "line 2", joints_rad=np.array([0.461, -0.28, 0.01, 0.791, -0.559, 0.55]))
    with pytest.raises(DataError, match=r"target s: the corrected robot reaches the pose only in another posture \(axis \d [-+]\d+ degrees\)"):
        correct_targets(calibration, [stretched])


def test_corrected_angles_keep_the_limits_or_are_refused() -> None:
    calibration = shipped_calibration("abb_irb1410")
    model = load_robot_model("abb_irb1410")
    refused: list[str] = []
    for axis in range(6):
        for limit in model.joint_limits_rad[axis]:
            joints = np.array([0.3, 0.1, 0.2, 0.9, -0.8, 0.5])
            joints[axis] = limit
            try:
                (c,) = correct_targets(calibration, [Target("edge", "line 2", joints_rad=joints)])
            except DataError as error:
                refused.append(str(error))
            else:
                assert mdh.within_limits(model, c.joints_rad)
    assert len(refused) >= 4
    assert all("limits" in message or "another posture" in message for message in refused)


def test_names_that_rapid_cannot_take_are_told() -> None:
    calibration = shipped_calibration("abb_irb1410")
    target = Target("1st place", "line 2", joints_rad=regular_poses(calibration, 1)[0])
    with pytest.raises(SettingsError, match="no name that RAPID takes"):
        export_text(calibration, "targets-rapid", targets=[target])
    odd = Target('a "b", c', "line 2", joints_rad=regular_poses(calibration, 1)[0])
    text = export_text(calibration, "targets-csv", targets=[odd]).text
    (row,) = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    assert row["name"] == 'a "b", c'


SIX = "0,0,0,0,0,0"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no target"),
        (JOINTS, "holds no target"),
        ("# only a remark", "holds no target"),
        ("[]", "holds no target"),
        ("{}", "no list of targets"),
        ("[{]", "broken JSON"),
        ("[" * 100000, "broken JSON"),
        ("[1]", "stands where"),
        ('[{"name": "a"}]', "exactly one of"),
        ('[{"joints_rad": [0,0,0,0,0,0], "joints_deg": [0,0,0,0,0,0]}]', "exactly one of"),
        ('[{"joints_rad": [0,0,0,0,0]}]', "list of 6 numbers"),
        ('[{"joints_rad": [0,0,0,0,0,NaN]}]', "not finite"),
        ('[{"joints_rad": [0,0,0,0,0,0], "speed": 3}]', "speed: is not known"),
        ('[{"base_from_flange": [[1,0,0,0],[0,1,0,0],[0,0,-1,0],[0,0,0,1]]}]', "no rigid transform"),
        ("x,y,z\n1,2,3", "the columns are x, y, z"),
        (f"{JOINTS},joint1_rad\na,{SIX},0", "the columns are"),
        (f"{JOINTS}\na,{SIX},7", "8 cells under 7 columns"),
        (f"{JOINTS}\na,0,0,0,0,0,nan", "no finite number"),
        (f"{JOINTS}\na,0,0,0,0,0,1e999", "no finite number"),
        (f"{JOINTS}\na,0,0,0,0,0,0x10", "no finite number"),
        (f"{JOINTS}\na,0,0,0,0,0,", "no finite number"),
        (f'{JOINTS}\n"a,0,0,0,0,0,0', "broken CSV"),
        (f"{POSE}\n0,0,0,1,0,0,0.1", "the quaternion has length 1.00499"),
        (f"{POSE}\n0,0,0,0,0,0,0", "the quaternion has length 0"),
        ("CONST robtarget p:=[[0,0,0],[2,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];", "the quaternion has length 2"),
        ("CONST robtarget p:=[[0,0,0],[1,0,0,0],[0,0,0,0]];", "is no robtarget in plain numbers"),
        ("CONST robtarget p:=Offs(q,0,0,1);", "is no robtarget in plain numbers"),
        ("CONST jointtarget p:=[[0,0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];", "is no jointtarget in plain numbers"),
        ("CONST jointtarget p{2}:=[[[0,0,0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]];", "is an array of targets"),
        ("VAR robtarget p;", "holds no target"),
    ],
)
def test_lists_that_are_not_as_they_should_be_are_told_with_a_remedy(text: str, message: str) -> None:
    with pytest.raises(FileError, match=re.escape(message)) as caught:
        parse_targets(text, 6, file="list")
    assert caught.value.file == "list"
    assert caught.value.remedy


TOKENS = st.lists(
    st.sampled_from(
        [*"[]{},:;!#\"'\n .-+0123456789eE", "robtarget ", "jointtarget ", ":=", JOINTS, POSE, "\n", SIX, "9E9", "nan", "null", '"joints_rad"', "name"]
    ),
    max_size=60,
).map("".join)


@given(st.one_of(st.text(), TOKENS))
def test_no_text_breaks_the_reader(text: str) -> None:
    try:
        targets = parse_targets(text, 6, file="list")
    except SpherecalError:
        return
    for target in targets:
        assert (target.joints_rad is None) != (target.base_from_flange is None)


@given(st.lists(st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=6), min_size=1, max_size=4))
def test_angles_come_out_of_every_kind_of_list_as_they_went_in(rows: list[list[float]]) -> None:
    joints = np.array(rows)
    as_json = json.dumps([{"joints_rad": row} for row in rows])
    degrees = "\n".join(["joint1_deg, joint2_deg,joint3_deg,joint4_deg,joint5_deg,joint6_deg", *(",".join(map(repr, row)) for row in rows)])
    rapid = "\n".join(f"CONST jointtarget p{i}:=[[{','.join(map(repr, row))}],[9E9,9E9,9E9,9E9,9E9,9E9]];" for i, row in enumerate(rows))
    for text, factor in ((joints_csv(joints), 1.0), (as_json, 1.0), (degrees, np.pi / 180), (rapid, np.pi / 180)):
        read = np.array([target.joints_rad for target in parse_targets(text, 6, file="list")])
        np.testing.assert_allclose(read, joints * factor, rtol=1e-15)
