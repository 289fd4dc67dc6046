"""A way round what stands in the straight one: via points for the arm, found by random search and then made short.

One via point first, the one with the least travel of those drawn; where none does, two trees that grow towards each other
from both ends (RRT-Connect: J. J. Kuffner, S. M. LaValle, ICRA 2000). The generator is seeded, so the same ways come out
every time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acquire.collision import CollisionCheck
from drivers.kinematics.mdh import RobotModel, within_limits
from drivers.kinematics.se3 import FloatArray

# No way runs into the very end of an axis.
_LIMIT_MARGIN_RAD = 0.01
_SEED = 5


@dataclass(frozen=True, slots=True)
class DetourSettings:
    """How long to look."""

    n_single: int = 150
    """Single via points drawn."""
    n_tried: int = 40
    """Of them so many, those of the least travel, have their ways looked at."""
    n_grown: int = 400
    """Random points that the trees grow towards."""
    step_rad: float = 0.35
    """Length of a branch, by its largest axis motion."""
    around_rad: float = 1.2
    """How far beyond the two ends points are drawn, on every axis."""


DEFAULT_DETOUR = DetourSettings()


def find_way(
    model: RobotModel, check: CollisionCheck, first_rad: FloatArray, second_rad: FloatArray, settings: DetourSettings = DEFAULT_DETOUR
) -> tuple[FloatArray, ...] | None:
    """Via points (n,) on a clear way between two axis angles (n,), none where the straight way is clear; None if no way was found.

    Args:
        model: whose limits every via point keeps.
        check: the collision check.
        first_rad: where the way begins.
        second_rad: where it ends.
        settings: how long to look.
    """
    if check.trouble(first_rad, second_rad) is None:
        return ()
    if check(np.stack([first_rad, second_rad])).any():
        return None
    search = _Search(model, check, first_rad, second_rad, settings)
    return search.single() or search.grown()


class _Search:
    """Between two ends that are clear by themselves."""

    def __init__(self, model: RobotModel, check: CollisionCheck, first_rad: FloatArray, second_rad: FloatArray, settings: DetourSettings) -> None:
        self._model, self._check, self._settings = model, check, settings
        self._ends = (first_rad, second_rad)
        self._rng = np.random.default_rng(_SEED)
        low = np.maximum(model.joint_limits_rad[:, 0], np.minimum(first_rad, second_rad) - settings.around_rad)
        high = np.minimum(model.joint_limits_rad[:, 1], np.maximum(first_rad, second_rad) + settings.around_rad)
        self._low, self._high = np.minimum(low, high), np.maximum(low, high)

    def single(self) -> tuple[FloatArray, ...] | None:
        """The single via point of the least travel."""
        first, second = self._ends
        drawn = self._drawn(self._settings.n_single)
        travel = np.abs(drawn - first).max(axis=1) + np.abs(drawn - second).max(axis=1)
        for point in drawn[np.argsort(travel, kind="stable")[: self._settings.n_tried]]:
            if self._check.trouble(point, second) is None and self._check.trouble(first, point) is None:
                return (point,)
        return None

    def grown(self) -> tuple[FloatArray, ...] | None:
        """Via points where the two trees meet."""
        trees = [_Tree(self._ends[0]), _Tree(self._ends[1])]
        for i, wanted in enumerate(self._rng.uniform(self._low, self._high, (self._settings.n_grown, len(self._low)))):
            growing, other = trees[i % 2], trees[1 - i % 2]
            leaf = self._extend(growing, wanted)
            if leaf is None:
                continue
            met = self._connect(other, growing.points[leaf])
            if met is not None:
                ways = (growing.way_to(leaf), other.way_to(met))
                begin, end = ways if i % 2 == 0 else ways[::-1]
                return self._shortened([*begin, *end[::-1]])
        return None

    def _drawn(self, n: int) -> FloatArray:
        first, second = self._ends
        # near the straight way first: half of the points would else be needlessly far
        share = np.linspace(0.1, 1.0, n)[:, None]
        beyond = share * self._settings.around_rad
        low = np.maximum(self._low, np.minimum(first, second) - beyond)
        drawn = self._rng.uniform(low, np.maximum(low, np.minimum(self._high, np.maximum(first, second) + beyond)))
        drawn = drawn[within_limits(self._model, drawn, _LIMIT_MARGIN_RAD)]
        return drawn[~self._check(drawn)]

    def _extend(self, tree: _Tree, wanted: FloatArray) -> int | None:
        """Grow a branch from the nearest point by one step, None where it cannot."""
        nearest = tree.nearest(wanted)
        way = wanted - tree.points[nearest]
        point = tree.points[nearest] + way * min(1.0, self._settings.step_rad / max(float(np.abs(way).max()), 1e-9))
        if not within_limits(self._model, point, _LIMIT_MARGIN_RAD) or self._check(point[None])[0]:
            return None
        return tree.add(point, nearest) if self._check.trouble(tree.points[nearest], point) is None else None

    def _connect(self, tree: _Tree, wanted: FloatArray) -> int | None:
        """Grow towards a point until it is reached, None where something is in the way."""
        while (leaf := self._extend(tree, wanted)) is not None:
            if np.abs(tree.points[leaf] - wanted).max() < 1e-9:
                return leaf
        return None

    def _shortened(self, way: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """The points between the ends that are needed: from each one straight to the farthest that can be seen."""
        kept, i = [way[0]], 0
        while i < len(way) - 1:
            i = next(j for j in range(len(way) - 1, i, -1) if j == i + 1 or self._check.trouble(way[i], way[j]) is None)
            kept.append(way[i])
        return tuple(kept[1:-1])


class _Tree:
    """Points and which of them each was grown from."""

    def __init__(self, root: FloatArray) -> None:
        self.points, self._before = [root], [-1]

    def nearest(self, wanted: FloatArray) -> int:
        return int(np.argmin(np.abs(np.array(self.points) - wanted).max(axis=1)))

    def add(self, point: FloatArray, before: int) -> int:
        self.points.append(point)
        self._before.append(before)
        return len(self.points) - 1

    def way_to(self, leaf: int) -> list[FloatArray]:
        """From the root on."""
        way = []
        while leaf >= 0:
            way.append(self.points[leaf])
            leaf = self._before[leaf]
        return way[::-1]
