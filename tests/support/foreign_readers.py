"""How others read what we export: parsers and forward kinematics that share no code with the packages (SciPy does the rotations)."""

from __future__ import annotations

import csv
import re
import xml.etree.ElementTree as ET

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
NUMBER = r"[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?"


def transform_mm(rotation: Rotation, translation: ArrayLike, *, per_mm: float = 1.0) -> Array:
    """(4, 4) in mm of a translation given in another unit."""
    result = np.eye(4)
    result[:3, :3] = rotation.as_matrix()
    result[:3, 3] = np.asarray(translation, dtype=np.float64) / per_mm
    return result


def from_xyz_rpy_m(xyz: ArrayLike, rpy: ArrayLike) -> Array:
    """URDF: fixed-axis x, y, z rotations, metres."""
    return transform_mm(Rotation.from_euler("xyz", np.asarray(rpy, dtype=np.float64)), xyz, per_mm=1e-3)


def load_plain_yaml(text: str) -> dict[str, object]:
    """As ROS and most others do: PyYAML, YAML 1.1."""
    data = yaml.safe_load(text)
    assert isinstance(data, dict)
    return data


def ur_pose_mm(text: str) -> Array:
    """The `p[...]` of a URScript text."""
    found = re.search(r"p\[([^\]]*)\]", text)
    assert found
    values = [float(value) for value in found[1].split(",")]
    assert len(values) == 6
    return transform_mm(Rotation.from_rotvec(values[3:]), values[:3], per_mm=1e-3)


def rapid_numbers(declaration: str) -> list[float]:
    """All numbers right of := in a RAPID declaration."""
    return [float(value) for value in re.findall(NUMBER, declaration.split(":=")[1])]


class Urdf:
    """The forward kinematics of a URDF text, from root to any link, mimics followed."""

    def __init__(self, text: str) -> None:
        self.root = ET.fromstring(text)
        self.joint_of_child = {_get(joint, "child", "link"): joint for joint in self.root.findall("joint")}
        links = [link.attrib["name"] for link in self.root.findall("link")]
        assert len(set(links)) == len(links)
        names = [joint.attrib["name"] for joint in self.root.findall("joint")]
        assert len(set(names)) == len(names)
        for joint in self.root.findall("joint"):
            assert {_get(joint, "parent", "link"), _get(joint, "child", "link")} <= set(links)
        (self.base,) = set(links) - set(self.joint_of_child)

    def pose_mm(self, link: str, joints: dict[str, float]) -> Array:
        """(4, 4) of a link in the root."""
        pose = np.eye(4)
        while link != self.base:
            joint = self.joint_of_child[link]
            pose = self._joint_pose(joint, joints) @ pose
            link = _get(joint, "parent", "link")
        return pose

    def _joint_pose(self, joint: ET.Element, joints: dict[str, float]) -> Array:
        origin = joint.find("origin")
        assert origin is not None
        fixed = from_xyz_rpy_m(_floats(origin.attrib["xyz"]), _floats(origin.attrib["rpy"]))
        if joint.attrib["type"] == "fixed":
            return fixed
        mimic = joint.find("mimic")
        if mimic is None:
            angle = joints[joint.attrib["name"]]
        else:
            angle = float(mimic.attrib["multiplier"]) * joints[mimic.attrib["joint"]] + float(mimic.attrib["offset"])
        return np.asarray(fixed @ transform_mm(Rotation.from_rotvec(angle * np.array(_floats(_get(joint, "axis", "xyz")))), [0, 0, 0]))


def mdh_pose_mm(text: str, joints: ArrayLike, coupling: Array) -> Array:
    """(4, 4) flange of an exported MDH CSV, rows base and flange where it has them."""
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    turns = iter(coupling @ np.asarray(joints, dtype=np.float64))
    pose = np.eye(4)
    for row in rows:
        if row["row"] in ("base", "flange"):
            pose = pose @ transform_mm(
                Rotation.from_euler("ZYX", [float(row[f"r{a}_rad"]) for a in "zyx"]), [float(row[f"t{a}_mm"]) for a in "xyz"]
            )
            continue
        alpha, beta = Rotation.from_rotvec([float(row["alpha_rad"]), 0, 0]), Rotation.from_rotvec([0, float(row["beta_rad"]), 0])
        theta = Rotation.from_rotvec([0, 0, float(row["theta_offset_rad"]) + next(turns)])
        none = Rotation.identity()
        pose = pose @ transform_mm(alpha, [0, 0, 0]) @ transform_mm(none, [float(row["a_mm"]), 0, 0]) @ transform_mm(beta, [0, 0, 0])
        pose = pose @ transform_mm(theta, [0, 0, 0]) @ transform_mm(none, [0, 0, float(row["d_mm"])])
    return pose


def _get(joint: ET.Element, tag: str, attribute: str) -> str:
    element = joint.find(tag)
    assert element is not None
    return str(element.attrib[attribute])


def _floats(text: str) -> list[float]:
    return [float(value) for value in text.split()]
