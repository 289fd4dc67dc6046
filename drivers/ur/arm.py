"""What the controller itself believes of its arm: Denavit-Hartenberg parameters with the factory's calibration, and the tool.

Read once from the primary interface (sub-packages "cartesian info" and "kinematics info" of the robot state message).
UR's convention is the classic one, RotZ(theta + q) TransZ(d) TransX(a) RotX(alpha).
"""

from __future__ import annotations

import struct
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from drivers.errors import RobotError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.ur import wire
from drivers.ur.net import PRIMARY_PORT, Deadline, connect, receive

MM_PER_M = 1000.0
_N_PROBES = 20
_SAME_TOOL_MM, _SAME_TOOL_RAD = 1.0, 2e-3
"""What a pose of the tool may differ from the controller's own kinematics before another tool is suspected."""
_KINEMATICS = struct.Struct(">6I24dI")
_CARTESIAN = struct.Struct(">12d")


@dataclass(frozen=True, slots=True, eq=False)
class Arm:
    """The arm as its controller has it; mm and rad."""

    flange_from_tcp: FloatArray | None
    """(4, 4) of the active tool, None where the software does not tell."""
    theta_rad: FloatArray | None = None
    """(6,), and None with the three others where the software does not tell (before 3.6)."""
    a_mm: FloatArray | None = None
    d_mm: FloatArray | None = None
    alpha_rad: FloatArray | None = None

    def base_from_flange(self, joints_rad: FloatArray) -> FloatArray | None:
        """(..., 4, 4) by the controller's own kinematics for q (..., 6)."""
        if self.theta_rad is None or self.a_mm is None or self.d_mm is None or self.alpha_rad is None:
            return None
        angle = np.asarray(joints_rad) + self.theta_rad
        result = se3.identity(*angle.shape[:-1])
        for i in range(angle.shape[-1]):
            result = result @ _link(angle[..., i], float(self.d_mm[i]), float(self.a_mm[i]), float(self.alpha_rad[i]))
        return result

    def tool_fits(self, base_from_tcp: FloatArray, joints_rad: FloatArray) -> bool | None:
        """Whether a reported pose (4, 4) is that of the tool known here, at axis angles (6,); None where that cannot be told."""
        own = self.base_from_flange(joints_rad)
        if own is None or self.flange_from_tcp is None:
            return None
        off = se3.inverse(own @ self.flange_from_tcp) @ base_from_tcp
        return bool(np.linalg.norm(off[:3, 3]) < _SAME_TOOL_MM and np.linalg.norm(se3.log_so3(off[:3, :3])) < _SAME_TOOL_RAD)

    def deviation_mm(self, model: RobotModel) -> float | None:
        """Largest distance between flange positions of this arm and of a model, over poses all over the axes' ranges."""
        probes = np.random.default_rng(0).uniform(-2.0, 2.0, (_N_PROBES, 6))
        own = self.base_from_flange(probes)
        if own is None or model.n_joints != 6:
            return None
        return float(np.linalg.norm(own[:, :3, 3] - mdh.base_from_flange(model, probes)[:, :3, 3], axis=-1).max())


def read_arm(host: str, deadline: Deadline) -> Arm | None:
    """The arm, or None where the interface is closed, silent, or tells something else."""
    try:
        with closing(connect(host, PRIMARY_PORT, deadline)) as link:
            stream = wire.PrimaryStream()
            found: dict[int, bytes] = {}
            while deadline.left_s > 0 and not {wire.CARTESIAN_INFO, wire.KINEMATICS_INFO} <= set(found):
                for kind, payload in stream.feed(receive(link, deadline)):
                    if kind == wire.ROBOT_STATE:
                        found |= wire.sub_packages(payload)
            return arm_of(found)
    except (RobotError, wire.WireError):
        return None


def arm_of(parts: dict[int, bytes]) -> Arm | None:
    """The arm that sub-packages of a robot state message describe, None where they do not or hold nonsense."""
    tool = _tool(parts.get(wire.CARTESIAN_INFO, b""))
    payload = parts.get(wire.KINEMATICS_INFO, b"")
    if len(payload) < _KINEMATICS.size:
        return None if tool is None else Arm(tool)
    numbers = np.array(_KINEMATICS.unpack_from(payload)[6:30], dtype=np.float64).reshape(4, 6)
    if not np.isfinite(numbers).all():
        return None if tool is None else Arm(tool)
    theta, a, d, alpha = numbers
    return Arm(tool, theta, a * MM_PER_M, d * MM_PER_M, alpha)


def pose_transform(pose: FloatArray) -> FloatArray:
    """(4, 4), mm, of UR's pose: x, y, z in m and rotation vector in rad."""
    return se3.from_rotation_translation(se3.exp_so3(pose[3:]), np.asarray(pose[:3]) * MM_PER_M)


def _tool(payload: bytes) -> FloatArray | None:
    if len(payload) < _CARTESIAN.size:
        return None
    pose = np.array(_CARTESIAN.unpack_from(payload)[6:], dtype=np.float64)
    return pose_transform(pose) if np.isfinite(pose).all() else None


def _link(angle: FloatArray, d_mm: float, a_mm: float, alpha_rad: float) -> FloatArray:
    result = np.zeros((*angle.shape, 4, 4))
    cos, sin, cos_a, sin_a = np.cos(angle), np.sin(angle), np.cos(alpha_rad), np.sin(alpha_rad)
    result[..., 0, 0], result[..., 0, 1], result[..., 0, 2], result[..., 0, 3] = cos, -sin * cos_a, sin * sin_a, a_mm * cos
    result[..., 1, 0], result[..., 1, 1], result[..., 1, 2], result[..., 1, 3] = sin, cos * cos_a, -cos * sin_a, a_mm * sin
    result[..., 2, 1], result[..., 2, 2], result[..., 2, 3] = sin_a, cos_a, d_mm
    result[..., 3, 3] = 1.0
    return result
