"""The nearest Denavit-Hartenberg parameters of a calibrated robot, and what they cannot say.

A table is a product of elementary motions, some of them turned by the axes; its parameters are fitted by Gauss-Newton so that four
points of the flange (its origin and three at 400 mm from it) come to where the corrected robot has them, over the seen axis ranges.
Neighbouring axes that are nearly parallel have no stable common normal: their row takes an angle beta about y instead of d, which
stays nominal (S. A. Hayati, "Robot arm geometric link parameter estimation", 22nd IEEE CDC, 1983).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibrate.export_notes import robot_of, seen_joints_rad
from calibrate.export_residual import Residual, corners, point_rows, residual_of
from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from calibrate.result import Calibration

NEARLY_PARALLEL_RAD = np.radians(2.0)
_DIRECTIONS = {"tx": 0, "ty": 1, "tz": 2, "rx": 3, "ry": 4, "rz": 5}
_STEPS = 60
_N_FIT = 200
_CONVERGED_MM = 1e-10
# One unit of a parameter: a millimetre, and the angle that moves the end of a long arm by about as much.
_UNIT_MM, _UNIT_RAD = 1.0, 1e-3


@dataclass(frozen=True, slots=True)
class Motion:
    """One elementary motion of a table."""

    name: str
    """e.g. `alpha_2`; the row is the number at its end, or `base` or `flange`."""
    direction: str
    """tx, ty, tz (mm) or rx, ry, rz (rad)."""
    nominal: float
    axis: int | None = None
    """The axis whose MDH turn `coupling[axis] @ q` is added."""
    fixed: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class FittedTable:
    """A table with its parameters and what is left."""

    values: dict[str, float]
    nominal: dict[str, float]
    residual: Residual


def mdh_motions(model: RobotModel, *, ends: bool) -> tuple[Motion, ...]:
    """RotX(alpha) TransX(a) [RotY(beta)] RotZ(theta) TransZ(d) a row; `ends` adds a free base and a free flange transform."""
    motions: list[Motion] = list(_free_frame("base")) if ends else []
    for i in range(model.n_joints):
        row, parallel = i + 1, i > 0 and abs(np.sin(model.alpha_rad[i])) < np.sin(NEARLY_PARALLEL_RAD)
        motions += [Motion(f"alpha_{row}", "rx", float(model.alpha_rad[i])), Motion(f"a_{row}", "tx", float(model.a_mm[i]))]
        motions.append(Motion(f"beta_{row}", "ry", 0.0, fixed=not parallel))
        motions.append(Motion(f"theta_{row}", "rz", float(model.theta_offset_rad[i]), axis=i))
        motions.append(Motion(f"d_{row}", "tz", float(model.d_mm[i]), fixed=parallel))
    return tuple(motions + (list(_free_frame("flange")) if ends else []))


def standard_dh_motions(model: RobotModel) -> tuple[Motion, ...]:
    """RotZ(theta) TransZ(d) TransX(a) RotX(alpha) a row, without beta: the form of UR's controllers. Row 0 of MDH must be zero."""
    a, alpha = np.append(model.a_mm[1:], 0.0), np.append(model.alpha_rad[1:], 0.0)
    motions: list[Motion] = []
    for i in range(model.n_joints):
        motions.append(Motion(f"theta_{i + 1}", "rz", float(model.theta_offset_rad[i]), axis=i))
        motions.append(Motion(f"d_{i + 1}", "tz", float(model.d_mm[i])))
        motions += [Motion(f"a_{i + 1}", "tx", float(a[i])), Motion(f"alpha_{i + 1}", "rx", float(alpha[i]))]
    return tuple(motions)


def fit_table(calibration: Calibration, motions: tuple[Motion, ...], *, ridge: float) -> FittedTable:
    """The parameters of a table that come nearest to a calibrated robot.

    Args:
        calibration: with a robot and seen axis ranges.
        motions: the table, with nominal values to start from.
        ridge: mm of residual that one unit (1 mm, 1 mrad) of a parameter's change is held to be worth: keeps those small that
            the poses do not tell apart.

    Raises:
        SettingsError: the calibration is pose-only.
        DataError: no parameters were found.
    """
    model = robot_of(calibration, "a table of Denavit-Hartenberg parameters")
    joints = seen_joints_rad(calibration, _N_FIT)
    target = corners(calibration.base_from_flange(joints))
    free = [i for i, motion in enumerate(motions) if not motion.fixed]
    unit = np.array([_UNIT_MM if motions[i].direction[0] == "t" else _UNIT_RAD for i in free])
    nominal = np.array([motion.nominal for motion in motions])
    values = nominal.copy()
    for _ in range(_STEPS):
        flange, jacobian = _table_chain(model, motions, values, joints)
        points = corners(flange)
        design = point_rows(jacobian[:, free], points) * unit
        step = _ridge_step(design, (target - points).reshape(-1), (nominal - values)[free] / unit, ridge)
        values[free] += unit * step
        if np.abs(design @ step).max() < _CONVERGED_MM:
            return FittedTable(
                dict(zip((m.name for m in motions), values.tolist(), strict=True)),
                {motion.name: motion.nominal for motion in motions},
                residual_of(calibration, lambda poses: _table_chain(model, motions, values, poses)[0]),
            )
    raise DataError("no Denavit-Hartenberg parameters were found near the nominal ones", remedy="Export URDF, which holds every robot exactly.")


def _free_frame(name: str) -> tuple[Motion, ...]:
    return tuple(Motion(f"{direction}_{name}", direction, 0.0) for direction in ("tx", "ty", "tz", "rz", "ry", "rx"))


def _table_chain(model: RobotModel, motions: tuple[Motion, ...], values: FloatArray, joints_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Flange (k, 4, 4) and its derivatives (k, p, 6): left twists in the base by each value."""
    turns = joints_rad @ model.coupling.T
    frame, columns = se3.identity(len(joints_rad)), []
    for motion, value in zip(motions, values, strict=True):
        twist = np.zeros((len(joints_rad), 6))
        twist[:, _DIRECTIONS[motion.direction]] = value if motion.axis is None else value + turns[:, motion.axis]
        columns.append(se3.adjoint(frame)[:, :, _DIRECTIONS[motion.direction]])
        frame = frame @ se3.exp(twist)
    return frame, np.stack(columns, axis=1)


def _ridge_step(design: FloatArray, residual: FloatArray, to_nominal: FloatArray, ridge: float) -> FloatArray:
    weight = ridge * np.sqrt(len(design) / 3)
    stacked = np.concatenate([design, weight * np.eye(design.shape[1])])
    return np.asarray(np.linalg.lstsq(stacked, np.concatenate([residual, weight * to_nominal]), rcond=None)[0])
