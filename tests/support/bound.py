"""What a solve can reach at best on given shots, and what it reached: held-out centre rms against its first-order bound.

The bound is the inverse information of the shots (every point with its true depth noise, every shot with its true pose
noise, priors of physical size), carried to the fixed-radius centres of other shots, about their mean: no estimator that
is unbiased can do better. It uses its own sums over points and dense matrices, nothing of the solver's moments.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibrate.assemble import without_pose_noise
from calibrate.camera_error import CameraError, PillowError
from calibrate.clouds import Solution, solve_clouds
from calibrate.normal import NoiseModel
from calibrate.problem import Problem, State, linearise_geometry
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from tests.support.solving import draw_shots, noise_free, one_thread, point_rows, problem_of, start_of
from tests.support.synthetic import paper_cell

DEPTH_NOISE_MM = 0.08
POSE_NOISE_MM, POSE_NOISE_RAD = 0.01, 1e-4
FIRST_NOISE = NoiseModel(point_mm=0.1, pose_mm=2.0, pose_rad=3e-3)
"""What a solve may assume before it has seen anything."""
_GRAZING = 0.3
"""A point whose normal lies across the sight would know its place along the normal without noise: nobody believes it."""


@dataclass(frozen=True)
class Recovery:
    """One solve on shots whose truth is known."""

    held_out_rms_mm: float
    bound_mm: float
    solution: Solution

    @property
    def ratio(self) -> float:
        """1 is the best there is; single seeds scatter about it by a fifth."""
        return self.held_out_rms_mm / self.bound_mm


def recover(
    seed: int,
    *,
    coupled: bool = False,
    n_shots: int = 100,
    n_points: int = 1000,
    n_tests: int = 60,
    camera_error: CameraError | None = None,
) -> Recovery:
    """METHOD.md 4's reference: the paper's camera and Table 1's errors, a guess 2 mm and 7 mrad off."""
    cell, rng = paper_cell(coupled), np.random.default_rng(seed)
    camera = camera_error or PillowError()
    problem = problem_of(cell, draw_shots(cell, rng, n_shots, n_points=n_points), camera)
    test = problem_of(cell, noise_free(cell, rng, n_tests, n_points=n_points), camera)
    with one_thread():
        solution = solve_clouds(problem, start_of(problem, cell, rng), FIRST_NOISE)
        return Recovery(held_out_rms_mm(test, solution.state), bound_mm(solution.problem, solution.state, test), solution)


def held_out_rms_mm(test: Problem, state: State) -> float:
    """Rms distance of the test shots' fixed-radius centres from their mean, in the base."""
    centres = fixed_radius_centres_in_base_mm(test, state)
    return float(np.sqrt(((centres - centres.mean(axis=0)) ** 2).sum(axis=1).mean()))


def fixed_radius_centres_in_base_mm(test: Problem, state: State) -> FloatArray:
    """(m, 3), each shot by itself, by Gauss-Newton on plain radial residuals of its corrected points."""
    state = without_pose_noise(state, test.n_scans)
    geometry = linearise_geometry(test, state)
    radius = test.radius_mm + state.radius_offset_mm + state.sphere_radius_deviation_mm
    centres = geometry.centre_in_camera_mm.copy()
    for j in range(test.n_shots):
        piece = slice(test.starts[j], test.starts[j + 1])
        measured = test.points_in_camera_mm[piece]
        corrected = measured.copy()
        basis = test.camera_error.basis(measured)
        for k, axis in enumerate(test.camera_error.axis):
            corrected[:, axis] += state.camera_mm[k] * basis[:, k]
        for _ in range(8):
            away = corrected - centres[j]
            distance = np.linalg.norm(away, axis=1)
            centres[j] += np.linalg.lstsq(away / distance[:, None], distance - radius[test.sphere[j]], rcond=None)[0]
    return se3.apply(geometry.base_from_camera, centres)


def bound_mm(problem: Problem, state: State, test: Problem) -> float:
    """First-order rms of `held_out_rms_mm` for the best estimator from the shots of a problem."""
    covariance = np.linalg.pinv(information(problem, state), rcond=1e-15, hermitian=True)
    sensitivity = centre_sensitivity(test, state)
    sensitivity = sensitivity - sensitivity.mean(axis=0)
    return float(np.sqrt(np.einsum("mij,jk,mik->", sensitivity, covariance, sensitivity) / test.n_shots))


def information(problem: Problem, state: State) -> FloatArray:
    """(P, P) of the unknowns from points with their own depth noise, pose noise eliminated, priors added."""
    state = replace(state, pose_noise=np.zeros_like(state.pose_noise))
    geometry = linearise_geometry(problem, state)
    rows = point_rows(problem, state, geometry)
    pose = np.diag([POSE_NOISE_MM**-2] * 3 + [POSE_NOISE_RAD**-2] * 3)
    result = np.diag(prior_precision(problem))
    for j in range(problem.n_shots):
        v = rows[problem.starts[j] : problem.starts[j + 1]]
        v = v / (DEPTH_NOISE_MM * np.maximum(np.abs(v[:, 2:3]), _GRAZING))
        unknowns, nuisance = v[:, :-1] @ geometry.columns[j], v[:, :3] @ geometry.noise_columns[j]
        cross = nuisance.T @ unknowns
        result = result + unknowns.T @ unknowns - cross.T @ np.linalg.solve(nuisance.T @ nuisance + pose, cross)
    return np.asarray(result)


def prior_precision(problem: Problem) -> FloatArray:
    """(P,) inverse variances of what is believed before any data."""
    layout, result = problem.layout, np.zeros(problem.layout.size)
    result[layout.links] = np.tile([problem.priors.link_rho_mm**-2] * 3 + [problem.priors.link_phi_rad**-2] * 3, layout.n_links)
    result[layout.camera] = problem.camera_error.prior_sigma_mm**-2.0
    result[layout.radius_offset] = problem.priors.radius_offset_mm**-2
    result[layout.sphere_radius] = problem.radius_sigma_mm**-2.0
    return result


def centre_sensitivity(test: Problem, state: State) -> FloatArray:
    """(m, 3, P): how each test shot's own centre in the base moves with the unknowns; it does not know the sphere's."""
    state = without_pose_noise(state, test.n_scans)
    geometry = linearise_geometry(test, state)
    rows = point_rows(test, state, geometry)[:, :-1]
    moved = []
    for j in range(test.n_shots):
        v = rows[test.starts[j] : test.starts[j + 1]]
        fitted = np.linalg.lstsq(v[:, :3], v @ geometry.columns[j], rcond=None)[0]
        moved.append(geometry.base_from_camera[j, :3, :3] @ fitted)
    result = np.array(moved)
    result[:, :, test.layout.centres] = 0.0
    return result
