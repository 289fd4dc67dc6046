"""A calibrated robot as constant transforms between its axes: exactly what URDF and UR's kinematics files hold.

    base_from_flange(q) = origins[0] RotZ(C_1 q) origins[1] RotZ(C_2 q) ... RotZ(C_n q) origins[n]

with C the coupling of the model. It is `prod_i T_i(theta_i) exp(xi_i)` with RotZ(theta_i) = RotZ(offset_i) RotZ(C_i q) taken apart; RotZ
and TransZ of one axis commute. The datum of the base is in origins[0], the last link's twist in origins[n].

A robot that also yields under gravity is no such chain: all six numbers of every origin are then fitted over the seen axis
ranges, and what is left is the stated residual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from calibrate.export_notes import robot_of, seen_joints_rad
from calibrate.export_residual import Residual, corners, point_rows, residual_of
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from calibrate.result import Calibration

EXACT_MM = 1e-7
_STEPS = 6
_OPEN = 1e-9
"""Part of the largest singular value below which a direction counts as open."""
_N_FIT = 200


@dataclass(frozen=True, slots=True, eq=False)
class RigidChain:
    """Constant transforms around the axes of a calibrated robot."""

    model: RobotModel
    origins: FloatArray
    """(n + 1, 4, 4): base to axis 1, axis i to axis i + 1, axis n to flange; mm."""
    residual: Residual
    """What the calibrated robot does that no constant transforms do; rounding for a robot without further terms."""

    @property
    def exact(self) -> bool:
        """Whether nothing but rounding is left."""
        return self.residual.arm_max_mm < EXACT_MM

    def text(self) -> str:
        """One line on how exact it is."""
        return "exact: holds the corrected robot without loss" if self.exact else f"not exact, the robot yields under load; {self.residual.text()}"


def rigid_chain(calibration: Calibration, what: str) -> RigidChain:
    """The chain of a calibration and what it leaves, found by comparing it with the calibration's forward kinematics.

    Raises:
        SettingsError: the calibration is pose-only.
    """
    model = robot_of(calibration, what)
    still = replace(model, coupling=np.zeros_like(model.coupling))
    origins = np.concatenate([mdh.link_transforms(still, np.zeros(model.n_joints)), np.eye(4)[None]])
    origins[1:] = se3.exp(calibration.link_twists) @ origins[1:]
    origins[0] = calibration.datum.base_from_solver @ origins[0]
    residual = residual_of(calibration, lambda joints: _frames(model, origins, joints)[-1])
    if residual.arm_max_mm >= EXACT_MM:
        origins = _nearest(calibration, model, origins)
        residual = residual_of(calibration, lambda joints: _frames(model, origins, joints)[-1])
    return RigidChain(model, origins, residual)


def _frames(model: RobotModel, origins: FloatArray, joints_rad: FloatArray) -> list[FloatArray]:
    """Frames (k, 4, 4) at every axis before it turns, and the flange, for axis angles (k, n)."""
    turns = joints_rad @ model.coupling.T
    frames = [np.broadcast_to(origins[0], (len(joints_rad), 4, 4))]
    for i, origin in enumerate(origins[1:]):
        rotation = se3.exp_so3(turns[:, i, None] * np.array([0.0, 0.0, 1.0]))
        frames.append(frames[-1] @ se3.from_rotation_translation(rotation, np.zeros(3)) @ origin)
    return frames


def _nearest(calibration: Calibration, model: RobotModel, origins: FloatArray) -> FloatArray:
    """Origins, all free, that bring the chain nearest to the calibrated robot (Gauss-Newton).

    Neighbouring origins can take a turn and a slide about their axis from each other, so the step is the shortest one in
    mm and mrad: what the poses do not tell apart stays where it was.
    """
    joints = seen_joints_rad(calibration, _N_FIT)
    target = corners(calibration.base_from_flange(joints))
    unit = np.tile([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3], len(origins))
    result = origins.copy()
    for _ in range(_STEPS):
        frames = _frames(model, result, joints)
        points = corners(frames[-1])
        # a right twist of an origin acts in the frame behind it
        twists = np.concatenate([np.swapaxes(se3.adjoint(frame), 1, 2) for frame in frames], axis=1)
        step = unit * np.linalg.lstsq(point_rows(twists, points) * unit, (target - points).reshape(-1), rcond=_OPEN)[0]
        result = result @ se3.exp(step.reshape(-1, 6))
    return result
