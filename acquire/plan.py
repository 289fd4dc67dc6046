"""Plans: the poses of a run as a file that people may edit (format spherecal-plan/1); checked again when loaded."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from acquire.cell import Cell
from acquire.check import beyond_limits_rad
from acquire.obstacles import MeshObstacle
from drivers.errors import FileError
from drivers.files.disk import read_text, write_text_atomic
from drivers.files.schema import Numbers, StrictModel, Text, check
from drivers.files.yaml import dump_yaml, parse_yaml
from drivers.kinematics.mdh import RobotModel, within_limits
from drivers.kinematics.se3 import FloatArray

PLAN_FORMAT = "spherecal-plan/1"
_LOG = logging.getLogger(__name__)
# Angles written with six decimals may stand this far beyond the limit they were planned at.
_ROUNDING_RAD = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class PlannedPose:
    """One pose, and the way to it."""

    id: str
    sphere: str | None
    """The sphere to look at, None for a workpiece."""
    joints_rad: FloatArray
    """(n,)"""
    via_rad: tuple[FloatArray, ...] = ()
    """Poses (n,) to pass on the way from the pose before."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Poses in the order of the run."""

    cell_sha256: str
    purpose: Literal["calibration", "verification", "workpiece"]
    poses: tuple[PlannedPose, ...]
    predicted: Mapping[str, object] = field(default_factory=dict)
    """What the design expects, e.g. centre_rms_mm."""
    part: MeshObstacle | None = None
    """The workpiece that the poses cover, where it stands; its path starts from the cell file's folder."""


def _as_tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _as_text(value: object) -> object:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


class _Pose(StrictModel):
    id: Annotated[Text, BeforeValidator(_as_text)]
    sphere: Text | None
    joints_rad: Numbers
    via_rad: Annotated[tuple[Numbers, ...], BeforeValidator(_as_tuple)] = ()


class _PlanFile(StrictModel):
    format: Literal["spherecal-plan/1"]
    cell_sha256: Text
    purpose: Literal["calibration", "verification", "workpiece"]
    poses: Annotated[tuple[_Pose, ...], BeforeValidator(_as_tuple)]
    predicted: dict[str, Any] = Field(default_factory=dict)
    part: MeshObstacle | None = None


def load_plan(path: str | Path, cell: Cell | None = None, model: RobotModel | None = None) -> Plan:
    """Read a plan and check it again: it may have been edited, and the cell may have changed.

    Args:
        path: the plan file.
        cell: whose spheres the poses must name; a changed cell file is told as a warning.
        model: whose axes and limits the poses must keep.

    Raises:
        FileError: with key path and line; for what the file says, an unknown sphere, or a pose outside the limits.
    """
    return parse_plan(read_text(path), file=path, cell=cell, model=model)


def parse_plan(text: str, *, file: str | Path, cell: Cell | None = None, model: RobotModel | None = None) -> Plan:
    """The plan in a YAML text, checked as `load_plan` does; `file` is named in errors.

    Raises:
        FileError: as `load_plan`.
    """
    path, content = file, check(_PlanFile, parse_yaml(text, file=file), file=str(file), text=text)
    poses = tuple(_pose(item) for item in content.poses)
    _check_unique(poses, path)
    for i, pose in enumerate(poses):
        _check_sphere(pose, cell, path, i)
        _check_joints(pose, poses[0], model, path, i)
    if cell is not None and cell.sha256 != content.cell_sha256:
        _LOG.warning("%s was made for another state of %s; spheres and limits were checked again.", path, cell.path)
    return Plan(content.cell_sha256, content.purpose, poses, content.predicted, content.part)


def plan_text(plan: Plan) -> str:
    """The YAML of a plan."""
    poses = [
        {"id": pose.id, "sphere": pose.sphere, "joints_rad": pose.joints_rad, **({"via_rad": list(pose.via_rad)} if pose.via_rad else {})}
        for pose in plan.poses
    ]
    data: dict[str, object] = {"format": PLAN_FORMAT, "cell_sha256": plan.cell_sha256, "purpose": plan.purpose, "poses": poses}
    part = {"part": plan.part.model_dump(mode="json", exclude_defaults=True)} if plan.part is not None else {}
    return dump_yaml(data | part | ({"predicted": plan.predicted} if plan.predicted else {}))


def with_part(cell: Cell, plan: Plan) -> Cell:
    """The cell with the workpiece of a plan among its obstacles: neither arm nor camera may touch it."""
    if plan.part is None or plan.part in cell.obstacles:
        return cell
    return cell.model_copy(update={"obstacles": (*cell.obstacles, plan.part)})


def write_plan(plan: Plan, path: str | Path) -> None:
    """Write a plan in one step.

    Raises:
        FileError: when the file cannot be written.
    """
    write_text_atomic(path, plan_text(plan))


def _pose(item: _Pose) -> PlannedPose:
    return PlannedPose(item.id, item.sphere, np.array(item.joints_rad), tuple(np.array(via) for via in item.via_rad))


def _check_unique(poses: tuple[PlannedPose, ...], path: str | Path) -> None:
    names = [pose.id for pose in poses]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise FileError(f"the id {name!r} is used twice", file=path, where=f"poses.{i}.id", remedy="Give every pose an id of its own.")


def _check_sphere(pose: PlannedPose, cell: Cell | None, path: str | Path, i: int) -> None:
    if cell is not None and pose.sphere is not None and pose.sphere not in cell.spheres:
        known = ", ".join(cell.spheres) or "none"
        message = f"there is no sphere {pose.sphere!r} in {cell.path}"
        raise FileError(message, file=path, where=f"poses.{i}.sphere", remedy=f"Spheres of the cell: {known}.")


def _check_joints(pose: PlannedPose, first: PlannedPose, model: RobotModel | None, path: str | Path, i: int) -> None:
    n_joints = len(first.joints_rad) if model is None else model.n_joints
    rows = [("joints_rad", pose.joints_rad), *((f"via_rad.{k}", via) for k, via in enumerate(pose.via_rad))]
    for key, joints in rows:
        where = f"poses.{i}.{key} (id {pose.id})"
        if len(joints) != n_joints or n_joints == 0:
            owner = "the first pose" if model is None else model.name
            raise FileError(f"{len(joints)} axes, {owner} has {n_joints}", file=path, where=where, remedy="Give all axes of the robot.")
        if model is not None and not within_limits(model, joints, -_ROUNDING_RAD):
            raise FileError(_outside(model, joints), file=path, where=where, remedy="Change or remove the pose, or plan again.")


def _outside(model: RobotModel, joints: FloatArray) -> str:
    beyond = beyond_limits_rad(model, joints)
    if beyond.max() == 0:
        return f"the pose breaks a limit between axes of {model.name}"
    axis = int(beyond.argmax())
    low, high = model.joint_limits_rad[axis]
    hint = " (in degrees?)" if beyond.max() > np.pi and beyond_limits_rad(model, np.radians(joints)).max() == 0 else ""
    return f"axis {axis + 1} at {joints[axis]:.4f} rad is outside {low:.4f} .. {high:.4f}{hint}"
