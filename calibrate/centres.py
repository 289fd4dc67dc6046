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
from calibrate.assemble import subset
from calibrate.clouds import Solution, thinned
from calibrate.normal import NoiseModel
from calibrate.problem import Geometry, Problem, State, expected_radius_mm, linearise_geometry, without_terms
from calibrate.sums import ShotSums, shot_sums
from calibrate.validation import Prediction, cross_validate
from calibrate.variance import estimate_incidence, estimate_point_noise, estimate_pose_noise, estimate_range_growth
from drivers.errors import DataError, SettingsError
from drivers.kinematics.se3 import FloatArray

_FIT_TOLERANCE_MM = 1e-9
_NOISE_TOLERANCE = 1e-6
_LOOSE = 1e-6
_LEAST_SHARE, _LEVER_MM = 1e-3, 500.0
_MAX_FIT_PASSES = 25
_STEP_TOLERANCE_MM = 1e-5
"""Of a Gauss-Newton step: what is left after it is its square over the size of the cell, 1e-12 mm."""
_ROUND_TOLERANCE_MM = 1e-7
"""Of a round, of which the next moves a tenth or less."""
_MAX_STEPS = 30
_MAX_ROUNDS = 25
_MOST_ESTIMATES, _LATER_ESTIMATES = 6, 3
"""Rounds in which the noise model may be estimated anew; later ones hold it, so that the descent can end."""
_SWEEPS = (2, 1, 1, 0)
"""Of the search for the pose noise, round by round: what it ends in must not depend on where the solve began, and the Newton
steps of the last ones cost twice what a sweep does."""
_IN_PLACE_MM = 0.05
_AHEAD_POINTS = 500
"""Points a shot on which shots of many points are solved first."""


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
    n_points: FloatArray
    """(m,)."""
    point_rms_mm: FloatArray
    """(m,) rms radial residual about each shot's own centre."""

    def weight(self, noise: NoiseModel) -> FloatArray:
        """(m,) weight in mm^-2 of one point of each shot."""
        return noise.point_weight(self.n_points, np.linalg.norm(self.centre_in_camera_mm, axis=1))

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
            centre_in_camera_mm=self.centre_in_camera_mm[keep],
            information=self.information[keep],
            follows=self.follows[keep],
            camera_mm=self.camera_mm,
            radius_mm=self.radius_mm[keep],
            n_points=self.n_points[keep],
            point_rms_mm=self.point_rms_mm[keep],
        )


def fit_centres(
    problem: Problem, state: State, geometry: Geometry, noise: NoiseModel | None, tolerance_mm: float = _FIT_TOLERANCE_MM, *, patches: bool = False
) -> tuple[CentreFits, ShotSums]:
    """Fit every shot's centre to its corrected points, from where `geometry` expects it.

    Points are weighted by incidence and robust loss as the noise model says, or all alike without one. Also returns the
    sums of the last pass, by patch where asked for.

    Raises DataError where the points of a shot leave its centre open.
    """
    for _ in range(_MAX_FIT_PASSES):
        sums = shot_sums(problem, state, geometry, noise, patches=patches)
        information = sums.moments[:, :3, :3]
        _check_fixed(information)
        step = np.linalg.solve(sums.curved_moments[:, :3, :3], sums.moments[:, :3, -1:])[..., 0]
        geometry = replace(geometry, centre_in_camera_mm=geometry.centre_in_camera_mm + step)
        if np.abs(step).max() < tolerance_mm:
            break
    fits = CentreFits(
        centre_in_camera_mm=geometry.centre_in_camera_mm,
        information=information,
        follows=np.asarray(np.linalg.solve(information, sums.moments[:, :3, 3:-1])),
        camera_mm=state.camera_mm,
        radius_mm=expected_radius_mm(problem, state),
        n_points=sums.counts[:, 2],
        point_rms_mm=sums.point_rms_mm,
    )
    return fits, sums


def _check_fixed(information: FloatArray) -> None:
    """A cap so small that it looks flat moves freely across the line of sight."""
    values = np.linalg.eigvalsh(information)
    n_loose = int((values[:, 0] < _LOOSE * values[:, 2]).sum())
    if n_loose:
        raise DataError(
            f"the points of {n_loose} of {len(information)} shots leave their sphere's centre open",
            remedy="Use --method clouds, which needs no centres.",
        )


def require_centres(problem: Problem) -> None:
    """Raise SettingsError for line profiles, of which one leaves its sphere's centre open."""
    if not problem.along_sight:
        raise SettingsError("one line profile leaves its sphere's centre open: there are no centres to solve on", remedy="Use --method clouds.")


def solve_centres(problem: Problem, start: State, noise: NoiseModel) -> Solution:
    """Minimise the cost on centres from a start that is good to some millimetres; the noise model is estimated on the way.

    Raises:
        SettingsError: line profiles, of which one leaves its sphere's centre open.
        DataError: the rounds do not settle, which means that data and model do not belong together.
    """
    require_centres(problem)
    rigid, begin = (problem, start) if problem.free_terms.any() else (without_terms(problem), replace(start, terms_rad=start.terms_rad[:0]))
    if len(problem.points_in_camera_mm) <= 2 * _AHEAD_POINTS * problem.n_shots:
        found, fits = _rounds(rigid, begin, noise, ahead=False)
    else:
        ahead, _ = _rounds(thinned(rigid, _AHEAD_POINTS), begin, noise, ahead=False)
        found, fits = _rounds(rigid, ahead.state, ahead.noise, ahead=True)
    return found if rigid is problem else _with_held_terms(found, fits, problem)


def _with_held_terms(found: Solution, fits: CentreFits, problem: Problem) -> Solution:
    """A solution without terms as one that knows them: they stand at zero, and only the covariance tells of them."""
    state = replace(found.state, terms_rad=np.zeros(len(problem.terms)))
    geometry = linearise_geometry(problem, state)
    moments = fits.moments(problem, state, geometry)
    linearised = normal.linearise(problem, state, geometry, moments, fits.weight(found.noise))
    reduced = normal.reduce(linearised, found.noise.pose_precision)
    return Solution(problem, state, found.noise, linearised, reduced, geometry, moments, found.point_rms_mm, found.passes)


def _rounds(problem: Problem, state: State, noise: NoiseModel, *, ahead: bool) -> tuple[Solution, CentreFits]:
    """Fit and solve in turns until neither moves a centre; `ahead` where state and noise are good already."""
    geometry = linearise_geometry(problem, state)
    known, n_estimates = (noise, _LATER_ESTIMATES) if ahead else (None, _MOST_ESTIMATES)
    for passes in range(1, _MAX_ROUNDS + 1):
        estimating = passes <= n_estimates
        # one pass a round, from where the last fit is expected, but for the first
        fits, sums = fit_centres(problem, state, geometry, known, _IN_PLACE_MM if known is None else np.inf, patches=estimating)
        before, expected = noise, geometry.centre_in_camera_mm
        if estimating:
            noise = _point_noise(sums, noise, first=known is None)
        sweeps = _SWEEPS[min(passes, len(_SWEEPS)) - 1 if not ahead else -1] if estimating else None
        solution = _solve_on(fits, problem, state, noise, sweeps=sweeps, in_place=known is not None)
        state, noise = solution.state, solution.noise
        geometry, known = replace(solution.geometry, centre_in_camera_mm=fits.centres_at(problem, state)), noise
        moved_mm = float(np.abs(geometry.centre_in_camera_mm - expected).max())
        if not estimating and moved_mm < _ROUND_TOLERANCE_MM:
            return replace(solution, passes=passes), fits
        if passes > 1 and _settled(before, noise):
            n_estimates = passes
    raise DataError(
        f"the solve did not settle in {_MAX_ROUNDS} rounds (last change of a centre {moved_mm:.2g} mm)",
        remedy="Check that the robot model, the spheres and the scans belong together; `spherecal centres` shows each shot.",
    )


def cross_validate_centres(solution: Solution) -> Prediction:
    """Every shot predicted by a solve on the centres of the others; these are not fitted anew, they follow the camera."""
    problem, noise = solution.problem, solution.noise
    fits = fits_of_solution(solution)
    blind = replace(problem, points_in_camera_mm=problem.points_in_camera_mm[:0], starts=np.zeros_like(problem.starts))
    terms_rad = solution.state.terms_rad
    held = not problem.free_terms.any()
    blind = without_terms(blind) if held else blind

    def without(keep: NDArray[np.int64]) -> State:
        training = subset(blind, keep)
        pose_noise = solution.state.pose_noise[np.unique(problem.scan[keep])]
        start = replace(solution.state, pose_noise=pose_noise, terms_rad=terms_rad[:0] if held else terms_rad)
        found = _solve_on(fits.subset(keep), training, start, noise).state
        return replace(found, terms_rad=terms_rad) if held else found

    return cross_validate(solution, solve=without)


def fits_of_solution(solution: Solution) -> CentreFits:
    """The fits that a solution on centres ended with: its moments hold them whole."""
    information = solution.moments[:, :3, :3]
    rest = np.linalg.solve(information, solution.moments[:, :3, 3:])
    return CentreFits(
        centre_in_camera_mm=solution.geometry.centre_in_camera_mm + rest[..., -1],
        information=information,
        follows=np.asarray(rest[..., :-1]),
        camera_mm=solution.state.camera_mm,
        radius_mm=expected_radius_mm(solution.problem, solution.state),
        n_points=np.diff(solution.problem.starts).astype(np.float64),
        point_rms_mm=solution.point_rms_mm,
    )


def _point_noise(sums: ShotSums, noise: NoiseModel, *, first: bool) -> NoiseModel:
    found = estimate_point_noise(sums.patches, noise)
    if not first:
        found = estimate_range_growth(sums.patches, sums.range_mm, estimate_incidence(sums.patches, found))
    # centres of noise-free points are known so well beside poses that the elimination of these would drown in rounding
    return replace(found, point_mm=max(found.point_mm, _LEAST_SHARE * max(noise.pose_mm, _LEVER_MM * noise.pose_rad)))


def _solve_on(
    fits: CentreFits,
    problem: Problem,
    state: State,
    noise: NoiseModel,
    *,
    sweeps: int | None = None,
    in_place: bool = True,
) -> Solution:
    """Gauss-Newton on centres alone; while sweeps estimate the pose noise (0: Newton steps) the last digits are left to a later round.

    The pose noise is not estimated before the state is in place: until then all that the start is off would be noise.
    """
    weight = fits.weight(noise)
    for _ in range(_MAX_STEPS):
        geometry = linearise_geometry(problem, state)
        moments = fits.moments(problem, state, geometry)
        linearised = normal.linearise(problem, state, geometry, moments, weight)
        if sweeps is not None and in_place:
            noise = estimate_pose_noise(linearised, noise, sweeps=sweeps)
        reduced = normal.reduce(linearised, noise.pose_precision)
        step, noise_step = normal.solve_step(linearised, reduced)
        state = state.moved(problem.layout, step, noise_step)
        step_mm = float(np.abs(geometry.columns[:, :3] @ step).max())
        if (sweeps is not None and in_place) or step_mm < _STEP_TOLERANCE_MM:
            break
        in_place = step_mm < _IN_PLACE_MM
    return Solution(problem, state, noise, linearised, reduced, geometry, moments, fits.point_rms_mm, 0)


def _settled(before: NoiseModel, after: NoiseModel) -> bool:
    """Whether another estimate of the noise would change it by less than matters."""
    pairs = ((before.point_mm, after.point_mm), (before.pose_mm, after.pose_mm), (before.pose_rad, after.pose_rad))
    return all(abs(a / b - 1.0) < _NOISE_TOLERANCE for a, b in pairs)
