"""Line profiles that do not close: the likely mistakes, tried on arcs (no arc by itself has a centre)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibrate.assemble import subset
from calibrate.observations import SphereShot
from calibrate.plausibility_causes import Cause, Recorded, plain_causes, shifts
from calibrate.problem import Problem
from calibrate.start_arcs import start_from_arcs
from drivers.errors import DataError

CLOSE_MM = 0.4
"""Rms of the points about their spheres with hand-eye and places alone; a real robot left 0.1 (METHOD.md 5)."""
_EXPLAINS, _PLAUSIBLE_MM = 5.0, 10.0
_LEAST_ARCS = 8
_FEWER_STARTS = 12


def check_arcs(problem: Problem, shots: Sequence[SphereShot], rms_mm: float) -> None:
    """To be called with the rms that a first guess left: tries likely mistakes where it is far too large.

    Raises:
        DataError: undone, one of them leaves five times less; the error names it.
    """
    if rms_mm <= CLOSE_MM or problem.n_shots < _LEAST_ARCS:
        return
    data = _recorded(problem, shots)
    tried = [(cause, _rms_mm(problem, cause, data)) for cause in (*shifts(), *plain_causes(data))]
    best_mm = min(mm for _, mm in tried)
    if best_mm <= min(rms_mm / _EXPLAINS, _PLAUSIBLE_MM):
        cause = next(cause for cause, mm in tried if mm <= 1.2 * best_mm)
        raise DataError(
            f"profiles and poses do not belong together: points stay {rms_mm:.1f} mm (rms) from one sphere; most likely {cause.name}: "
            f"with that undone {best_mm:.2f} mm are left",
            remedy=cause.remedy,
        )


def _recorded(problem: Problem, shots: Sequence[SphereShot]) -> Recorded:
    """The shots with their row in the place of the centre that an arc does not have."""
    sessions = sorted({shot.session for shot in shots})
    return Recorded(
        model=problem.model,
        joints_rad=problem.joints_rad,
        base_from_flange=problem.base_from_flange,
        centres_in_camera_mm=np.arange(problem.n_shots)[:, None] * np.ones(3),
        sphere=problem.sphere,
        session=np.array([sessions.index(shot.session) for shot in shots], dtype=np.int64),
        index=np.array([shot.index for shot in shots], dtype=np.int64),
    )


def _rms_mm(problem: Problem, cause: Cause, data: Recorded) -> float:
    changed = cause.undo(data)
    rows = changed.centres_in_camera_mm[:, 0].astype(np.int64)
    if len(rows) < max(_LEAST_ARCS, problem.n_shots // 2):
        return float("inf")
    part = replace(subset(problem, rows), base_from_flange=changed.base_from_flange)
    return start_from_arcs(part, None, n_starts=_FEWER_STARTS).scale_mm
