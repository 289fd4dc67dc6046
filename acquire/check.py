"""Does a session fit its cell and its robot? What no single file can tell by itself."""

from __future__ import annotations

import numpy as np

from acquire.cell import Cell
from drivers.errors import FileError
from drivers.files.session import Session
from drivers.files.shots import Shot
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

# No brake, overtravel or zero error lets an axis stand this far beyond its limit.
_BEYOND_LIMIT_RAD = 0.5
# A model's limits may be narrower than the real arm's: within one turn an angle is believed whatever they say.
_ANY_SERIAL_ARM_RAD = 2 * np.pi
# Where a model states no limits: no axis of an arm counts more than four turns.
_ANY_AXIS_LIMIT_RAD = 8 * np.pi


def check_session(session: Session, cell: Cell, model: RobotModel | None) -> None:
    """Check the shots of a session against the cell and the robot.

    Args:
        session: as read.
        cell: whose spheres the shots must name.
        model: the nominal robot, None for a pose-only cell.

    Raises:
        FileError: a shot names an unknown sphere, has another number of axes than the robot, axis angles in degrees or
            far beyond the limits, or only axis angles where no robot model is known.
    """
    for shot in session.all_shots:
        _check_sphere(session, shot, cell)
        _check_axes(session, shot, model)
    if model is not None:
        _check_angles(session, model)


def _fail(session: Session, shot: Shot, key: str, message: str, remedy: str) -> FileError:
    return FileError(message, file=session.folder / "shots.jsonl", where=f"line {shot.line}, {key} of shot {shot.index}", remedy=remedy)


def _check_sphere(session: Session, shot: Shot, cell: Cell) -> None:
    if shot.sphere is not None and shot.sphere not in cell.spheres:
        known = ", ".join(cell.spheres) or "none"
        raise _fail(session, shot, "sphere", f"there is no sphere {shot.sphere!r} in {session.cell_path.name}", f"Spheres of the cell: {known}.")


def _check_axes(session: Session, shot: Shot, model: RobotModel | None) -> None:
    if shot.joints_rad is None:
        return
    if model is None:
        if shot.base_from_flange is None and shot.status == "ok":
            message = "only axis angles, and the cell names no robot model to turn them into poses"
            raise _fail(session, shot, "joints_rad", message, "Name the model under robot in cell.yaml, or record base_from_flange.")
    elif len(shot.joints_rad) != model.n_joints:
        message = f"{len(shot.joints_rad)} axes, the robot {model.name} has {model.n_joints}"
        raise _fail(session, shot, "joints_rad", message, "Give all axes of the robot, or name the right model.")


def _check_angles(session: Session, model: RobotModel) -> None:
    """Judge all shots together: a few small angles alone do not tell degrees from radians."""
    shots = [shot for shot in session.all_shots if shot.joints_rad is not None]
    if not shots:
        return
    joints = np.array([shot.joints_rad for shot in shots])
    beyond = np.minimum(beyond_limits_rad(model, joints), np.maximum(np.abs(joints) - _ANY_SERIAL_ARM_RAD, 0.0))
    worst = int(beyond.max(axis=1).argmax())
    if beyond[worst].max() <= _BEYOND_LIMIT_RAD:
        return
    axis = int(beyond[worst].argmax())
    message = f"axis {axis + 1} at {joints[worst, axis]:.4g} rad is far beyond the limits of {model.name}"
    if beyond_limits_rad(model, np.radians(joints)).max() <= np.radians(5):
        raise _fail(session, shots[worst], "joints_rad", f"{message}: these look like degrees", "Convert the axis angles to rad.")
    raise _fail(session, shots[worst], "joints_rad", message, "Check the unit, the order of the axes and the robot model.")


def beyond_limits_rad(model: RobotModel, joints_rad: FloatArray) -> FloatArray:
    """How far every axis of q (..., n) stands outside its limits, (..., n), 0 inside; 4 turns where the model has none."""
    limits = np.clip(model.joint_limits_rad, -_ANY_AXIS_LIMIT_RAD, _ANY_AXIS_LIMIT_RAD)
    return np.asarray(np.maximum(limits[:, 0] - joints_rad, joints_rad - limits[:, 1]).clip(0))
