"""Noise found again in data that were made with it: pose noise by REML, points and form by patches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate.normal import NoiseModel, linearise
from calibrate.problem import Problem, State, linearise_geometry
from calibrate.sums import ShotSums, patch_sums, shot_moments, shot_sums
from calibrate.variance import estimate_incidence, estimate_point_noise, estimate_pose_noise, estimate_range_growth
from drivers.kinematics.se3 import FloatArray
from tests.support.solving import draw_shots, problem_of, start_of
from tests.support.synthetic import SyntheticCell, paper_cell

FIRST = NoiseModel(point_mm=0.05, pose_mm=0.3, pose_rad=5e-4)


def perfect_cell() -> SyntheticCell:
    """Nothing but noise is left to explain."""
    cell = paper_cell()
    return replace(cell, true=cell.nominal, camera_error_mm=lambda p: np.zeros(len(p)))


def made(seed: int, n_shots: int, n_points: int, depth_noise_mm: float, pose_noise: tuple[float, float]) -> tuple[Problem, State]:
    cell = perfect_cell()
    shots = draw_shots(cell, np.random.default_rng(seed), n_shots, n_points=n_points, depth_noise_mm=depth_noise_mm, pose_noise=pose_noise)
    problem = problem_of(cell, shots)
    return problem, start_of(problem, cell)


@pytest.mark.parametrize(("pose_mm", "pose_rad"), [(0.01, 1e-4), (0.05, 2e-5), (0.02, 5e-4)])
def test_reml_finds_the_pose_noise(pose_mm: float, pose_rad: float) -> None:
    """Linear data: the state is the truth. 60 shots know each sigma to about 15 %, four seeds to 8 %."""
    found = []
    for seed in range(4):
        problem, state = made(seed, 60, 60, 0.03, (pose_mm, pose_rad))
        geometry = linearise_geometry(problem, state)
        moments, _ = shot_moments(problem, state, geometry, np.inf)
        noise = replace(FIRST, point_mm=0.023)
        sums = linearise(problem, state, geometry, moments, noise.point_weight(np.diff(problem.starts).astype(np.float64)))
        found.append(estimate_pose_noise(sums, noise))
    for name, true, tolerance in (("pose_mm", pose_mm, 0.25), ("pose_rad", pose_rad, 0.25)):
        values = np.array([getattr(noise, name) for noise in found])
        share = pose_rad * 450 / np.hypot(pose_mm, pose_rad * 450) if name == "pose_rad" else 1.0
        if share > 0.3:
            np.testing.assert_allclose(np.sqrt((values**2).mean()), true, rtol=tolerance, err_msg=name)


def test_no_pose_noise_is_found_where_there_is_none() -> None:
    problem, state = made(1, 40, 100, 0.05, (0.0, 0.0))
    geometry = linearise_geometry(problem, state)
    moments, _ = shot_moments(problem, state, geometry, np.inf)
    noise = replace(FIRST, point_mm=0.04)
    found = estimate_pose_noise(linearise(problem, state, geometry, moments, noise.point_weight(np.full(40, 100.0))), noise)
    assert 1e-4 <= found.pose_mm < 4e-3
    assert 2e-7 <= found.pose_rad < 1e-5


def point_noise(problem: Problem, state: State) -> NoiseModel:
    return estimate_point_noise(patch_sums(problem, state, linearise_geometry(problem, state), np.inf), FIRST)


@pytest.mark.parametrize("depth_noise_mm", [0.02, 0.08])
def test_white_noise_is_noise_and_no_form(depth_noise_mm: float) -> None:
    """Noise along the sight times the cosine of incidence: over a cap of 60 degrees its mean square is 7/12."""
    problem, state = made(2, 40, 600, depth_noise_mm, (0.0, 0.0))
    found = point_noise(problem, state)
    expected = depth_noise_mm * np.sqrt(7 / 12) * 0.93  # the sight is up to 26 degrees off the depth axis
    assert found.point_mm == pytest.approx(expected, rel=0.12)
    # a patch of 50 points cannot see less than a seventh of their noise
    assert found.form_mm < depth_noise_mm / 10
    assert (found.pose_mm, found.pose_rad) == (FIRST.pose_mm, FIRST.pose_rad)


@pytest.mark.parametrize("bend_mm", [0.02, 0.1])
def test_a_bent_sphere_has_form(bend_mm: float) -> None:
    problem, state = made(3, 30, 600, 0.02, (0.0, 0.0))
    centre = linearise_geometry(problem, state).centre_in_camera_mm[np.repeat(np.arange(30), 600)]
    u = (problem.points_in_camera_mm - centre) / 19.05
    bent = replace(problem, points_in_camera_mm=problem.points_in_camera_mm + bend_mm * _wave(u)[:, None] * u)
    straight, found = point_noise(problem, state), point_noise(bent, state)
    # the mean square of the wave over the cap is about a half
    assert 0.4 * bend_mm < found.form_mm < 1.2 * bend_mm
    assert found.form_mm > 3 * straight.form_mm
    assert found.point_mm < straight.point_mm + 0.6 * bend_mm


def _wave(u: FloatArray) -> FloatArray:
    """A form error of two lobes about the optical axis."""
    return np.asarray(np.cos(2 * np.arctan2(u[:, 1], u[:, 0])))


def test_a_few_spoiled_shots_do_not_move_the_estimate() -> None:
    problem, state = made(4, 40, 300, 0.05, (0.0, 0.0))
    spoiled = problem.points_in_camera_mm.copy()
    spoiled[: problem.starts[6]] += np.random.default_rng(5).normal(0, 1.0, (problem.starts[6], 3))
    clean, found = point_noise(problem, state), point_noise(replace(problem, points_in_camera_mm=spoiled), state)
    assert found.point_mm == pytest.approx(clean.point_mm, rel=0.1)


def test_empty_patches_and_tiny_shots_are_no_division_by_zero() -> None:
    problem, state = made(6, 5, 2, 0.05, (0.0, 0.0))
    found = point_noise(problem, state)
    assert np.isfinite([found.point_mm, found.form_mm]).all()
    assert found.point_mm > 0


def sums_of(problem: Problem, state: State) -> ShotSums:
    return shot_sums(problem, state, linearise_geometry(problem, state), None, patches=True)


def test_noise_along_the_sight_shows_as_the_square_of_the_cosine() -> None:
    """Its share of a residual along the normal; nothing is left where the sight grazes, but some trust is always withheld."""
    found = estimate_incidence(sums_of(*made(4, 60, 500, 0.08, (0.0, 0.0))).patches, replace(FIRST, form_mm=0.0))
    assert 0.1 <= found.flat < 0.22
    cos2 = 7 / 12
    assert found.flat + found.steep * cos2 == pytest.approx(1.0, abs=0.08)


def test_noise_of_the_surface_shows_at_every_incidence() -> None:
    problem, state = made(5, 60, 500, 1e-6, (0.0, 0.0))
    rng, centre = np.random.default_rng(5), np.repeat(linearise_geometry(problem, state).centre_in_camera_mm, np.diff(problem.starts), axis=0)
    away = problem.points_in_camera_mm - centre
    noisy = problem.points_in_camera_mm + away / np.linalg.norm(away, axis=1)[:, None] * rng.normal(0, 0.05, (len(away), 1))
    found = estimate_incidence(sums_of(replace(problem, points_in_camera_mm=noisy), state).patches, replace(FIRST, form_mm=0.0))
    assert found.flat > 0.85


@pytest.mark.parametrize("power", [0.0, 1.0, 2.0])
def test_noise_that_grows_with_the_range_is_found_to(power: float) -> None:
    problem, state = made(6, 80, 400, 1e-6, (0.0, 0.0))
    distance = np.linalg.norm(problem.points_in_camera_mm, axis=1, keepdims=True)
    noise_mm = np.random.default_rng(6).normal(0, 0.05, distance.shape) * (distance / 320.0) ** power
    noisy = replace(problem, points_in_camera_mm=problem.points_in_camera_mm * (1 + noise_mm / distance))
    sums = sums_of(noisy, state)
    found = estimate_range_growth(sums.patches, sums.range_mm, estimate_point_noise(sums.patches, FIRST))
    assert found.range_power == pytest.approx(power, abs=0.15)
    # a shot's range is its centre's; the points lie some 15 mm nearer
    expected_mm = 0.05 * np.sqrt(7 / 12) * (305.0 / 320.0) ** power
    assert float(found.point_sigma_mm(np.array([320.0]))[0]) == pytest.approx(expected_mm, rel=0.12)


def test_one_range_tells_nothing_of_its_growth() -> None:
    sums = sums_of(*made(7, 30, 200, 0.08, (0.0, 0.0)))
    here = sums.range_mm * 1e-4 + 350.0
    assert estimate_range_growth(sums.patches, here, FIRST).range_power < 0.05
