"""Normal equations against dense ones: explicit nuisances, every point a row, every prior and length a row."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate.camera_error import PillowError
from calibrate.normal import Linearised, NoiseModel, linearise, marginal_cost, reduce, solve_step, symmetric_inverse, symmetric_solve
from calibrate.problem import LengthConstraint, Problem, State, linearise_geometry
from calibrate.sums import shot_moments
from drivers.kinematics.se3 import FloatArray
from tests.support.bound import prior_precision
from tests.support.solving import bent_state, draw_shots, point_rows, problem_of
from tests.support.synthetic import paper_cell

NOISE = NoiseModel(point_mm=0.06, pose_mm=0.02, pose_rad=1e-4, form_mm=0.01)


def made(pose_only: bool, shared_scans: bool) -> tuple[Problem, State]:
    """Two spheres with a length between them, seen in scans of their own or two to a scan; every unknown off."""
    cell, rng = paper_cell(), np.random.default_rng(1)
    shots = {name: draw_shots(cell, rng, 12, n_points=15) for name in "AB"}
    problem = problem_of(cell, shots, PillowError(), pose_only=pose_only, lengths=[LengthConstraint(0, 1, 1.9, 0.01)])
    if shared_scans:
        problem = replace(problem, scan=np.tile(np.arange(12), 2))
    state = bent_state(problem, cell, rng)
    return problem, replace(state, pose_noise=rng.normal(size=(problem.n_scans, 6)) * [0.02, 0.02, 0.02, 1e-4, 1e-4, 1e-4])


def linearised(problem: Problem, state: State) -> Linearised:
    geometry = linearise_geometry(problem, state)
    moments, _ = shot_moments(problem, state, geometry, np.inf)
    return linearise(problem, state, geometry, moments, NOISE.point_weight(np.diff(problem.starts).astype(np.float64)))


def dense(problem: Problem, state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(rows, P) of the unknowns, (rows, 6 G) of the nuisances and (rows,) residuals, all in units of their sigma."""
    geometry, layout = linearise_geometry(problem, state), problem.layout
    v = point_rows(problem, state, geometry)
    shot = np.repeat(np.arange(problem.n_shots), np.diff(problem.starts))
    root = np.sqrt(NOISE.point_weight(np.diff(problem.starts).astype(np.float64)))[shot, None]
    unknowns = root * np.einsum("nv,nvp->np", v[:, :-1], geometry.columns[shot])
    nuisances = np.zeros((len(v), problem.n_scans, 6))
    nuisances[np.arange(len(v)), problem.scan[shot]] = root * np.einsum("nv,nvp->np", v[:, :3], geometry.noise_columns[shot])
    a, b = state.centres_in_base_mm
    length = np.zeros((1, layout.size))
    length[0, layout.centres] = np.concatenate([a - b, b - a]) / np.linalg.norm(a - b) / 0.01
    miss = (np.linalg.norm(a - b) - 1.9) / 0.01
    value = np.zeros(layout.size)
    value[layout.links], value[layout.camera] = state.link_twists.ravel(), state.camera_mm
    value[layout.radius_offset], value[layout.sphere_radius] = state.radius_offset_mm, state.sphere_radius_deviation_mm
    prior = np.sqrt(prior_precision(problem))
    rows = np.concatenate([unknowns, length, np.diag(prior)])
    residual = np.concatenate([(root[:, 0] * v[:, -1]), [miss], prior * value])
    extra = np.zeros((len(rows) - len(v), 6 * problem.n_scans))
    return rows, np.concatenate([nuisances.reshape(len(v), -1), extra]), residual


cases = pytest.mark.parametrize(("pose_only", "shared_scans"), [(False, False), (False, True), (True, False), (True, True)])


@cases
def test_elimination_takes_the_step_of_the_dense_solve(pose_only: bool, shared_scans: bool) -> None:
    problem, state = made(pose_only, shared_scans)
    sums = linearised(problem, state)
    step, noise_step = solve_step(sums, reduce(sums, NOISE.pose_precision))
    rows, nuisances, residual = dense(problem, state)
    pose = np.sqrt(np.tile(NOISE.pose_precision, problem.n_scans))
    everything = np.block([[rows, nuisances], [np.zeros((len(pose), rows.shape[1])), np.diag(pose)]])
    right = -np.concatenate([residual, pose * state.pose_noise.ravel()])
    scale = 1 / np.linalg.norm(everything, axis=0)
    expected = scale * np.linalg.lstsq(everything * scale, right, rcond=None)[0]
    np.testing.assert_allclose(step, expected[: len(step)], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(noise_step.ravel(), expected[len(step) :], rtol=1e-5, atol=1e-8)
    assert np.abs(step).max() > 0.1


@cases
def test_the_reduced_hessian_is_the_information_of_the_marginal(pose_only: bool, shared_scans: bool) -> None:
    problem, state = made(pose_only, shared_scans)
    reduced = reduce(linearised(problem, state), NOISE.pose_precision)
    rows, nuisances, residual = dense(problem, state)
    covariance = np.eye(len(rows)) + nuisances @ np.diag(1 / np.tile(NOISE.pose_precision, problem.n_scans)) @ nuisances.T
    y = residual - nuisances @ state.pose_noise.ravel()
    whitened = np.linalg.solve(covariance, rows)
    scale = np.sqrt(np.diagonal(reduced.hessian))
    np.testing.assert_allclose(reduced.hessian / scale / scale[:, None], rows.T @ whitened / scale / scale[:, None], atol=1e-7)
    np.testing.assert_allclose(reduced.gradient / scale, whitened.T @ y / scale, atol=1e-6)
    np.testing.assert_allclose(reduced.cost, y @ np.linalg.solve(covariance, y), rtol=1e-8)
    np.testing.assert_allclose(reduced.log_determinant, np.linalg.slogdet(covariance)[1], rtol=1e-8)


def test_two_spheres_in_one_scan_share_the_nuisance() -> None:
    """A displacement of the whole scan costs one nuisance there, and two where each sphere has its own scan."""
    (apart, state_apart), (together, state_together) = made(False, False), made(False, True)
    assert (apart.n_scans, together.n_scans) == (24, 12)
    free = reduce(linearised(apart, state_apart), NOISE.pose_precision)
    tied = reduce(linearised(together, replace(state_together, pose_noise=np.zeros((12, 6)))), NOISE.pose_precision)
    assert free.noise_inverse.shape == (24, 6, 6)
    assert tied.noise_inverse.shape == (12, 6, 6)
    # both shots tell of the one nuisance: it is known better than from one of them
    assert (np.diagonal(tied.noise_inverse, axis1=1, axis2=2) < np.diagonal(free.noise_inverse[:12], axis1=1, axis2=2)).all()


@cases
def test_marginal_cost_is_the_dense_restricted_likelihood_up_to_a_constant(pose_only: bool, shared_scans: bool) -> None:
    problem, state = made(pose_only, shared_scans)
    sums = linearised(problem, state)
    rows, nuisances, residual = dense(problem, state)
    y = residual - nuisances @ state.pose_noise.ravel()
    scale = np.linalg.norm(rows, axis=0)

    def restricted(precision: FloatArray) -> float:
        covariance = np.eye(len(rows)) + nuisances / np.tile(precision, problem.n_scans) @ nuisances.T
        whitened = np.linalg.solve(covariance, rows / scale)
        information = (rows / scale).T @ whitened
        fitted = whitened.T @ y
        left = y @ np.linalg.solve(covariance, y) - fitted @ np.linalg.solve(information, fitted)
        return float(np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(information)[1] + left)

    models = [NOISE, replace(NOISE, pose_mm=0.2), replace(NOISE, pose_rad=1e-5), replace(NOISE, pose_mm=1e-3, pose_rad=1e-3)]
    ours = np.array([marginal_cost(sums, model.pose_precision) for model in models])
    theirs = np.array([restricted(model.pose_precision) for model in models])
    np.testing.assert_allclose(ours - ours[0], theirs - theirs[0], rtol=1e-5, atol=1e-3)
    assert np.ptp(ours) > 1.0


def test_form_weighs_big_shots_down_to_their_patches() -> None:
    few, many = NOISE.point_weight(np.array([1.0])), NOISE.point_weight(np.array([1e9]))
    np.testing.assert_allclose(few, 1 / 0.06**2, rtol=1e-2)
    # a shot of any size knows its sphere no better than 12 patches of form error do
    np.testing.assert_allclose(1e9 * many, 12 / 0.01**2, rtol=1e-3)
    assert replace(NOISE, form_mm=0.0).point_weight(np.array([5e6]))[0] == pytest.approx(0.06**-2)


@pytest.mark.parametrize("rank", [0, 1, 4, 7])
def test_symmetric_inverse_is_a_generalised_inverse(rank: int) -> None:
    """The rank-revealing inverse, units as wild as mm and rad: A A⁺ A = A, A⁺ A A⁺ = A⁺, symmetric, of the same rank."""
    rng = np.random.default_rng(rank)
    units = 10.0 ** rng.uniform(-3, 3, 7)
    factor = rng.normal(size=(7, rank))
    matrix = (factor @ factor.T) * units * units[:, None]
    inverse = symmetric_inverse(matrix)
    norm = units * units[:, None]
    np.testing.assert_allclose(matrix @ inverse @ matrix / norm, matrix / norm, atol=1e-9)
    np.testing.assert_allclose(inverse @ matrix @ inverse * norm, inverse * norm, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(inverse, inverse.T, rtol=1e-9, atol=0)
    if rank == 7:
        np.testing.assert_allclose(inverse * norm, np.linalg.inv(factor @ factor.T), rtol=1e-6)


def test_symmetric_solve_leaves_dead_unknowns_alone() -> None:
    matrix = np.diag([4.0, 0.0, 9.0])
    np.testing.assert_allclose(symmetric_solve(matrix, np.array([8.0, 0.0, 27.0])), [2.0, 0.0, 3.0])
