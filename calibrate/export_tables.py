"""Tables of kinematic parameters: modified DH as CSV, and the kinematics file of the Universal Robots ROS driver."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from calibrate.export_chain import rigid_chain
from calibrate.export_fit import FittedTable, fit_table, mdh_motions, standard_dh_motions
from calibrate.export_notes import MM_PER_M, commented, number, numbers, provenance, robot_of, roll_pitch_yaw_rad
from calibrate.export_residual import Residual
from drivers.errors import SettingsError
from drivers.files.yaml import dump_yaml
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from calibrate.result import Calibration

UR_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
_UR_ALPHA_RAD = np.array([0.0, np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2])
_MDH_COLUMNS = ("alpha", "a", "beta", "theta", "d")
# A table with free ends says everything, so its ridge only settles what the parameters share; one without ends is told what a
# parameter may cost, or it would trade metres of d against microns where axes are nearly parallel.
_RIDGE_ENDS, _RIDGE_ROWS, _RIDGE_DH = 1e-6, 1e-4, 1e-2


def mdh_csv(calibration: Calibration) -> tuple[str, FittedTable]:
    """The corrected MDH table alone, n rows: what a program that knows neither base nor flange transform can take.

    Raises:
        SettingsError: the calibration is pose-only.
        DataError: no parameters were found.
    """
    model = robot_of(calibration, "an MDH table")
    table = fit_table(calibration, mdh_motions(model, ends=False), ridge=_RIDGE_ROWS)
    return _mdh_text(calibration, model, table, ()), table


def mdh_full_csv(calibration: Calibration) -> tuple[str, FittedTable]:
    """The corrected MDH table with a row for the base and one for the flange: exact for every rigid robot.

    Raises:
        SettingsError: the calibration is pose-only.
        DataError: no parameters were found.
    """
    model = robot_of(calibration, "an MDH table")
    table = fit_table(calibration, mdh_motions(model, ends=True), ridge=_RIDGE_ENDS)
    ends = ("base", "flange")
    return _mdh_text(calibration, model, table, ends), table


def ur_kinematics_yaml(calibration: Calibration) -> tuple[str, Residual]:
    """`kinematics_params` of the Universal Robots ROS driver with what they leave, and standard DH changes in the order of its KinematicsInfo.

    The driver's description has no place behind the last axis: `wrist_3` (its flange and tool0) is the corrected flange without
    the last link's constant twist, which is given beside it, with the hand-eye that belongs to the file.

    Raises:
        SettingsError: the calibration is pose-only, or its robot is no UR.
        DataError: no standard DH parameters were found.
    """
    model = robot_of(calibration, "UR kinematics parameters")
    _check_ur(model)
    chain = rigid_chain(calibration, "a UR kinematics file")
    table = fit_table(calibration, standard_dh_motions(model), ridge=_RIDGE_DH)
    data = {
        "kinematics": {
            **{name: _xyz_rpy(origin) for name, origin in zip(UR_LINKS, chain.origins[:-1], strict=True)},
            "hash": f"spherecal_{calibration.id[:16]}",
        },
        "spherecal": {
            "calibration": calibration.id,
            "tool0_from_flange": _xyz_rpy(chain.origins[-1]),
            "tool0_from_camera": None if calibration.hand_eye == "none" else _xyz_rpy(chain.origins[-1] @ calibration.flange_from_camera),
            "dh_convention": "RotZ(q + theta) TransZ(d) TransX(a) RotX(alpha); m, rad; corrected minus nominal",
            **_dh_deltas(model, table),
            "dh_residual": table.residual.text(),
        },
    }
    frame = "each link in the one before it; the first in the controller's base (`base_link_inertia` of ur_description)"
    notes = (
        *provenance(calibration, unit="m, rad; RotZ(yaw) RotY(pitch) RotX(roll) as URDF reads them", frame=frame),
        f"`kinematics`: {chain.text()}",
        "behind the last axis the driver has no place: tool0 lacks the constant tool0_from_flange,",
        "so use tool0_from_camera as the hand-eye together with this file. The hash is not the robot's own: the driver says so at its start.",
    )
    return commented(notes) + dump_yaml(data), chain.residual


def _mdh_text(calibration: Calibration, model: RobotModel, table: FittedTable, ends: tuple[str, ...]) -> str:
    frame = "base to flange; T_i = RotX(alpha) TransX(a) RotY(beta) RotZ(theta) TransZ(d), theta = coupling @ q + theta_offset"
    notes = [*provenance(calibration, unit="mm, rad", frame=frame), table.residual.text()]
    notes.append("beta stands in rows whose axis is nearly parallel to the one before (Hayati); their d is kept nominal")
    if ends:
        notes.append("rows base and flange are TransX(tx) TransY(ty) TransZ(tz) RotZ(rz) RotY(ry) RotX(rx), before and after the others")
    if not np.array_equal(model.coupling, np.eye(model.n_joints)):
        notes += [f"coupling row {i + 1}: {numbers(row, ' ')}" for i, row in enumerate(model.coupling)]
    head = "row,alpha_rad,a_mm,beta_rad,theta_offset_rad,d_mm" + (",tx_mm,ty_mm,tz_mm,rz_rad,ry_rad,rx_rad" if ends else "")
    rows = [_mdh_row(table, str(i + 1), bool(ends)) for i in range(model.n_joints)]
    if ends:
        rows = [_end_row(table, "base"), *rows, _end_row(table, "flange")]
    return commented(tuple(notes)) + "\n".join([head, *rows]) + "\n"


def _mdh_row(table: FittedTable, row: str, wide: bool) -> str:
    cells = [row, *(number(table.values[f"{column}_{row}"]) for column in _MDH_COLUMNS)]
    return ",".join(cells + [""] * 6 * wide)


def _end_row(table: FittedTable, name: str) -> str:
    return ",".join([name, *[""] * 5, *(number(table.values[f"{direction}_{name}"]) for direction in ("tx", "ty", "tz", "rz", "ry", "rx"))])


def _check_ur(model: RobotModel) -> None:
    """Told by its geometry, because a user's own model file may have any name."""
    plain = model.n_joints == 6 and np.array_equal(model.coupling, np.eye(6)) and not np.any(model.theta_offset_rad)
    if not (plain and np.allclose(model.alpha_rad, _UR_ALPHA_RAD, atol=1e-3) and model.a_mm[0] == 0 and model.a_mm[2] < 0 and model.a_mm[3] < 0):
        raise SettingsError(
            f"the robot {model.name} is no Universal Robots arm in its own axis convention",
            remedy="Export urdf or mdh instead; UR kinematics files fit UR robots only.",
        )


def _xyz_rpy(transform: FloatArray) -> dict[str, float]:
    values = [*(transform[:3, 3] / MM_PER_M), *roll_pitch_yaw_rad(transform[:3, :3])]
    return {name: float(value) for name, value in zip(("x", "y", "z", "roll", "pitch", "yaw"), values, strict=True)}


def _dh_deltas(model: RobotModel, table: FittedTable) -> Mapping[str, list[float]]:
    """theta, a, d, alpha, each for all axes: the order of the controller's KinematicsInfo."""

    def changes(parameter: str, scale: float) -> list[float]:
        names = [f"{parameter}_{i + 1}" for i in range(model.n_joints)]
        return [(table.values[name] - table.nominal[name]) / scale for name in names]

    scales = {"theta": 1.0, "a": MM_PER_M, "d": MM_PER_M, "alpha": 1.0}
    return {f"delta_{parameter}": changes(parameter, scale) for parameter, scale in scales.items()}
