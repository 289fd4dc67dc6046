"""The hand-eye transform in the forms that other programs read.

All of them hold `flange_from_camera`: the pose of the camera frame in the flange frame (ABB's and UR's tool0). Each function takes
a calibration and gives the text of a file.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

from calibrate.export_notes import MM_PER_M, commented, hand_eye_notes, nominal_robot_note, number, numbers, provenance, roll_pitch_yaw_rad
from drivers.files.yaml import dump_yaml
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from calibrate.result import Calibration

FRAME = "pose of the camera frame in the flange frame (camera: z away from the camera, x right, y down)"
_QUATERNION_NAMES = ("w", "x", "y", "z")


def hand_eye_data(calibration: Calibration) -> dict[str, object]:
    """Plain data of the hand-eye: 4x4 in mm, named quaternion, where it comes from."""
    transform = calibration.flange_from_camera
    quaternion = se3.quaternion_wxyz(transform[:3, :3])
    return {
        "calibration": calibration.id,
        "verdict": calibration.verdict,
        "unit": "mm",
        "frame": FRAME,
        "hand_eye": calibration.hand_eye,
        "note": "; ".join((*hand_eye_notes(calibration), nominal_robot_note(calibration))),
        "flange_from_camera": transform.tolist(),
        "translation_mm": dict(zip("xyz", transform[:3, 3].tolist(), strict=True)),
        "quaternion": dict(zip(_QUATERNION_NAMES, quaternion.tolist(), strict=True)),
    }


def hand_eye_yaml(calibration: Calibration) -> str:
    """YAML: 4x4 in mm and the quaternion, every component by name."""
    return _head(calibration, "mm") + dump_yaml(hand_eye_data(calibration))


def hand_eye_json(calibration: Calibration) -> str:
    """JSON with the keys of `hand_eye_yaml`."""
    return json.dumps(hand_eye_data(calibration), indent=2) + "\n"


def hand_eye_csv(calibration: Calibration) -> str:
    """CSV: four rows of four numbers, translation in mm in the last column; comment lines begin with #."""
    rows = "".join(f"{numbers(row, ',')}\n" for row in calibration.flange_from_camera)
    return _head(calibration, "mm") + rows


def quaternion_yaml(calibration: Calibration) -> str:
    """YAML: translation in mm and unit quaternion, named, w not negative."""
    data = hand_eye_data(calibration)
    return _head(calibration, "mm, unit quaternion") + dump_yaml({key: data[key] for key in ("calibration", "translation_mm", "quaternion")})


def ur_pose(calibration: Calibration) -> str:
    """URScript: `p[x, y, z, rx, ry, rz]`, metres and rotation vector in rad, as set_tcp takes it."""
    transform = calibration.flange_from_camera
    pose = [*(transform[:3, 3] / MM_PER_M), *se3.log_so3(transform[:3, :3])]
    head = commented((*provenance(calibration, unit="m, rotation vector in rad", frame=FRAME), nominal_robot_note(calibration)))
    return head + f"camera_tcp = p[{numbers(pose)}]\n"


def rapid_tooldata(calibration: Calibration) -> str:
    """RAPID tooldata, mm and q1..q4 = w, x, y, z, as one declaration.

    The mass is 0, which is no load a tool can have: robhold and the load are for the person who knows the camera's mount.
    """
    transform = calibration.flange_from_camera
    head = commented((*provenance(calibration, unit="mm, quaternion q1..q4 = w, x, y, z", frame=FRAME), nominal_robot_note(calibration)), "!")
    tframe = f"[[{numbers(transform[:3, 3], ',')}],[{numbers(se3.quaternion_wxyz(transform[:3, :3]), ',')}]]"
    return (
        f"{head}! TO BE FILLED before any motion with this tool: robhold (first value, TRUE: the robot carries the camera) and the load\n"
        "! (third part: mass in kg, centre of gravity in mm, axes of moment, inertia in kgm2). The mass of 0 below is a placeholder.\n"
        f"PERS tooldata tCamera:=[TRUE,{tframe},[0,[0,0,0],[1,0,0,0],0,0,0]];\n"
    )


def ros_transform(calibration: Calibration, parent: str = "flange", child: str = "camera") -> str:
    """YAML with the fields of a ROS geometry_msgs/TransformStamped, metres and x y z w; the tf2 command is in a comment."""
    transform = calibration.flange_from_camera
    metres, (w, x, y, z) = transform[:3, 3] / MM_PER_M, se3.quaternion_wxyz(transform[:3, :3])
    named = [*zip(("x", "y", "z"), metres, strict=True), ("qx", x), ("qy", y), ("qz", z), ("qw", w)]
    arguments = " ".join(f"--{name} {number(value)}" for name, value in named)
    command = f"ros2 run tf2_ros static_transform_publisher {arguments} --frame-id {parent} --child-frame-id {child}"
    data = {
        "header": {"frame_id": parent},
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", metres.tolist(), strict=True)),
            "rotation": {"x": float(x), "y": float(y), "z": float(z), "w": float(w)},
        },
    }
    return _head(calibration, "m, quaternion x y z w") + commented((command,)) + dump_yaml(data)


def urdf_camera_joint(calibration: Calibration, parent: str = "flange", child: str = "camera") -> str:
    """URDF: the two links and the fixed joint between them, to be copied into a robot description."""
    robot = ET.Element("robot", name="spherecal_hand_eye")
    for line in (*provenance(calibration, unit="m, rad", frame=FRAME), nominal_robot_note(calibration)):
        add_comment(robot, line)
    ET.SubElement(robot, "link", name=parent)
    add_fixed_joint(robot, calibration.flange_from_camera, parent, child)
    return xml_text(robot)


def add_fixed_joint(robot: ET.Element, parent_from_child: FloatArray, parent: str, child: str) -> None:
    """Append a link and the fixed joint that carries it; the transform (4, 4) is in mm."""
    ET.SubElement(robot, "link", name=child)
    joint = ET.SubElement(robot, "joint", name=f"{parent}_to_{child}", type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    add_origin(joint, parent_from_child)


def add_origin(joint: ET.Element, parent_from_child: FloatArray) -> None:
    """Append `origin` in metres and roll, pitch, yaw; the transform (4, 4) is in mm."""
    xyz, rpy = parent_from_child[:3, 3] / MM_PER_M, roll_pitch_yaw_rad(parent_from_child[:3, :3])
    ET.SubElement(joint, "origin", xyz=numbers(xyz, " "), rpy=numbers(rpy, " "))


def add_comment(robot: ET.Element, line: str) -> None:
    """Append a comment; XML allows no two hyphens in a row inside one."""
    while "--" in line:
        line = line.replace("--", "- -")
    robot.append(ET.Comment(f" {line} "))


def xml_text(root: ET.Element) -> str:
    """An indented XML document."""
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _head(calibration: Calibration, unit: str) -> str:
    return commented((*provenance(calibration, unit=unit, frame=FRAME), nominal_robot_note(calibration)))
