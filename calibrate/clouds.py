"""The whole-cloud solver: Gauss-Newton on every point, pose noise estimated along the way (METHOD.md 4)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from calibrate import normal
from calibrate.external import ExternalRows, estimate_shared_noise, external_rows, joined
from calibrate.normal import Linearised, NoiseModel, Reduced
from calibrate.problem import Geometry, Problem, State, linearise_geometry
from calibrate.sums import ShotSums, shot_sums
from calibrate.variance import estimate_incidence, estimate_point_noise, estimate_pose_noise, estimate_range_growth
from drivers.errors import DataError
from drivers.kinematics.se3 import FloatArray

_FIRST_ESTIMATES, _LATER_ESTIMATES = 6, 3
"""Passes in which the noise model is estimated anew, from a rough start and from a good one; later ones hold it."""
_MORE_ESTIMATES, _STANDS_MM = 4, 2e-5
_FIRST_SWEEPS = 4
_STEP_TOLERANCE_MM = 1e-7
_STALL_TOLERANCE_MM = 1e-5
_PATIENCE, _LAST_TOLERANCE_MM = 25, 1e-3
"""A point that changes sides between two passes can keep a solve from its last digits: a micrometre is then enough."""
_AHEAD_POINTS = 700
"""Shots of many more points are first solved on about so many of each: most passes then cost next to nothing."""
_AHEAD_TOLERANCE_MM = 1e-4
_SLOWEST_RATE = 0.02
"""Step over the step before that is counted on where less was seen."""
_NEAR_MM = 0.05
"""Steps below which the robust loss is curved upwards nearly everywhere: Newton steps are then safe."""
_MAX_PASSES = 40
_WANDERS_AFTER, _WANDERS_MM = 3, 5.0
_HOLD, _HOLD_LONGER, _MORE_PASSES = 10.0, 12, 20
"""Shots that leave directions open (all from one place) let a solve wander along them. It is then begun again with every unknown
held where it is by so many times the precision of its physical size, later by ten times that: determined ones hardly feel it."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where the solve ended, and what the data say about it."""

    problem: Problem
    state: State
    noise: NoiseModel
    linearised: Linearised
    reduced: Reduced
    geometry: Geometry
    moments: FloatArray
    point_rms_mm: FloatArray
    """(m,) rms radial residual of each shot with its pose noise taken out."""
    passes: int
    held: bool = False
    """Whether unknowns had to be held back: what is left open by the shots stands near its first guess."""

    @property
    def covariance(self) -> FloatArray:
        """(P, P) of the unknowns, pose noise included; deflection terms that were held are considered.

        With S = -inv(H_xx) H_xc the estimate of the others follows a deflection c by S c (Schmidt 1966), so that their
        covariance is inv(H_xx) + S Q S' and the cross covariance S Q, Q the prior of c.
        """
        layout = self.problem.layout
        held = np.zeros(layout.size, dtype=bool)
        held[layout.terms] = ~self.problem.free_terms
        if not held.any():
            return normal.symmetric_inverse(self.reduced.hessian)
        free = ~held
        inverse = normal.symmetric_inverse(self.reduced.hessian[np.ix_(free, free)])
        follows = -inverse @ self.reduced.hessian[np.ix_(free, held)]
        variance = self.problem.priors.term_sigma_rad(self.problem.terms)[~self.problem.free_terms] ** 2
        result = np.zeros((layout.size, layout.size))
        result[np.ix_(free, free)] = inverse + follows * variance @ follows.T
        result[np.ix_(free, held)] = follows * variance
        result[np.ix_(held, free)] = (follows * variance).T
        result[np.ix_(held, held)] = np.diag(variance)
        return result


def solve_clouds(
    problem: Problem, start: State, noise: NoiseModel, *, estimate_noise: bool = True, tolerance_mm: float = _STEP_TOLERANCE_MM
) -> Solution:
    """Minimise the whole-cloud cost from a start that is good to some millimetres.

    Without `estimate_noise` the noise model is taken as given.

    Raises DataError when the passes do not settle, which means that data and model do not belong together.
    """
    n_estimates = _FIRST_ESTIMATES if estimate_noise else 0
    if len(problem.points_in_camera_mm) <= 2 * _AHEAD_POINTS * problem.n_shots:
        return _descend(problem, start, noise, n_estimates, tolerance_mm)
    ahead = _descend(thinned(problem, _AHEAD_POINTS), start, noise, n_estimates, _AHEAD_TOLERANCE_MM)
    return _descend(problem, ahead.state, ahead.noise, min(n_estimates, _LATER_ESTIMATES), tolerance_mm)


def thinned(problem: Problem, n_points: int) -> Problem:
    """The problem with about so many points a shot (up to twice as many), evenly through it."""
    pieces = [np.arange(a, b, max(1, (b - a) // n_points)) for a, b in itertools.pairwise(problem.starts)]
    starts = np.concatenate([[0], np.cumsum([len(piece) for piece in pieces])]).astype(np.int64)
    return replace(problem, points_in_camera_mm=problem.points_in_camera_mm[np.concatenate(pieces)], starts=starts)


def _descend(problem: Problem, state: State, noise: NoiseModel, n_estimates: int, tolerance_mm: float) -> Solution:
    """Descend freely; where that wanders off or does not settle, once more from the start with every unknown held back."""
    for hold in (0.0, _HOLD):
        found = _passes(problem, state, noise, n_estimates, tolerance_mm, hold)
        if found is not None:
            return found
    raise DataError(
        f"the solve did not settle in {_MAX_PASSES} passes",
        remedy="Check that the robot model, the spheres and the scans belong together; `spherecal centres` shows each shot.",
    )


def _passes(problem: Problem, state: State, noise: NoiseModel, n_estimates: int, tolerance_mm: float, hold: float) -> Solution | None:
    """Gauss-Newton, Newton in the robust loss; the noise model is estimated in the first passes and held afterwards."""
    rough, step_mm, physical = n_estimates == _FIRST_ESTIMATES, np.inf, normal.physical_precision(problem)
    for passes in range(1, _MAX_PASSES + (_MORE_PASSES if hold else 0) + 1):
        geometry, rows = linearise_geometry(problem, state), external_rows(problem, state)
        # held only once the state stands: what the noise model is must not depend on where the solve began
        estimating = passes <= n_estimates or (0 < n_estimates < passes <= n_estimates + _MORE_ESTIMATES and step_mm > _STANDS_MM)
        first = rough and passes == 1
        sums = shot_sums(problem, state, geometry, None if first else noise, patches=estimating)
        if estimating:
            sweeps = None if first else _FIRST_SWEEPS if rough and passes == 2 else 0
            noise = _estimate_noise(problem, state, geometry, sums, rows, noise, sweeps=sweeps)
        damping = hold * 10.0 ** (passes // _HOLD_LONGER) * physical if hold else None
        near = step_mm < _NEAR_MM and not hold
        curved = _sums_of_all(problem, state, geometry, sums, sums.curved_moments if near else sums.moments, rows, noise)
        step, noise_step = normal.solve_step(curved, normal.reduce(curved, noise.pose_precision), damping)
        step[problem.layout.terms] *= problem.free_terms  # the prior that holds the others leaves 1e-20 of them
        previous_mm, step_mm = step_mm, _size_mm(geometry, rows, step)
        if not estimating and _settled(step_mm, previous_mm, passes, tolerance_mm):
            linearised = _sums_of_all(problem, state, geometry, sums, sums.moments, rows, noise)
            reduced = normal.reduce(linearised, noise.pose_precision)
            state = state.moved(problem.layout, step, noise_step)
            return Solution(problem, state, noise, linearised, reduced, geometry, sums.moments, sums.point_rms_mm, passes, hold > 0.0)
        if passes > _WANDERS_AFTER and step_mm > _WANDERS_MM and not hold:
            return None
        state = state.moved(problem.layout, step, noise_step)
    return None


def _settled(step_mm: float, previous_mm: float, passes: int, tolerance_mm: float) -> bool:
    """Whether all steps to come are within the tolerance, judged by how fast they shrink."""
    rate = max(step_mm / previous_mm, _SLOWEST_RATE) if previous_mm else _SLOWEST_RATE
    if rate < 1.0 and step_mm < _LAST_TOLERANCE_MM and step_mm * rate / (1.0 - rate) < tolerance_mm:
        return True
    # rounding ends the descent of nearly noise-free data some digits above the tolerance
    return step_mm < (_STALL_TOLERANCE_MM if passes < _PATIENCE else _LAST_TOLERANCE_MM) and step_mm > 0.3 * previous_mm


def _sums_of_all(
    problem: Problem, state: State, geometry: Geometry, sums: ShotSums, moments: FloatArray, rows: ExternalRows | None, noise: NoiseModel
) -> Linearised:
    linearised = normal.linearise(problem, state, geometry, moments, sums.weight(noise))
    return linearised if rows is None else joined(linearised, rows, noise)


def _estimate_noise(
    problem: Problem, state: State, geometry: Geometry, sums: ShotSums, rows: ExternalRows | None, noise: NoiseModel, *, sweeps: int | None
) -> NoiseModel:
    """Points first, then poses: in so many sweeps of parabolas, by Newton steps for 0, not at all for None."""
    if problem.n_shots:
        noise = estimate_point_noise(sums.patches, noise)
        if problem.along_sight and sweeps is not None:
            noise = estimate_range_growth(sums.patches, sums.range_mm, estimate_incidence(sums.patches, noise))
    if sweeps is None:
        return noise
    spheres = normal.linearise(problem, state, geometry, sums.moments, sums.weight(noise))
    return _estimate_pose_noise(spheres, rows, noise, sweeps=sweeps)


def _estimate_pose_noise(spheres: Linearised, rows: ExternalRows | None, noise: NoiseModel, *, sweeps: int) -> NoiseModel:
    if rows is None:
        return estimate_pose_noise(spheres, noise, sweeps=sweeps)
    return estimate_shared_noise(spheres, rows, noise, sweeps=sweeps)


def _size_mm(geometry: Geometry, rows: ExternalRows | None, step: FloatArray) -> float:
    """Largest motion of any expected centre or external point that a step causes: gauge directions do not count."""
    motion_mm = [geometry.columns[:, :3] @ step] + ([] if rows is None else [rows.columns @ step])
    return max(float(np.abs(part).max(initial=0.0)) for part in motion_mm)
