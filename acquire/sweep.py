"""The straight ways in axis angles that a run drives, as points close together, to be drawn or looked at for collisions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from acquire.cell import Cell
from acquire.collision import CollisionCheck, cell_collisions
from acquire.plan import PlannedPose
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

STEP_RAD = float(np.radians(2.0))


@dataclass(frozen=True, slots=True, eq=False)
class SweptWay:
    """The way to one pose, from the one before it."""

    before: PlannedPose | None
    """None where the way begins: nobody knows from where the first pose is reached."""
    pose: PlannedPose
    joints_rad: FloatArray
    """(k, n) ends included, no axis further than a step from point to point; the pose alone for the first."""
    touches: NDArray[np.bool_]
    """(k,) whether something known is touched there."""


def straight_way(first_rad: FloatArray, second_rad: FloatArray, step_rad: float = STEP_RAD) -> FloatArray:
    """Axis angles (k, n) on the straight way, ends included."""
    n_steps = max(1, int(np.ceil(np.abs(second_rad - first_rad).max() / step_rad)))
    return np.asarray(first_rad + np.linspace(0, 1, n_steps + 1)[:, None] * (second_rad - first_rad))


def way_between(before: PlannedPose, pose: PlannedPose, step_rad: float = STEP_RAD) -> FloatArray:
    """Axis angles (k, n) from one pose over the via points of the next one to it, ends included."""
    points = [before.joints_rad, *pose.via_rad, pose.joints_rad]
    pieces = [straight_way(a, b, step_rad) for a, b in pairwise(points)]
    return np.concatenate([pieces[0], *(piece[1:] for piece in pieces[1:])])


def swept_ways(poses: Sequence[PlannedPose], check: CollisionCheck | None, step_rad: float = STEP_RAD) -> tuple[SweptWay, ...]:
    """The ways of a plan.

    Args:
        poses: in the order of the run.
        check: the collision check; None where there is none, and nothing touches. It looks between the points too.
        step_rad: the furthest that an axis goes between two points.
    """
    ways = []
    for before, pose in zip((None, *poses[:-1]), poses, strict=True):
        joints = _from_nowhere(pose, step_rad) if before is None else way_between(before, pose, step_rad)
        ways.append(SweptWay(before, pose, joints, _touches(joints, before, pose, check, step_rad)))
    return tuple(ways)


def touching_ways(poses: Sequence[PlannedPose], cell: Cell, model: RobotModel | None) -> tuple[SweptWay, ...]:
    """The ways of a plan that touch something known, margins included; none for a recording, which has no ways.

    Raises:
        FileError: a mesh of an obstacle cannot be read.
    """
    if model is None or cell.robot.driver == "recorded":
        return ()
    return tuple(way for way in swept_ways(poses, cell_collisions(cell, model)) if way.touches.any())


def way_text(way: SweptWay) -> str:
    """Which way touches something, and where."""
    if len(way.joints_rad) and way.touches[-1]:
        return f"pose {way.pose.id} itself touches something"
    if way.before is None:
        return f"the via points to pose {way.pose.id} touch something"
    return f"the way from {way.before.id} to {way.pose.id} touches something"


def _from_nowhere(pose: PlannedPose, step_rad: float) -> FloatArray:
    """The way to the first pose from its first via point on, the pose alone where there is none."""
    first, *rest = (*pose.via_rad, pose.joints_rad)
    return way_between(replace(pose, joints_rad=first, via_rad=()), replace(pose, via_rad=tuple(rest[:-1])), step_rad) if rest else first[None]


def _touches(
    joints_rad: FloatArray, before: PlannedPose | None, pose: PlannedPose, check: CollisionCheck | None, step_rad: float
) -> NDArray[np.bool_]:
    """(k,) where a way touches something. A piece that keeps the margin of ways is clear, even where it is within that of poses."""
    touches = np.zeros(len(joints_rad), dtype=np.bool_)
    if check is None:
        return touches
    points = [*([] if before is None else [before.joints_rad]), *pose.via_rad, pose.joints_rad]
    first = 0
    for a, b in pairwise(points):
        stop = first + len(straight_way(a, b, step_rad))
        share = check.trouble(a, b)
        if share is not None:
            touches[first:stop] = check(joints_rad[first:stop])
            touches[first + round(share * (stop - 1 - first))] = True
        first = stop - 1
    touches[-1] = check(joints_rad[-1:])[0]
    return touches
