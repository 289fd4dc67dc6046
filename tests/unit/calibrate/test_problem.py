"""Analytic columns of every unknown against central differences of where spheres are expected."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from calibrate.camera_error import PillowError
from calibrate.problem import Problem, State, expected_radius_mm, linearise_geometry
from calibrate.robot_terms import arm_terms, load_basis
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from tests.support.solving import bent_state, draw_shots, problem_of
from tests.support.synthetic import paper_cell

STEP_MM, STEP_RAD = 1e-2, 1e-5


def made(coupled: bool, pose_only: bool) -> tuple[Problem, State]:
    cell, rng = paper_cell(coupled), np.random.default_rng(3)
    shots = {name: draw_shots(cell, rng, 3, n_points=5) for name in "AB"}
    problem = problem_of(cell, shots, PillowError(), pose_only=pose_only)
    if problem.joints_rad is not None:
        terms = arm_terms(cell.nominal)
        problem = replace(problem, terms=terms, load=load_basis(terms, cell.nominal, problem.joints_rad))
    return problem, bent_state(problem, cell, rng)


def steps(problem: Problem) -> FloatArray:
    """(P,) size of each unknown's difference step: twists are (mm, rad), everything else mm."""
    layout, result = problem.layout, np.full(problem.layout.size, STEP_MM)
    for start in range(0, layout.hand_eye.stop, 6):
        result[start + 3 : start + 6] = STEP_RAD
    result[layout.terms] = STEP_RAD
    return result


@pytest.mark.parametrize(("coupled", "pose_only"), [(False, False), (True, False), (False, True)])
def test_columns_are_the_derivatives(coupled: bool, pose_only: bool) -> None:
    problem, state = made(coupled, pose_only)
    layout, columns = problem.layout, linearise_geometry(problem, state).columns
    no_noise = np.zeros_like(state.pose_noise)
    for p, h in enumerate(steps(problem)):
        step = h * np.eye(layout.size)[p]
        forward, back = state.moved(layout, step, no_noise), state.moved(layout, -step, no_noise)
        centre = (linearise_geometry(problem, forward).centre_in_camera_mm - linearise_geometry(problem, back).centre_in_camera_mm) / (2 * h)
        # a residual grows where the point moves along u, which is where the expected centre moves against it
        np.testing.assert_allclose(columns[:, :3, p], -centre, atol=2e-5 if h == STEP_RAD else 1e-7, err_msg=str(p))
        radius = (expected_radius_mm(problem, forward) - expected_radius_mm(problem, back)) / (2 * h)
        np.testing.assert_allclose(columns[:, -1, p], radius, atol=1e-9)
        camera = (forward.camera_mm - back.camera_mm) / (2 * h)
        np.testing.assert_allclose(columns[:, 3:-1, p], np.tile(camera, (problem.n_shots, 1)), atol=1e-9)
    # a payload on the last axis pulls at no lever; everything else is felt
    felt = np.delete(columns, np.arange(layout.size)[layout.terms], axis=2)
    assert (np.abs(felt).max(axis=(0, 1)) > 0.1).all()


def test_columns_hold_where_the_arm_yields() -> None:
    """A deflection of some 0.1 mrad turns the columns by as much: no descent notices."""
    problem, straight = made(True, False)
    state = replace(straight, terms_rad=np.random.default_rng(7).normal(0, 1e-4, problem.layout.n_terms))
    layout, columns = problem.layout, linearise_geometry(problem, state).columns
    assert np.abs(linearise_geometry(problem, straight).centre_in_camera_mm - linearise_geometry(problem, state).centre_in_camera_mm).max() > 0.05
    for p in range(layout.camera.start):
        step = steps(problem)[p] * np.eye(layout.size)[p]
        forward, back = (state.moved(layout, sign * step, np.zeros_like(state.pose_noise)) for sign in (1.0, -1.0))
        centre = linearise_geometry(problem, forward).centre_in_camera_mm - linearise_geometry(problem, back).centre_in_camera_mm
        np.testing.assert_allclose(columns[:, :3, p], -centre / (2 * steps(problem)[p]), atol=1e-3 * np.abs(columns[:, :3, p]).max())


@pytest.mark.parametrize("pose_only", [False, True])
def test_noise_columns_are_the_derivatives_and_exact(pose_only: bool) -> None:
    problem, state = made(False, pose_only)
    geometry = linearise_geometry(problem, state)
    noise = np.random.default_rng(4).normal(size=state.pose_noise.shape) * [0.5, 0.5, 0.5, 1e-3, 1e-3, 1e-3]
    moved = linearise_geometry(problem, replace(state, pose_noise=noise)).centre_in_camera_mm
    expected = np.einsum("mij,mj->mi", geometry.noise_columns, noise[problem.scan])
    np.testing.assert_allclose(geometry.centre_in_camera_mm - moved, expected, atol=1e-10)


def test_pose_noise_is_a_small_motion_of_the_flange() -> None:
    """To first order e = t + w x (c - f) is what exp(noise) about the flange origin does at the centre."""
    problem, state = made(False, True)
    noise = 1e-4 * np.random.default_rng(5).normal(size=state.pose_noise.shape)
    about = problem.base_from_flange.copy()
    about[:, :3, :3] = np.eye(3)
    shaken = replace(problem, base_from_flange=about @ se3.exp(noise) @ se3.inverse(about) @ problem.base_from_flange)
    by_noise = linearise_geometry(problem, replace(state, pose_noise=noise)).centre_in_camera_mm
    np.testing.assert_allclose(linearise_geometry(shaken, state).centre_in_camera_mm, by_noise, atol=1e-5)
    assert np.abs(by_noise - linearise_geometry(problem, state).centre_in_camera_mm).max() > 1e-2


def test_a_step_back_undoes_a_step() -> None:
    problem, state = made(True, False)
    rng = np.random.default_rng(6)
    step = 1e-3 * rng.normal(size=problem.layout.size)
    there = state.moved(problem.layout, step, np.zeros_like(state.pose_noise))
    again = there.moved(problem.layout, -step, np.zeros_like(state.pose_noise))
    for name in (f.name for f in fields(state) if f.name != "pose_noise" and np.size(getattr(state, f.name))):
        assert np.abs(np.asarray(getattr(there, name)) - np.asarray(getattr(state, name))).max() > 0
        np.testing.assert_allclose(getattr(again, name), getattr(state, name), atol=1e-12, err_msg=name)


def test_every_unknown_has_one_place() -> None:
    problem, _ = made(False, False)
    layout = problem.layout
    parts = [layout.links, layout.hand_eye, layout.camera, layout.terms, layout.radius_offset, layout.sphere_radius, layout.centres]
    assert np.concatenate([np.arange(layout.size)[part] for part in parts]).tolist() == list(range(layout.size))
    assert layout.size == 36 + 6 + 3 + len(problem.terms) + 1 + 2 + 6
