"""URDF of the corrected robot: one revolute joint an axis, every origin a general transform, so no link twist is lost.

Coupled axes. Where a controller reports an angle that is not the angle between two links (the upper arm of a parallelogram robot,
theta_3 = q_3 - q_2), a second joint about the same axis stands before the joint's own and mimics the other axis with the factor of
the coupling: RotZ(-q_2) RotZ(q_3) = RotZ(q_3 - q_2). The chain is exact, and each main joint takes what the controller reports.
URDF cannot say three things of such a robot: the closed linkage itself, limits on a sum of axes, and that a reader must honour
`mimic` (robot_state_publisher and MoveIt do; some simulators do not).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from calibrate.export_chain import RigidChain, rigid_chain
from calibrate.export_hand_eye import add_comment, add_fixed_joint, add_origin, xml_text
from calibrate.export_notes import number, numbers, one_line, provenance
from calibrate.export_residual import Residual
from drivers.kinematics.mdh import RobotModel

if TYPE_CHECKING:
    from calibrate.result import Calibration

BASE, FLANGE, CAMERA = "base", "flange", "camera"


def urdf_robot(calibration: Calibration, joint_names: Sequence[str] | None = None) -> tuple[str, Residual]:
    """URDF text of the corrected robot with its camera, and what it leaves; joints take the controller's axis angles in rad.

    Args:
        calibration: with a robot.
        joint_names: (n,) names of the axes, joint_1 to joint_n if None.

    Raises:
        SettingsError: the calibration is pose-only.
    """
    chain = rigid_chain(calibration, "URDF")
    names = tuple(joint_names or (f"joint_{i + 1}" for i in range(chain.model.n_joints)))
    robot = ET.Element("robot", name=one_line(chain.model.name))
    frame = "links from `base` to `flange`, joints as the controller reports them"
    frame += "; `camera` hangs on the flange" if calibration.hand_eye != "none" else "; no camera"
    for line in (*provenance(calibration, unit="m, rad", frame=frame), chain.text(), *_remarks(chain.model, names)):
        add_comment(robot, line)
    ET.SubElement(robot, "link", name=BASE)
    parent = BASE
    for i in range(chain.model.n_joints):
        parent = _add_axis(robot, chain, i, parent, names)
    add_fixed_joint(robot, chain.origins[-1], parent, FLANGE)
    if calibration.hand_eye != "none":
        add_fixed_joint(robot, calibration.flange_from_camera, FLANGE, CAMERA)
    return xml_text(robot), chain.residual


def _add_axis(robot: ET.Element, chain: RigidChain, i: int, parent: str, names: Sequence[str]) -> str:
    """Append the joints and links of axis i; gives the name of its link."""
    model, origin = chain.model, chain.origins[i]
    for k, (j, factor) in enumerate(_mimics(model, i)):
        carrier = f"link_{i + 1}_linkage{'' if k == 0 else f'_{k + 1}'}"
        joint = _add_joint(robot, model, j, parent, carrier, f"{names[i]}_follows_{names[j]}", factor)
        add_origin(joint, origin)
        ET.SubElement(joint, "mimic", joint=names[j], multiplier=number(factor), offset="0")
        parent, origin = carrier, np.eye(4)
    link = f"link_{i + 1}"
    add_origin(_add_joint(robot, model, i, parent, link, names[i], 1.0), origin)
    return link


def _mimics(model: RobotModel, i: int) -> list[tuple[int, float]]:
    """(axis, factor) of what turns with axis i beside its own joint: all of coupling row i but the one of its own."""
    extra = model.coupling[i] - np.eye(model.n_joints)[i]
    return [(int(j), float(extra[j])) for j in np.flatnonzero(extra)]


def _add_joint(robot: ET.Element, model: RobotModel, axis: int, parent: str, child: str, name: str, factor: float) -> ET.Element:
    """Append a link and the joint that carries it, with the limits of a model's axis times a factor."""
    ET.SubElement(robot, "link", name=child)
    limits = np.sort(model.joint_limits_rad[axis] * factor)
    limited = bool(np.isfinite(limits).all())
    joint = ET.SubElement(robot, "joint", name=name, type="revolute" if limited else "continuous")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "axis", xyz="0 0 1")
    if limited:
        ET.SubElement(joint, "limit", lower=number(limits[0]), upper=number(limits[1]), effort="0", velocity="0")
    return joint


def _remarks(model: RobotModel, names: Sequence[str]) -> list[str]:
    remarks = ["a calibration knows no effort and no velocity: limit effort=0 velocity=0 are TO BE FILLED before motion is planned"]
    coupled = [i for i in range(model.n_joints) if _mimics(model, i)]
    if coupled:
        axes = ", ".join(names[i] for i in coupled)
        remarks.append(
            f"coupled axes: {axes}; joints *_follows_* mimic the axis that moves them, so that every other joint takes the controller's angle; "
            "a reader that ignores mimic gets a wrong robot; the closed linkage itself is not described"
        )
    for limit in model.linear_limits:
        bounds = f"{number(limit.lower_rad)} <= [{numbers(limit.row)}] . joints <= {number(limit.upper_rad)}"
        remarks.append(f"URDF cannot hold this limit on several axes together (rad): {bounds}")
    return remarks
