"""Lists of poses: every table that spreadsheets and scripts write, RAPID, URScript; and nothing breaks the readers."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import FileError
from drivers.files.delimited import parse_table
from drivers.files.pose_list import PoseList
from drivers.files.poses import Use, parse_poses, read_poses

SIX = [10.5, -20.25, 30.0, 40.125, 50.5, 60.75]
POSE = [1000.5, -200.25, 300.0, 10.5, -20.5, 30.5]
QUATERNION = [1000.5, -200.25, 300.0, 0.5, -0.5, 0.5, 0.5]


def read(text: str, columns: str | None = None, use: Use = "both") -> PoseList:
    return parse_poses(text, file="poses.csv", columns=None if columns is None else columns.split(","), use=use)


def row(values: list[float]) -> str:
    return ",".join(map(str, values))


def joints_of(found: PoseList) -> list[list[float]]:
    assert found.joints is not None
    return found.joints.tolist()  # type: ignore[no-any-return]


def pose_of(found: PoseList) -> list[list[float]]:
    assert found.positions is not None
    assert found.rotations is not None
    return np.hstack([found.positions, found.rotations.numbers]).tolist()  # type: ignore[no-any-return]


@pytest.mark.parametrize("delimiter", [",", ";", "\t", " ", "   ", " ; ", ", ", "|"])
@pytest.mark.parametrize("comma", [False, True])
@pytest.mark.parametrize("header", [True, False])
@settings(max_examples=15)
@given(rows=st.lists(st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=6), min_size=1, max_size=4))
def test_every_delimiter_and_decimal_mark(delimiter: str, comma: bool, header: bool, rows: list[list[float]]) -> None:
    if comma and delimiter.strip() == ",":
        return
    # one number has a fraction for certain, as decimal commas can only be seen where there are any
    rows[0][0] = 1234.5
    lines = [delimiter.join(repr(value).replace(".", ",") if comma else repr(value) for value in values) for values in rows]
    names = delimiter.join(f"j{i + 1}" for i in range(6))
    found = read("\r\n".join([names, *lines] if header else lines), columns=None if header else "joints")
    assert joints_of(found) == rows
    assert found.labels[-1].where == f"line {len(rows) + header}"


@pytest.mark.parametrize(
    ("names", "unit"),
    [
        ("J1,J2,J3,J4,J5,J6", None),
        ("joint1_rad,joint2_rad,joint3_rad,joint4_rad,joint5_rad,joint6_rad", "rad"),
        ("Joint 1 [deg],Joint 2 [deg],Joint 3 [deg],Joint 4 [deg],Joint 5 [deg],Joint 6 [deg]", "deg"),
        ("A1 (°),A2 (°),A3 (°),A4 (°),A5 (°),A6 (°)", "deg"),
        ("axis_1/rad,axis_2/rad,axis_3/rad,axis_4/rad,axis_5/rad,axis_6/rad", "rad"),
        ("q0,q1,q2,q3,q4,q5", None),
        ("actual_q_0,actual_q_1,actual_q_2,actual_q_3,actual_q_4,actual_q_5", None),
        ("shoulder_pan_joint,shoulder_lift_joint,elbow_joint,wrist_1_joint,wrist_2_joint,wrist_3_joint", None),
        ("rax_1,rax_2,rax_3,rax_4,rax_5,rax_6", None),
        ("theta1,theta2,theta3,theta4,theta5,theta6", None),
        ("j_1,j_2,j_3,j_4,j_5,j_6", None),
    ],
)
def test_names_of_joints(names: str, unit: str | None) -> None:
    found = read(f"{names}\n{row(SIX)}")
    assert joints_of(found) == [SIX]
    assert found.joint_unit == unit
    assert found.positions is None
    assert found.rotations is None


def test_ros_sorts_joints_by_the_alphabet_and_they_come_out_in_order() -> None:
    names = "elbow_joint,shoulder_lift_joint,shoulder_pan_joint,wrist_1_joint,wrist_2_joint,wrist_3_joint"
    assert joints_of(read(f"{names}\n3,2,1,4,5,6")) == [[1, 2, 3, 4, 5, 6]]


@pytest.mark.parametrize(
    ("names", "by_axis", "convention", "units"),
    [
        ("x,y,z,rx,ry,rz", True, None, (None, None)),
        ("X [mm],Y [mm],Z [mm],Roll [deg],Pitch [deg],Yaw [deg]", True, None, ("mm", "deg")),
        ("x_m,y_m,z_m,rx_rad,ry_rad,rz_rad", True, None, ("m", "rad")),
        ("tcp_x,tcp_y,tcp_z,rot_x,rot_y,rot_z", True, None, (None, None)),
        ("X,Y,Z,A,B,C", False, None, (None, None)),
        ("X,Y,Z,W,P,R", False, "fanuc", (None, None)),
        ("X,Y,Z,O,A,T", False, "kawasaki", (None, None)),
        ("x,y,z,rvx,rvy,rvz", False, "rotation-vector", (None, None)),
        ("TCP_x,TCP_y,TCP_z,rotvec_x,rotvec_y,rotvec_z", False, "rotation-vector", (None, None)),
        ("x,y,z,r1,r2,r3", False, None, (None, None)),
    ],
)
def test_names_of_poses(names: str, by_axis: bool, convention: str | None, units: tuple[str | None, str | None]) -> None:
    found = read(f"{names}\n{row(POSE)}")
    assert pose_of(found) == [POSE]
    assert found.rotations is not None
    assert (found.rotations.by_axis, found.rotations.convention) == (by_axis, convention)
    assert (found.position_unit, found.rotations.unit) == units


@pytest.mark.parametrize(
    ("names", "order"),
    [
        ("x,y,z,qw,qx,qy,qz", [0, 1, 2, 3]),
        ("x,y,z,qx,qy,qz,qw", [3, 0, 1, 2]),
        ("x,y,z,q1,q2,q3,q4", [0, 1, 2, 3]),
        ("x,y,z,q0,q1,q2,q3", [0, 1, 2, 3]),
        ("pose.position.x,pose.position.y,pose.position.z,pose.orientation.x,pose.orientation.y,pose.orientation.z,pose.orientation.w", [3, 0, 1, 2]),
        ("x,y,z,quat_x,quat_y,quat_z,quat_w", [3, 0, 1, 2]),
    ],
)
def test_named_quaternions_come_with_w_first(names: str, order: list[int]) -> None:
    found = read(f"{names}\n{row(QUATERNION)}")
    assert found.rotations is not None
    assert found.rotations.convention == "quaternion-wxyz"
    np.testing.assert_array_equal(found.rotations.numbers[0], np.array(QUATERNION[3:])[order])


@pytest.mark.parametrize("origin", [0, 1])
def test_matrices(origin: int) -> None:
    names = [f"r{i + origin}{k + origin}" for i in range(3) for k in range(3)]
    found = read(",".join(["x", "y", "z", *names]) + "\n5,6,7,1,2,3,4,5,6,7,8,9")
    assert pose_of(found) == [[5, 6, 7, 1, 2, 3, 4, 5, 6, 7, 8, 9]]
    whole = "0 -1 0 5 1 0 0 6 0 0 1 7 0 0 0 1"
    for text, columns in ((whole, None), (whole, "transform")):
        assert pose_of(read(text, columns)) == [[5, 6, 7, 0, -1, 0, 1, 0, 0, 0, 0, 1]]


def test_what_stands_beside_the_numbers() -> None:
    found = read("name;nr;file;sphere;time;note;x;y;z;rx;ry;rz\np 1;7;b.ply;A;2026-01-31T12:00:00Z;fine;1;2;3;4;5;6\n;8;;;;;1;2;3;4;5;6")
    first, second = found.labels
    assert (first.name, first.number, first.cloud, first.sphere, first.time) == ("p 1", 7, "b.ply", "A", "2026-01-31T12:00:00Z")
    assert (second.name, second.number, second.cloud, second.sphere, second.time) == (None, 8, None, None, None)
    assert "columns that are not used: note" in found.described


def test_without_a_header_only_what_can_be_told_is_told() -> None:
    assert pose_of(read(f"{row(POSE)}\n{row(POSE)}")) == [POSE, POSE]
    assert pose_of(read(row(QUATERNION))) == [QUATERNION]
    assert joints_of(read(row(POSE + SIX))) == joints_of(read(row(SIX + POSE))) == joints_of(read(row(SIX + QUATERNION))) == [SIX]
    numbered = read(f"1,{row(POSE)}\n2,{row(POSE)}")
    assert [label.number for label in numbered.labels] == [1, 2]
    assert [label.name for label in read(f"p1,{row(POSE)}\np2,{row(POSE)}").labels] == ["p1", "p2"]
    remark = read(f"# poses of today\n# x y z rx ry rz\n{row(POSE).replace(',', ' ')}")
    assert remark.rotations is not None
    assert remark.rotations.by_axis


@pytest.mark.parametrize(
    ("text", "columns", "message"),
    [
        ("", None, "holds no rows"),
        ("# nothing", None, "holds no rows"),
        ("a,b,c", None, "no row with a number"),
        (row(SIX), None, "6 columns may be joints or position,angles"),
        (row([1, 2, 3, 4, 5, 6, 7]), None, "7 columns may be nothing that is known"),
        (row(SIX + SIX), None, "may be position,angles,joints or joints,position,angles"),
        (row(SIX), "joints,name", "7 columns are named, the lines hold 6"),
        (row(SIX), "j1,j2,j3,j4,j5,speed", "'speed' is not known"),
        (f"j1,j2,j3,j4,j5,j6\n{row(SIX)}\n{row(SIX[:5])}", None, "5 values where the other lines have 6"),
        ("j1,j2,j3,j4,j5,j6\n1,2,3,4,5,n.a.", None, "j6: 'n.a.' is no finite number"),
        ("j1,j2,j3,j4,j5,j6\n1,2,3,4,5,nan", None, "j6: 'nan' is no finite number"),
        ("j1,j2,j3,j4,j5,j6\n1,2,3,4,5,1e999", None, "j6: '1e999' is no finite number"),
        ("j1,j2,j3,j4,j5,j5\n1,2,3,4,5,6", None, "'j5' and 'j5' mean the same"),
        ("j1,j2,j3,j4,j6,speed\n1,2,3,4,5,6", None, "not whole: only j1, j2, j3, j4, j6"),
        ("x,y,z,rx,ry,speed\n1,2,3,4,5,6", None, "not whole: only rx, ry"),
        ("x,y,z\n1,2,3", None, "neither axis angles nor a whole pose"),
        ("rx,ry,rz\n1,2,3", None, "neither axis angles nor a whole pose"),
        ("x,y,z,rx,ry,rz,qw,qx,qy,qz\n1,2,3,4,5,6,1,0,0,0", None, "the rotation is given twice"),
        ("x_mm,y_m,z_mm,rx,ry,rz\n1,2,3,4,5,6", None, "different units: x_mm, y_m, z_mm"),
        ("x_deg,y_deg,z_deg,rx,ry,rz\n1,2,3,4,5,6", None, "'x_deg' has the unit deg"),
    ],
)
def test_tables_that_cannot_be_understood_say_why(text: str, columns: str | None, message: str) -> None:
    with pytest.raises(FileError, match=re.escape(message)) as caught:
        read(text, columns)
    assert caught.value.file == "poses.csv"
    assert caught.value.remedy


def test_one_of_two_things_can_be_chosen() -> None:
    text = f"j1,j2,j3,j4,j5,j6,x,y,z,rx,ry,rz\n{row(SIX + POSE)}"
    assert read(text, use="joints").positions is None
    assert read(text, use="poses").joints is None
    with pytest.raises(FileError, match="holds no poses"):
        read(f"j1,j2,j3,j4,j5,j6\n{row(SIX)}", use="poses")


RAPID = """MODULE Calib
  ! CONST robtarget old:=[[0,0,0],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
  LOCAL CONST robtarget p10 := [[800, -10.5, 900],[0.5,0.5,-0.5,
     0.5],[0,-1,0,0],[9E+09,9E9,9E9,9E9,9E9,9E9]]; ! a remark
  TASK PERS RobTarget p20:=[[801,0,900],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
  VAR robtarget later;
  PROC main()
    TPWrite "robtarget x:=[[1]];";
    MoveL p10,v100,fine,tool0;
  ENDPROC
ENDMODULE
"""
JOINTTARGETS = """CONST jointtarget j10:=[[10.5,-20.25,30,40.125,50.5,60.75],[9E9,9E9,9E9,9E9,9E9,9E9]];
CONST jointtarget j20:=[[1,2,3,4,5,6],[9E9,9E9,9E9,9E9,9E9,9E9]];
"""


def test_robtargets() -> None:
    found = read(RAPID)
    assert [(label.name, label.where) for label in found.labels] == [("p10", "line 3, p10"), ("p20", "line 5, p20")]
    assert pose_of(found) == [[800, -10.5, 900, 0.5, 0.5, -0.5, 0.5], [801, 0, 900, 1, 0, 0, 0]]
    assert found.rotations is not None
    assert (found.position_unit, found.rotations.convention, found.joints) == ("mm", "quaternion-wxyz", None)


def test_jointtargets_alone_and_paired_with_robtargets() -> None:
    assert joints_of(read(JOINTTARGETS)) == [SIX, [1, 2, 3, 4, 5, 6]]
    assert read(JOINTTARGETS).joint_unit == "deg"
    both = read(RAPID + JOINTTARGETS)
    assert (len(both), joints_of(both)[0], pose_of(both)[0][:3]) == (2, SIX, [800, -10.5, 900])
    with pytest.raises(FileError, match="2 robtargets and 1 jointtargets that are not pairs"):
        read(RAPID + JOINTTARGETS.splitlines()[0])
    assert read(RAPID + JOINTTARGETS.splitlines()[0], use="poses").joints is None
    assert len(read(RAPID + JOINTTARGETS.splitlines()[0], use="joints")) == 1


def test_arrays_of_targets_and_targets_inside_moves() -> None:
    array = "PERS jointtarget q{2}:=[[[1,2,3,4,5,6],[9E9,9E9,9E9,9E9,9E9,9E9]],[[2,3,4,5,6,7],[9E9,9E9,9E9,9E9,9E9,9E9]]];"
    assert [label.name for label in read(array).labels] == ["q{1}", "q{2}"]
    rest = "[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"
    moves = f"MoveJ [[1,2,3],[1,0,0,0],{rest},v50,z1,tool0;\nMoveL\\Conc,[[4,5,6],[0,1,0,0],{rest},v5;"
    assert pose_of(read(moves)) == [[1, 2, 3, 1, 0, 0, 0], [4, 5, 6, 0, 1, 0, 0]]
    assert [label.name for label in read(moves).labels] == ["line_1", "line_2"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("CONST robtarget p:=Offs(q,1,2,3);", "is no robtarget in plain numbers"),
        ("CONST robtarget p:=[[1,2,3],[1,0,0,0],[0,0,0,0]];", "is no robtarget in plain numbers"),
        ("CONST jointtarget p{2}:=[[[1,2,3,4,5],[1,2,3,4,5,6]]];", "is no jointtarget in plain numbers"),
        ("CONST jointtarget p:=[[1,2,3,4,5,6],[9E9,9E9,9E9,9E9,9E9,9E999]];", "is no jointtarget in plain numbers"),
        ("VAR robtarget p;", "holds no target"),
    ],
)
def test_rapid_that_is_not_in_plain_numbers(text: str, message: str) -> None:
    with pytest.raises(FileError, match=re.escape(message)):
        read(text)


def test_a_robot_on_a_moving_track_is_refused() -> None:
    target = "CONST jointtarget {}:=[[1,2,3,4,5,6],[{},9E9,9E9,9E9,9E9,9E9]];\n"
    assert len(read(target.format("a", 500) + target.format("b", 500))) == 2
    with pytest.raises(FileError, match="external axis 1 moves"):
        read(target.format("a", 500) + target.format("b", 600))


def test_urscript() -> None:
    exported = """
      global Plane_1=p[0.0,0.0,0.0,0.0,0.0,0.0]
      set_tcp(p[0,0,0.1,0,0,0])
      global Waypoint_1_p=p[.1, -.2, .3, 0.1, -3.1, 0.2]
      global Waypoint_1_q=[1, -1.5, 1.5, 0, 0.5, 0]   # remark [9,9,9,9,9,9]
      global Waypoint_2_p=p[.2, -.2, .3, 0.1, -3.1, 0.2]
      global Waypoint_2_q=[1.1, -1.5, 1.5, 0, 0.5, 0]
      movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.4, v=1.05)"""
    found = read(exported)
    assert [label.name for label in found.labels] == ["Waypoint_1", "Waypoint_2"]
    assert joints_of(found)[1] == [1.1, -1.5, 1.5, 0, 0.5, 0]
    assert pose_of(found)[0] == [0.1, -0.2, 0.3, 0.1, -3.1, 0.2]
    assert found.rotations is not None
    assert (found.position_unit, found.joint_unit, found.rotations.convention) == ("m", "rad", "rotation-vector")
    moves = "set_tcp(p[0,0,0.1,0,0,0])\nmovej([1,2,3,4,5,6], a=1)\nmovej([2,3,4,5,6,7])"
    assert joints_of(read(moves)) == [[1, 2, 3, 4, 5, 6], [2, 3, 4, 5, 6, 7]]
    logged = "p[.1,.2,.3,.4,.5,.6]\np[.2,.2,.3,.4,.5,.6]"
    assert len(pose_of(read(logged))) == 2
    with pytest.raises(FileError, match="1 poses and 1 times axis angles that are not pairs"):
        read("movej(p[1,2,3,4,5,6])\nmovej([1,2,3,4,5,6])")
    with pytest.raises(FileError, match="no waypoint"):
        read("set_tcp(p[0,0,0.1,0,0,0])")


def test_texts_of_other_systems(tmp_path: Path) -> None:
    text = f"name,j1,j2,j3,j4,j5,j6\nKästchen,{row(SIX)}\n"
    for encoding in ("utf-8", "utf-8-sig", "utf-16", "cp1252"):
        path = tmp_path / f"{encoding}.csv"
        path.write_bytes(text.encode(encoding))
        assert [label.name for label in read_poses(path).labels] == ["Kästchen"]


TOKENS = st.lists(
    st.sampled_from(
        [
            *"[]{},:;!#\"'\n\t| .-+0123456789eE",
            "robtarget ",
            "jointtarget ",
            ":=",
            "MoveL [[",
            "p[",
            "_q=[",
            "x,y,z,rx,ry,rz\n",
            "j1,j2",
            "9E9",
            "nan",
        ]
    ),
    max_size=60,
).map("".join)


@given(st.one_of(st.text(), TOKENS), st.sampled_from([None, "joints", "-,name,x,y,z,angles", "x_mm"]))
def test_no_text_breaks_the_readers(text: str, columns: str | None) -> None:
    try:
        found = read(text, columns)
    except FileError:
        return
    assert len(found) >= 1
    assert found.joints is not None or (found.positions is not None and found.rotations is not None)
    for values in (found.joints, found.positions, None if found.rotations is None else found.rotations.numbers):
        assert values is None or (len(values) == len(found) and bool(np.isfinite(values).all()))


@given(st.lists(st.lists(st.sampled_from(["1", "-2.5", "x", "p 1", "", "1,5"]), min_size=1, max_size=4), min_size=1, max_size=4))
def test_tables_have_one_number_of_columns(rows: list[list[str]]) -> None:
    try:
        table = parse_table("\n".join(";".join(cells) for cells in rows), file="t")
    except FileError:
        return
    assert {len(cells) for cells in table.rows} == {table.n_columns}
    assert len(table.lines) == len(table.rows)
