"""Feasible robot poses: what every way of drawing views shares. Reach, limits, floor and collisions, each refusal with its reason."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.kinematics import mdh, se3
from drivers.kinematics.inverse import branches_of_many
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

BoolArray = NDArray[np.bool_]
Blocked = Callable[[FloatArray], BoolArray]
"""Axis angles (k, n) -> whether the arm or the camera there touches something, (k,)."""

UNREACHABLE, AXIS_LIMITS, NOT_IN_VIEW, BELOW_TABLE, COLLISION = "unreachable", "axis limits", "not in view", "below table", "collision"


@dataclass(frozen=True, slots=True, eq=False)
class CandidatePool:
    """Feasible poses: one row per arm branch of every view that is feasible."""

    joints_rad: FloatArray
    """(k, n)."""
    base_from_flange: FloatArray
    """(k, 4, 4)."""
    base_from_camera: FloatArray
    """(k, 4, 4)."""
    centre_in_camera_mm: FloatArray
    """(k, 3) where the camera sees the sphere's centre (or the point it was aimed at)."""
    view: NDArray[np.intp]
    """(k,) number of the drawn view; branches of one view share it."""
    n_candidates: int
    """Views drawn; `n_candidates = n_feasible + sum(rejected.values())` before any row is taken."""
    rejected: Mapping[str, int] = field(default_factory=dict)
    """Views without any feasible branch, by reason."""
    uncovered_in_base_mm: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(t, 3) points of a region that no feasible pose looks at."""

    @property
    def n_feasible(self) -> int:
        """Views with at least one feasible branch."""
        return len(np.unique(self.view))

    def take(self, rows: ArrayLike) -> CandidatePool:
        """The pool with only these rows, in this order; counts stay those of the whole draw."""
        index = np.asarray(rows, dtype=np.intp)
        arrays: dict[str, Any] = {name: getattr(self, name)[index] for name in _ROWS}
        return replace(self, **arrays)


_ROWS = ("joints_rad", "base_from_flange", "base_from_camera", "centre_in_camera_mm", "view")


def feasible(
    model: RobotModel,
    flange_from_camera: ArrayLike,
    base_from_camera: FloatArray,
    in_camera: FloatArray,
    visible: BoolArray,
    margin_rad: float,
    floor_mm: float,
    blocked: Blocked | None,
) -> CandidatePool:
    """The pool of views `base_from_camera` (m, 4, 4) that pass every check.

    A view is rejected for the last check that one of its branches came to; those not `visible` (m,) are not tried.
    """
    reason = np.where(visible, UNREACHABLE, NOT_IN_VIEW).astype(object)
    index = np.flatnonzero(visible)
    targets = base_from_camera @ se3.inverse(flange_from_camera)
    branches = branches_of_many(model, targets[index], margin_rad=margin_rad)
    reason[index[branches.reachable]] = AXIS_LIMITS
    rows, joints = index[branches.target], branches.joints_rad
    reason[rows] = BELOW_TABLE
    above = _above(model, joints, base_from_camera[rows], floor_mm)
    rows, joints = rows[above], joints[above]
    reason[rows] = COLLISION
    free = ~blocked(joints) if blocked is not None else np.ones(len(rows), dtype=np.bool_)
    rows, joints = rows[free], joints[free]
    reason[rows] = None
    reasons, counts = np.unique([r for r in reason if r is not None], return_counts=True)
    rejected = {str(r): int(c) for r, c in zip(reasons, counts, strict=True)}
    return CandidatePool(joints, targets[rows], base_from_camera[rows], in_camera[rows], rows, len(base_from_camera), rejected)


def _above(model: RobotModel, joints_rad: FloatArray, base_from_camera: FloatArray, floor_mm: float) -> BoolArray:
    """Whether camera, flange and wrist keep above the floor; the base and shoulder stand where they stand."""
    frames = mdh.chain(model, joints_rad)[..., 3:, 2, 3]
    return np.asarray((frames.min(axis=-1) > floor_mm) & (base_from_camera[..., 2, 3] > floor_mm))


