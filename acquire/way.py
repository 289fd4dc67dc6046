"""The way through the poses of a plan, and back to it from wherever the robot stands."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from acquire.cell import Cell
from acquire.collision import cell_collisions
from acquire.detour import find_way
from acquire.plan import PlannedPose
from drivers.errors import RobotError
from drivers.kinematics.mdh import RobotModel

FloatArray = NDArray[np.float64]
FindWay = Callable[[FloatArray, FloatArray], "tuple[FloatArray, ...] | None"]
"""Via points on a clear way between two axis angles (n,); None if there is none."""

# A via point as near to its pose as this says from which side the pose is reached.
_APPROACH_RAD = 0.1
# No robot that stops on a straight way stands further beside it, on any axis.
_BESIDE_RAD = 0.02


class NoClearWay(RobotError):
    """From where the robot stands no way to the next pose was found that touches nothing known."""


def way_of(cell: Cell, model: RobotModel | None, poses: Sequence[PlannedPose]) -> Way:
    """The way of a run in a cell.

    Raises:
        FileError: a mesh of an obstacle cannot be read.
    """
    if cell.robot.driver == "recorded":  # it goes from shot to shot and has no ways
        return Way([replace(pose, via_rad=()) for pose in poses])
    if model is None:
        return Way(poses)
    check = cell_collisions(cell, model)
    return Way(poses, lambda first, second: find_way(model, check, first, second))


class Way:
    """The planned way through all poses and their via points, walked forwards and backwards.

    Where a plan has via points they are what keeps the arm clear of things, so a robot that skips poses, takes one
    again, or resumes in the middle still follows them, one after the other. A plan without any goes straight.
    With `find`, ways that the plan does not hold are looked for: from where the robot stands when it has left the plan's way
    (at the beginning, after somebody moved it), to and from poses that were added, and past poses of a plan without via points.
    """

    def __init__(self, poses: Sequence[PlannedPose], find: FindWay | None = None) -> None:
        self._points: list[FloatArray] = []
        self._begins: dict[str, int] = {}
        self._places: dict[str, int] = {}
        self._added: set[int] = set()
        self._find = find
        # the robot stands at this point of the way, or between these two neighbours; -1 is anywhere before the first
        self._low = self._high = -1
        for pose in poses:
            self._lengthen(pose)
        self._has_vias = any(pose.via_rad for pose in poses)

    def add(self, pose: PlannedPose) -> None:
        """Lengthen the way by a pose that is not of the plan."""
        begin = len(self._points)
        self._lengthen(pose)
        self._added.update(range(begin, len(self._points)))
        self._has_vias = self._has_vias or bool(pose.via_rad)

    def _lengthen(self, pose: PlannedPose) -> None:
        self._begins[pose.id] = len(self._points)
        self._points += [*pose.via_rad, pose.joints_rad]
        self._places[pose.id] = len(self._points) - 1

    def locate(self, joints_rad: FloatArray | None, tolerance_rad: float) -> None:
        """Take up the way where the robot stands, if that is one of its points; otherwise at its beginning."""
        if joints_rad is None:
            return
        near = [i for i, point in enumerate(self._points) if len(point) == len(joints_rad) and np.abs(point - joints_rad).max() <= tolerance_rad]
        self._low = self._high = near[0] if near else -1

    def to(self, pose: PlannedPose, joints_rad: FloatArray | None = None) -> Iterator[FloatArray]:
        """Points (n,) to pass up to a pose; a point counts as passed when the next one is asked for.

        Args:
            pose: the goal.
            joints_rad: (n,) where the robot stands, None if it does not say.

        Raises:
            NoClearWay: there is none.
        """
        goal = self._places[pose.id]
        if self._find is not None and joints_rad is not None and not self._holds(goal, joints_rad):
            yield from self._join(self._find, pose, joints_rad)
            if self._low == goal:
                return
        if not self._has_vias:
            self._low = self._high = goal
            yield pose.joints_rad
            return
        for place in self._walk(goal):
            self._low, self._high = min(self._low, place), max(self._high, place)
            yield self._points[place]
            self._low = self._high = place

    def _join(self, find: FindWay, pose: PlannedPose, joints_rad: FloatArray) -> Iterator[FloatArray]:
        """A way that the plan does not hold: to the first point of the goal's own piece of the way, where that can be reached."""
        for entry in sorted({self._begins[pose.id], self._places[pose.id]}):
            vias = find(joints_rad, self._points[entry])
            if vias is not None:
                break
        else:
            raise NoClearWay(
                f"no way to pose {pose.id} was found that keeps clear of what the cell file knows",
                remedy="Jog the arm to a freer place and go on, or skip the pose. `spherecal preview` shows plan and obstacles.",
            )
        self._low = self._high = -1
        yield from (*vias, self._points[entry])
        self._low = self._high = entry

    def _holds(self, goal: int, joints_rad: FloatArray) -> bool:
        """Whether the plan itself says how to get from here to a goal."""
        if self._low < 0 or self._beside_rad(joints_rad) > _BESIDE_RAD:
            return False
        if self._added & {self._low, self._high, goal}:
            return self._low == self._high == goal
        return self._has_vias or abs(goal - self._low) <= 1

    def _beside_rad(self, joints_rad: FloatArray) -> float:
        """How far a robot at axis angles (n,) stands beside the piece of the way that it should be on."""
        first, second = self._points[self._low], self._points[self._high]
        along = second - first
        share = np.clip((joints_rad - first) @ along / max(float(along @ along), 1e-12), 0, 1)
        return float(np.abs(joints_rad - first - share * along).max())

    def _walk(self, goal: int) -> list[int]:
        """Points from the next one to the goal; where the robot left off between two, the one on that side first.

        Backwards a goal is passed and reached again from where the plan approaches it.
        """
        between = self._low < self._high
        if goal < self._low or (between and goal == self._low):
            back = list(range(self._low if between else self._low - 1, goal - 1, -1))
            return [*back, goal - 1, goal] if self._is_approached(goal) else back
        return list(range(self._high if between or goal == self._high else self._high + 1, goal + 1))

    def _is_approached(self, goal: int) -> bool:
        is_via = goal > 0 and goal - 1 not in self._places.values()
        return is_via and float(np.abs(self._points[goal] - self._points[goal - 1]).max()) <= _APPROACH_RAD
