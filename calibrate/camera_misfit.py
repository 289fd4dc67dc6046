"""A camera error model that was asked for against the data: what it leaves in held-out shots that another model explains.

Pose noise takes up what a wrong camera model leaves in a shot, so that neither residuals nor held-out shots look worse than the
uncertainty says: both are stated larger. What is left is systematic, though. It does not average out over shots, and lengths are
wrong by it, by twice as much where it points in opposite directions at their ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrate.assemble import without_pose_noise
from calibrate.camera_error import CameraError
from calibrate.clouds import Solution, solve_clouds, thinned
from calibrate.model_choice import capped_rms_mm, simplest_of_the_best, try_families, variants_of
from drivers.kinematics.se3 import FloatArray

_THIN_POINTS = 250
_OPPOSITE_ENDS = 2.0
"""Variance of a difference of two errors as large as can be, over that of two independent ones."""


@dataclass(frozen=True, slots=True)
class CameraMisfit:
    """Held-out centres by the model that was asked for, and by the best."""

    rms_mm: float
    better: str
    better_rms_mm: float

    def covariance_factor(self, spread_mm2: float) -> float:
        """By how much a covariance grows with which centres have the variance `spread_mm2`, all three axes together."""
        systematic_mm2 = self.rms_mm**2 - self.better_rms_mm**2
        return 1.0 + _OPPOSITE_ENDS * systematic_mm2 / spread_mm2


def misfit_of(solution: Solution, others: Sequence[CameraError]) -> CameraMisfit | None:
    """Compare the model of a solution with others on held-out shots; None where none is better by more than a standard error.

    Args:
        solution: of an area camera's problem.
        others: the last is a field.
    """
    problem, field = solution.problem, others[-1]
    start = replace(without_pose_noise(solution.state, problem.n_scans), camera_mm=np.zeros(len(field.prior_sigma_mm)))
    about = solve_clouds(thinned(replace(problem, camera_error=field), _THIN_POINTS), start, solution.noise)
    asked, *tried = try_families(about, [variants_of(model) for model in (problem.camera_error, *others)])
    errors: list[FloatArray] = [one.squared_errors_mm2 for one in (asked, *tried)]
    rms_mm = capped_rms_mm(errors)
    best = int(np.argmin(rms_mm))
    if simplest_of_the_best([errors[0], errors[best]]) == 0:
        return None
    return CameraMisfit(rms_mm[0], tried[best - 1].model.name, rms_mm[best])
