"""An order of poses and the ways between them: little travel, nothing touched, every pose reached from the same side where that can be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from acquire.collision import CollisionCheck
from acquire.detour import find_way
from acquire.ordering import order_by_travel
from drivers.kinematics.mdh import RobotModel, within_limits
from drivers.kinematics.se3 import FloatArray

APPROACH_RAD = 0.02
"""The last motion to a pose turns every axis forwards by so much: more than the backlash of any gear that measures."""
# A detour costs about so much travel: worth another order, where one goes straight.
_DETOUR_RAD = 1.0
_MOST_ORDERS = 8
_START = -1


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """Poses in the order of a run."""

    rows: tuple[int, ...]
    """Of the axis angles that were given."""
    via_rad: tuple[tuple[FloatArray, ...], ...]
    """Via points (n,) on the way to each of them; to the first from the start, if that is known."""
    lost: tuple[int, ...]
    """Rows to which no way was found."""
    n_one_sided: int
    """Poses that are reached by turning every axis forwards."""


@dataclass(slots=True)
class _Ways:
    """What is known of straight ways between rows."""

    model: RobotModel
    check: CollisionCheck
    joints_rad: FloatArray
    approach_rad: FloatArray
    """(k, n) where the last motion to each pose begins: the pose itself where it has no room for one."""
    start_rad: FloatArray | None
    _clear: dict[tuple[int, int], bool] = field(default_factory=dict)

    def place(self, row: int) -> FloatArray | None:
        return self.start_rad if row == _START else self.joints_rad[row]

    def is_clear(self, first: int, second: int) -> bool:
        begin = self.place(first)
        if (first, second) not in self._clear:
            self._clear[first, second] = begin is None or self.check.trouble(begin, self.approach_rad[second]) is None
        return self._clear[first, second]

    def vias(self, first: int, second: int) -> tuple[FloatArray, ...] | None:
        """Via points to a pose, its approach last; None if there is no way."""
        begin, approach, goal = self.place(first), self.approach_rad[second], self.joints_rad[second]
        end = () if (approach == goal).all() else (approach,)
        if self.is_clear(first, second) or begin is None:
            return end
        found = find_way(self.model, self.check, begin, approach)
        return None if found is None else (*(via.round(6) for via in found), *end)


def route(model: RobotModel, check: CollisionCheck, joints_rad: FloatArray, *, start_rad: FloatArray | None = None, one_sided: bool = True) -> Route:
    """Order axis angles (k, n), themselves clear of everything, and find the ways between them.

    Orders with little travel are tried until no straight way in them is blocked, or no better one turns up; what is blocked
    then gets via points. Poses to which none are found are left out.

    Args:
        model: for the limits.
        check: the collision check.
        joints_rad: (k, n).
        start_rad: (n,) where the robot stands before the first one; None if nobody knows.
        one_sided: reach every pose by turning all axes forwards.
    """
    ways = _Ways(model, check, joints_rad, _approaches(model, check, joints_rad) if one_sided else joints_rad, start_rad)
    order = _order(ways)
    kept, lost = _chained(ways, order)
    if len(lost) > len(kept) and start_rad is None:
        # the first pose may stand apart from all others
        other, others = _chained(ways, [*lost, *(row for row, _ in kept)])
        kept, lost = (other, others) if len(other) > len(kept) else (kept, lost)
    n_one_sided = sum(bool((ways.approach_rad[row] != joints_rad[row]).any()) for row, _ in kept)
    return Route(tuple(row for row, _ in kept), tuple(vias for _, vias in kept), tuple(lost), n_one_sided)


def _approaches(model: RobotModel, check: CollisionCheck, joints_rad: FloatArray) -> FloatArray:
    """(k, n) all axes a little back from each pose, the pose itself where something is in the way."""
    back = (joints_rad - APPROACH_RAD).round(6)
    room = within_limits(model, back) & ~check(back)
    room &= [bool(free) and check.trouble(a, b) is None for free, a, b in zip(room, back, joints_rad, strict=True)]
    return np.where(room[:, None], back, joints_rad)


def _order(ways: _Ways) -> list[int]:
    """Rows in an order of little travel in which few straight ways are blocked."""
    n = len(ways.joints_rad)
    extra, from_start = np.zeros((n, n)), np.zeros(n)
    best: tuple[int, list[int]] = (n + 1, [])
    for _ in range(_MOST_ORDERS):
        order = order_by_travel(ways.joints_rad, start_joints_rad=ways.start_rad, extra_rad=extra, extra_from_start_rad=from_start).tolist()
        blocked = [(a, b) for a, b in pairwise([_START, *order]) if not ways.is_clear(a, b)]
        if len(blocked) < best[0]:
            best = (len(blocked), order)
        if not blocked:
            break
        for a, b in blocked:
            if a == _START:
                from_start[b] = _DETOUR_RAD
            else:
                extra[a, b] = extra[b, a] = _DETOUR_RAD
    return best[1]


def _chained(ways: _Ways, order: Sequence[int]) -> tuple[list[tuple[int, tuple[FloatArray, ...]]], list[int]]:
    """Rows with the via points to each, and rows without a way; these are tried once more at the end."""
    kept: list[tuple[int, tuple[FloatArray, ...]]] = []
    before, waiting = _START, list(order)
    for _ in range(2):
        lost = []
        for row in waiting:
            vias = ways.vias(before, row)
            if vias is None:
                lost.append(row)
                continue
            kept.append((row, vias))
            before = row
        waiting = lost
    return kept, waiting
