"""The light path, `--method centres`: one fixed-radius centre a shot, then a joint solve on centres (METHOD.md 3 and 4).

A depth error bends a cap as well as shifting it, so the camera correction acts on the points: centres are fitted to
corrected points with the certified radius and its offset, and fitted again after every solve. Between two fits a centre
follows the camera coefficients k and the radius r as the normal equations of its fit say,

    centre(k, r) = centre + inv(N) sum_i u_i (u_i . basis_i (k - k0) - (r - r0)),   N = sum_i u_i u_i',

so that a shot of any number of points becomes a centre (3,), its information N (3, 3) and its motion (3, k + 1). What the
whole-cloud solver has beyond this is what the shape of a cap tells of camera and radius; all else, from priors to the
pose noise and the covariance, is the same machinery on the same unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibrate import normal
from calibrate.assemble import subset, without_pose_noise
from calibrate.clouds import Solution
from calibrate.normal import NoiseModel
from calibrate.problem import Geometry, Problem, State, expected_radius_mm, linearise_geometry
from calibrate.sums import POINT_CUTOFF_SIGMAS, patch_sums, shot_moments
from calibrate.validation import Prediction, cross_validate
from calibrate.variance import estimate_point_noise, estimate_pose_noise
from drivers.errors import DataError, SettingsError
from drivers.kinematics.se3 import FloatArray

_FIT_TOLERANCE_MM = 1e-9
_ROUGH_TOLERANCE_MM = 1e-4
_NOISE_TOLERANCE = 1e-3
_LOOSE = 1e-6
_LEAST_SHARE, _LEVER_MM = 1e-3, 500.0
_MAX_FIT_PASSES = 25
_STEP_TOLERANCE_MM = 1e-9
_ROUND_TOLERANCE_MM = 1e-8
_FOLD_TOLERANCE_MM = 1e-4
_MAX_STEPS = 30
_MAX_ROUNDS = 25
_LAST_ESTIMATE = 6
"""Rounds in which the noise model is estimated anew; later ones hold it, so that the descent can end."""
_IN_PLACE_MM, _LATER_SWEEPS = 0.05, 2


@dataclass(frozen=True, slots=True, eq=False)
class CentreFits:
    """Fixed-radius centres of m shots, and how they follow the k camera coefficients and the radius."""

    centre_in_camera_mm: FloatArray
    """(m, 3) at `camera_mm` and `radius_mm`."""
    information: FloatArray
    """(m, 3, 3) sum of u u' over the points: times the weight of a point, the inverse of a centre's covariance."""
    follows: FloatArray
    """(m, 3, k + 1): motion of a centre per camera coefficient, and per mm of radius."""
    camera_mm: FloatArray
    """(k,) of the correction that the points had."""
    radius_mm: FloatArray
    """(m,) that was held."""
    counts: FloatArray
    """(m, 3): sum of the weights, of the squared residuals, number of points."""

    @property
    def point_rms_mm(self) -> FloatArray:
        """(m,) rms radial residual about each shot's own centre."""
        return np.asarray(np.sqrt(self.counts[:, 1] / self.counts[:, 2]))

    def centres_at(self, problem: Problem, state: State) -> FloatArray:
        """(m, 3) where the fits would be at a state, to first order."""
        change = np.column_stack([
            np.broadcast_to(state.camera_mm - self.camera_mm, (len(self.radius_mm), len(self.camera_mm))),
            expected_radius_mm(problem, state) - self.radius_mm,
        ])  # fmt: skip
        return self.centre_in_camera_mm + (self.follows @ change[..., None])[..., 0]

    def moments(self, problem: Problem, state: State, geometry: Geometry) -> FloatArray:
        """(m, v, v) moment matrices as of points that know their centre as well as the fits do, and no shape."""
        miss = self.centres_at(problem, state) - geometry.centre_in_camera_mm
        size = self.follows.shape[-1] + 4
        rows = np.zeros((len(miss), 3, size))
        rows[:, :, :3] = np.eye(3)
        rows[:, :, 3:-1] = self.follows
        rows[:, :, -1] = miss
        return np.asarray(np.swapaxes(rows, 1, 2) @ self.information @ rows)

    def subset(self, keep: NDArray[np.int64]) -> CentreFits:
        """The fits of some shots (indices)."""
        return CentreFits(
            self.centre_in_camera_mm[keep], self.information[keep], self.follows[keep], self.camera_mm, self.radius_mm[keep], self.counts[keep]
        )


def fit_centres(problem: Problem, state: State, geometry: Geometry, cutoff_mm: float, tolerance_mm: float = _FIT_TOLERANCE_MM) -> CentreFits:
    """Fit every shot's centre to its corrected points, from where `geometry` expects it.

    Points beyond the cutoff weigh next to nothing, as in the whole-cloud solver.

    Raises DataError where the points of a shot leave its centre open.
    """
    for _ in range(_MAX_FIT_PASSES):
        moments, counts = shot_moments(problem, state, geometry, cutoff_mm)
        information = moments[:, :3, :3]
        _check_fixed(problem, information)
        solved = np.linalg.solve(information, moments[:, :3, 3:])
        geometry = replace(geometry, centre_in_camera_mm=geometry.centre_in_camera_mm + solved[..., -1])
        if np.abs(solved[..., -1]).max() < tolerance_mm:
            break
    return CentreFits(
        centre_in_camera_mm=geometry.centre_in_camera_mm,
        information=information,
        follows=np.asarray(solved[..., :-1]),
        camera_mm=state.camera_mm,
        radius_mm=expected_radius_mm(problem, state),
        counts=counts,
    )


def _check_fixed(problem: Problem, information: FloatArray) -> None:
    """A cap so small that it looks flat moves freely across the line of sight."""
    values = np.linalg.eigvalsh(information)
    loose = np.flatnonzero(values[:, 0] < _LOOSE * values[:, 2])
    if len(loose):
        raise DataError(
            f"the points of {len(loose)} of {problem.n_shots} shots leave their sphere's centre open",
            remedy="Use --method clouds, which needs no centres.",
        )


def solve_centres(problem: Problem, start: State, noise: NoiseModel) -> Solution:
    """Minimise the cost on centres from a start that is good to some millimetres; the noise model is estimated on the way.

    Raises:
        SettingsError: line profiles, of which one leaves its sphere's centre open.
        DataError: the rounds do not settle, which means that data and model do not belong together.
    """
    if not problem.along_sight:
        raise SettingsError("one line profile leaves its sphere's centre open: there are no centres to solve on", remedy="Use --method clouds.")
    state, cutoff, estimating = start, np.inf, True
    geometry = linearise_geometry(problem, state)
    for passes in range(1, _MAX_ROUNDS + 1):
        fits = fit_centres(problem, state, geometry, cutoff, _ROUGH_TOLERANCE_MM if estimating else _FIT_TOLERANCE_MM)
        expected, before = fits.centres_at(problem, state), noise
        if estimating:
            noise = _point_noise(problem, state, geometry, fits, cutoff, noise)
            cutoff = POINT_CUTOFF_SIGMAS * float(np.hypot(noise.point_mm, noise.form_mm))
        solution = _solve_on(fits, problem, state, noise, estimate_noise=estimating)
        state, noise = solution.state, solution.noise
        geometry = replace(solution.geometry, centre_in_camera_mm=fits.centres_at(problem, state))
        moved_mm = float(np.abs(geometry.centre_in_camera_mm - expected).max())
        if not estimating and moved_mm < _ROUND_TOLERANCE_MM:
            return replace(solution, passes=passes)
        estimating = passes < _LAST_ESTIMATE and not (passes > 1 and _settled(before, noise))
    raise DataError(
        f"the solve did not settle in {_MAX_ROUNDS} rounds (last change of a centre {moved_mm:.2g} mm)",
        remedy="Check that the robot model, the spheres and the scans belong together; `spherecal centres` shows each shot.",
    )


def cross_validate_centres(solution: Solution) -> Prediction:
    """Every shot predicted by a solve on the centres of the others; these are not fitted anew, they follow the camera."""
    problem, noise = solution.problem, solution.noise
    cutoff = POINT_CUTOFF_SIGMAS * float(np.hypot(noise.point_mm, noise.form_mm))
    fits = fit_centres(problem, solution.state, solution.geometry, cutoff, _FIT_TOLERANCE_MM)

    def without(keep: NDArray[np.int64]) -> State:
        training = subset(problem, keep)
        start = without_pose_noise(solution.state, training.n_scans)
        return _solve_on(fits.subset(keep), training, start, noise, estimate_noise=False, tolerance_mm=_FOLD_TOLERANCE_MM).state

    return cross_validate(solution, solve=without)


def _point_noise(problem: Problem, state: State, geometry: Geometry, fits: CentreFits, cutoff_mm: float, noise: NoiseModel) -> NoiseModel:
    at_fits = replace(geometry, centre_in_camera_mm=fits.centre_in_camera_mm)
    found = estimate_point_noise(patch_sums(problem, state, at_fits, cutoff_mm), noise)
    # centres of noise-free points are known so well beside poses that the elimination of these would drown in rounding
    return replace(found, point_mm=max(found.point_mm, _LEAST_SHARE * max(noise.pose_mm, _LEVER_MM * noise.pose_rad)))


def _solve_on(
    fits: CentreFits, problem: Problem, state: State, noise: NoiseModel, *, estimate_noise: bool, tolerance_mm: float = _STEP_TOLERANCE_MM
) -> Solution:
    """Gauss-Newton on centres alone; while the noise is estimated the last digits are left to a later round."""
    weight = noise.point_weight(fits.counts[:, 2])
    step_mm = np.inf
    for _ in range(_MAX_STEPS):
        geometry = linearise_geometry(problem, state)
        moments = fits.moments(problem, state, geometry)
        linearised = normal.linearise(problem, state, geometry, moments, weight)
        # not before the state has found its place: until then all that the start is off would be noise
        if estimate_noise and step_mm < _IN_PLACE_MM:
            noise = estimate_pose_noise(linearised, noise, sweeps=_LATER_SWEEPS)
        reduced = normal.reduce(linearised, noise.pose_precision)
        if step_mm < (_ROUGH_TOLERANCE_MM if estimate_noise else tolerance_mm):
            break
        step, noise_step = normal.solve_step(linearised, reduced)
        state = state.moved(problem.layout, step, noise_step)
        step_mm = float(np.abs(geometry.columns[:, :3] @ step).max())
    return Solution(problem, state, noise, linearised, reduced, geometry, moments, fits.point_rms_mm, 0)


def _settled(before: NoiseModel, after: NoiseModel) -> bool:
    """Whether another estimate of the noise would change it by less than matters."""
    pairs = ((before.point_mm, after.point_mm), (before.pose_mm, after.pose_mm), (before.pose_rad, after.pose_rad))
    return all(abs(a / b - 1.0) < _NOISE_TOLERANCE for a, b in pairs)
