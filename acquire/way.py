"""The way through the poses of a plan."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from acquire.plan import PlannedPose

FloatArray = NDArray[np.float64]


class Way:
    """The planned way through all poses and their via points, walked forwards and backwards.

    Where a plan has via points they are what keeps the arm clear of things, so a robot that skips poses, takes one
    again, or resumes in the middle still follows them, one after the other. A plan without any goes straight.
    """

    def __init__(self, poses: Sequence[PlannedPose]) -> None:
        self._points: list[FloatArray] = []
        self._places: dict[str, int] = {}
        self._has_vias = False
        # the robot stands at this point of the way, or between these two neighbours; -1 is anywhere before the first
        self._low = self._high = -1
        for pose in poses:
            self.add(pose)

    def add(self, pose: PlannedPose) -> None:
        """Lengthen the way by a pose."""
        self._points += [*pose.via_rad, pose.joints_rad]
        self._places[pose.id] = len(self._points) - 1
        self._has_vias = self._has_vias or bool(pose.via_rad)

    def locate(self, joints_rad: FloatArray | None, tolerance_rad: float) -> None:
        """Take up the way where the robot stands, if that is one of its points; otherwise at its beginning."""
        if joints_rad is None:
            return
        near = [i for i, point in enumerate(self._points) if len(point) == len(joints_rad) and np.abs(point - joints_rad).max() <= tolerance_rad]
        self._low = self._high = near[0] if near else -1

    def to(self, pose: PlannedPose) -> Iterator[FloatArray]:
        """Points (n,) to pass up to a pose; a point counts as passed when the next one is asked for."""
        goal = self._places[pose.id]
        if not self._has_vias:
            yield pose.joints_rad
            return
        for place in self._walk(goal):
            self._low, self._high = min(self._low, place), max(self._high, place)
            yield self._points[place]
            self._low = self._high = place

    def _walk(self, goal: int) -> range:
        """Points from the next one to the goal; where the robot left off between two, the one on that side first."""
        between = self._low < self._high
        if goal < self._low or (between and goal == self._low):
            return range(self._low if between else self._low - 1, goal - 1, -1)
        return range(self._high if between or goal == self._high else self._high + 1, goal + 1)
