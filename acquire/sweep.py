"""The straight ways in axis angles that a run drives, as points close together, to be drawn or looked at for collisions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from acquire.candidates import Blocked
from acquire.plan import PlannedPose
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


def swept_ways(poses: Sequence[PlannedPose], blocked: Blocked | None, step_rad: float = STEP_RAD) -> tuple[SweptWay, ...]:
    """The ways of a plan.

    Args:
        poses: in the order of the run.
        blocked: the collision check; None where there is none, and nothing touches.
        step_rad: the furthest that an axis goes between two points.
    """
    ways = []
    for before, pose in zip((None, *poses[:-1]), poses, strict=True):
        joints = pose.joints_rad[None] if before is None else way_between(before, pose, step_rad)
        touches = np.zeros(len(joints), dtype=np.bool_) if blocked is None else np.asarray(blocked(joints), dtype=np.bool_)
        ways.append(SweptWay(before, pose, joints, touches))
    return tuple(ways)
