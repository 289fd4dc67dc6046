"""A calibrated robot as constant transforms between its axes: exactly what URDF and UR's kinematics files hold.

    base_from_flange(q) = origins[0] RotZ(C_1 q) origins[1] RotZ(C_2 q) ... RotZ(C_n q) origins[n]

with C the coupling of the model. It is `prod_i T_i(theta_i) exp(xi_i)` with RotZ(theta_i) = RotZ(offset_i) RotZ(C_i q) taken apart; RotZ
and TransZ of one axis commute. The datum of the base is in origins[0], the last link's twist in origins[n].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from calibrate.export_notes import robot_of, seen_joints_rad
from drivers.errors import DataError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from calibrate.result import Calibration

_EXACT_MM = 1e-7
_EXACT_RAD = 1e-10
_N_CHECKED = 20


@dataclass(frozen=True, slots=True, eq=False)
class RigidChain:
    """Constant transforms around the axes of a calibrated robot."""

    model: RobotModel
    origins: FloatArray
    """(n + 1, 4, 4): base to axis 1, axis i to axis i + 1, axis n to flange; mm."""


def rigid_chain(calibration: Calibration, what: str) -> RigidChain:
    """The chain of a calibration, compared with its forward kinematics.

    Raises:
        SettingsError: the calibration is pose-only.
        DataError: the calibrated robot bends or stretches, which no constant transforms can say.
    """
    model = robot_of(calibration, what)
    still = replace(model, coupling=np.zeros_like(model.coupling))
    steps = mdh.link_transforms(still, np.zeros(model.n_joints))
    twists = se3.exp(calibration.link_twists)
    origins = np.concatenate([steps, np.eye(4)[None]])
    origins[0] = calibration.datum.base_from_solver @ origins[0]
    origins[1:] = twists @ origins[1:]
    chain = RigidChain(model, origins)
    _check_exact(calibration, chain, what)
    return chain


def chain_flange(chain: RigidChain, joints_rad: FloatArray) -> FloatArray:
    """Forward kinematics (k, 4, 4) of a chain for axis angles (k, n)."""
    turns = joints_rad @ chain.model.coupling.T
    flange = np.broadcast_to(chain.origins[0], (len(joints_rad), 4, 4))
    for i, origin in enumerate(chain.origins[1:]):
        rotation = se3.exp_so3(turns[:, i, None] * np.array([0.0, 0.0, 1.0]))
        flange = flange @ se3.from_rotation_translation(rotation, np.zeros(3)) @ origin
    return np.asarray(flange)


def _check_exact(calibration: Calibration, chain: RigidChain, what: str) -> None:
    joints = seen_joints_rad(calibration, _N_CHECKED)
    miss = se3.log(se3.inverse(chain_flange(chain, joints)) @ calibration.base_from_flange(joints))
    off_mm, off_rad = np.abs(miss[:, :3]).max(), np.abs(miss[:, 3:]).max()
    if off_mm > _EXACT_MM or off_rad > _EXACT_RAD:
        raise DataError(
            f"{what} holds constant transforms only; the corrected robot differs from them by up to {off_mm:.4f} mm, {off_rad:.2g} rad",
            remedy="Export corrected targets (targets-csv, targets-rapid), which follow the whole calibration.",
        )
