"""How well shots are predicted by a solve that never saw them: k folds over scans (METHOD.md 4, *Never certify*)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibrate import normal
from calibrate.assemble import subset, without_pose_noise
from calibrate.clouds import Solution, solve_clouds
from calibrate.normal import NoiseModel
from calibrate.problem import Geometry, Problem, State, linearise_geometry
from calibrate.sums import shot_moments
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

N_FOLDS = 10
_FOLD_TOLERANCE_MM = 1e-4
_LINEAR_MM = 0.2
"""Motion of a centre up to which the linearisation of the whole solve is good to a micrometre."""
_CENTRE_ROUNDS, _CENTRE_TOLERANCE_MM = 6, 1e-7
_LEAVE_ONE_OUT_BELOW = 30
_OPEN_MM = 5.0
"""How near a profile's centre is taken to be along the direction that it hardly shows."""


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """What other shots look like to a solved state; m shots, no pose noise taken out."""

    centre_error_mm: FloatArray
    """(m, 3) own fixed-radius centre minus the sphere's, base axes; NaN for line profiles."""
    centres_in_base_mm: FloatArray
    """(m, 3); NaN for line profiles."""
    sum_of_squares_mm2: FloatArray
    """(m,) of the radial residuals."""
    n_points: FloatArray
    """(m,)."""

    @property
    def centre_rms_mm(self) -> float:
        """Root of the mean squared distance of the shots' centres from their sphere's; NaN without any shot."""
        return np.nan if not len(self.centre_error_mm) else float(np.sqrt((self.centre_error_mm**2).sum(axis=1).mean()))

    @property
    def radial_rms_mm(self) -> float:
        """Over all points, each point equal."""
        return float(np.sqrt(self.sum_of_squares_mm2.sum() / self.n_points.sum()))


def predict(problem: Problem, state: State) -> Prediction:
    """Look at the shots of a problem with a state that another set of shots gave."""
    state = without_pose_noise(state, problem.n_scans)
    geometry = linearise_geometry(problem, state)
    _, counts = shot_moments(problem, state, geometry, np.inf)
    error = np.full((problem.n_shots, 3), np.nan)
    centres = error.copy()
    if problem.along_sight:
        centres = shot_centres_in_base_mm(problem, state, geometry)
        error = centres - state.centres_in_base_mm[problem.sphere]
    return Prediction(error, centres, counts[:, 1], counts[:, 2])


def shot_centres_in_base_mm(problem: Problem, state: State, geometry: Geometry) -> FloatArray:
    """(m, 3) fixed-radius centre of every shot's corrected points, each shot by itself."""
    centres = geometry.centre_in_camera_mm
    for _ in range(_CENTRE_ROUNDS):
        moments, _ = shot_moments(problem, state, replace(geometry, centre_in_camera_mm=centres), np.inf)
        # a cap that shows next to nothing of one direction must not throw its centre away
        information = moments[:, :3, :3] + 1e-9 * np.trace(moments[:, :3, :3], axis1=1, axis2=2)[:, None, None] * np.eye(3)
        step = np.linalg.solve(information, moments[:, :3, -1:])[..., 0]
        centres = centres + step
        if np.abs(step).max() < _CENTRE_TOLERANCE_MM:
            break
    return se3.apply(geometry.base_from_camera, centres)


def cross_validate(solution: Solution, n_folds: int = N_FOLDS, solve: Callable[[NDArray[np.int64]], State] | None = None) -> Prediction:
    """Every shot predicted by a solve without its fold; folds go by scan, and by pose where joints were repeated.

    The noise model of the whole solve is kept; nothing else of it is. Another solver gives, as `solve`, the state that it
    finds from the shots of some indices.
    """
    problem = solution.problem
    fold = folds_of(problem, n_folds)
    error = np.zeros((problem.n_shots, 3))
    centres, squares, n_points = error.copy(), np.zeros(problem.n_shots), np.zeros(problem.n_shots)
    for k in range(int(fold.max()) + 1):
        inside, outside = np.flatnonzero(fold == k), np.flatnonzero(fold != k)
        if not len(inside) or not set(problem.sphere[inside]) <= set(problem.sphere[outside]):
            inside_seen = inside[np.isin(problem.sphere[inside], problem.sphere[outside])]
            error[np.setdiff1d(inside, inside_seen)] = np.nan
            inside = inside_seen
        if not len(inside):
            continue
        state = _solved_on(solution, outside) if solve is None else solve(outside)
        found = predict(subset(problem, inside), state)
        error[inside], centres[inside] = found.centre_error_mm, found.centres_in_base_mm
        squares[inside], n_points[inside] = found.sum_of_squares_mm2, found.n_points
    seen = n_points > 0
    return Prediction(error[seen], centres[seen], squares[seen], n_points[seen])


def _solved_on(solution: Solution, keep: NDArray[np.int64]) -> State:
    """The state that some shots alone give: one step from the whole solution on their sums, or a solve where it leads far."""
    problem, geometry = solution.problem, solution.geometry
    if problem.external is None:
        training = subset(replace(problem, points_in_camera_mm=problem.points_in_camera_mm[:0], starts=np.zeros_like(problem.starts)), keep)
        state = replace(solution.state, pose_noise=solution.state.pose_noise[np.unique(problem.scan[keep])])
        weight = solution.noise.point_weight(np.diff(problem.starts).astype(np.float64), np.linalg.norm(geometry.centre_in_camera_mm, axis=1))
        linearised = normal.linearise(training, state, geometry.subset(keep), solution.moments[keep], weight[keep])
        step, noise_step = normal.solve_step(linearised, normal.reduce(linearised, solution.noise.pose_precision))
        if np.abs(geometry.columns[:, :3] @ step).max() < _LINEAR_MM:
            return state.moved(problem.layout, step, noise_step)
    training = subset(problem, keep)
    start = without_pose_noise(solution.state, training.n_scans)
    return solve_clouds(training, start, solution.noise, estimate_noise=False, tolerance_mm=_FOLD_TOLERANCE_MM).state


def folds_of(problem: Problem, n_folds: int) -> NDArray[np.int64]:
    """(m,) fold of every shot, spread evenly over the spheres; depends on the set of shots and not on their order.

    Shots of one scan, and shots taken at the same pose, stay together: they share their pose error.
    """
    pose = np.round(problem.base_from_flange[:, :3].reshape(problem.n_shots, 12), 6)
    _, group = np.unique(pose, axis=0, return_inverse=True)
    group = group.ravel()
    n_groups = int(group.max()) + 1
    n_folds = n_groups if n_groups < _LEAVE_ONE_OUT_BELOW else n_folds
    first_sphere = np.array([problem.sphere[group == g].min() for g in range(n_groups)])
    # groups are numbered by their pose, so a seeded shuffle of the numbers is the same for any order of the shots
    shuffled = np.random.default_rng(20230825).permutation(n_groups)
    order = shuffled[np.argsort(first_sphere[shuffled], kind="stable")]
    fold_of_group = np.zeros(n_groups, dtype=np.int64)
    fold_of_group[order] = np.arange(n_groups) % n_folds
    return np.asarray(fold_of_group[group])


def squared_errors_mm2(prediction: Prediction) -> FloatArray:
    """(m,) squared centre error of every shot, or mean squared radial residual for line profiles."""
    centre = (prediction.centre_error_mm**2).sum(axis=1)
    return np.asarray(np.where(np.isfinite(centre), centre, prediction.sum_of_squares_mm2 / prediction.n_points))


def shot_centre_covariance_mm2(problem: Problem, solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Covariance (m, 3, 3) of each shot's own centre from its points and pose noise, base axes, and what moves it.

    The second result (m, 3, P) is the motion of the shot's fixed-radius centre, less its sphere's, per unknown.
    """
    weight = solution.noise.point_weight(np.diff(problem.starts).astype(np.float64))
    inverse = np.asarray(np.linalg.inv(solution.moments[:, :3, :3]))
    return _covariance_and_sensitivity(solution.geometry, solution.moments, inverse, weight, solution.noise)


def judge_arcs(problem: Problem, solution: Solution) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """What of a centre each line profile shows: misses (m, 3), their covariance (m, 3, 3), what moves them (m, 3, P); base axes.

    The last result (m,) is the number of directions in which it does. An arc holds two directions of its centre well and the
    third hardly, so the miss is one step from the solution, held to some mm. Every point counts in full: the robust loss leaves
    a far arc without any, and so without a miss.
    """
    state = without_pose_noise(solution.state, problem.n_scans)
    geometry = linearise_geometry(problem, state)
    moments, _ = shot_moments(problem, state, geometry, np.inf)
    weight = solution.noise.point_weight(np.diff(problem.starts).astype(np.float64))
    inverse = np.asarray(np.linalg.inv(moments[:, :3, :3] + (_OPEN_MM**-2 / weight)[:, None, None] * np.eye(3)))
    miss = (geometry.base_from_camera[:, :3, :3] @ (inverse @ moments[:, :3, -1:]))[..., 0]
    directions = np.einsum("mij,mji->m", inverse, moments[:, :3, :3])
    return miss, *_covariance_and_sensitivity(geometry, moments, inverse, weight, solution.noise), directions


def _covariance_and_sensitivity(
    geometry: Geometry, moments: FloatArray, inverse: FloatArray, weight: FloatArray, noise: NoiseModel
) -> tuple[FloatArray, FloatArray]:
    """Of own centres, base axes; `inverse` (m, 3, 3) of their part of the moments (m, v, v)."""
    rotation = geometry.base_from_camera[:, :3, :3]
    centre = se3.apply(geometry.base_from_camera, geometry.centre_in_camera_mm)
    lever = se3.hat(centre - geometry.base_from_flange[:, :3, 3])
    pose = noise.pose_mm**2 * np.eye(3) + noise.pose_rad**2 * lever @ np.swapaxes(lever, -1, -2)
    points = rotation @ (inverse / weight[:, None, None]) @ np.swapaxes(rotation, -1, -2)
    sensitivity = rotation @ (inverse @ (moments[:, :3, :-1] @ geometry.columns))
    return points + pose, sensitivity
