"""The light path: centres that follow the camera, and a joint solve on them, against oracles and the whole-cloud solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acquire.sphere_fit import fit_fixed_radius
from calibrate.camera_error import CameraError, NoCameraError, PillowError, camera_error_models
from calibrate.centres import CentreFits, cross_validate_centres, fit_centres, fits_of_solution, solve_centres
from calibrate.clouds import solve_clouds
from calibrate.problem import Problem, State, expected_radius_mm, linearise_geometry
from calibrate.sums import shot_moments
from calibrate.validation import cross_validate
from drivers.errors import DataError, SettingsError
from drivers.kinematics import se3
from tests.support.bound import FIRST_NOISE, fixed_radius_centres_in_base_mm, held_out_rms_mm
from tests.support.solving import bent_state, draw_shots, noise_free, problem_of, start_of
from tests.support.synthetic import paper_cell

CELL = paper_cell()


def field() -> CameraError:
    corners = np.array([[-120.0, -80.0, 240.0], [120.0, 80.0, 400.0]])
    return camera_error_models(["field"], points_in_camera_mm=corners, sight_crossing_mm=(60.0, 0.0, 500.0))[0]


@pytest.fixture(scope="module", params=["pillow", "field"])
def bent(request: pytest.FixtureRequest) -> tuple[Problem, State]:
    """Ten noisy shots, and a state with every unknown away from zero."""
    rng = np.random.default_rng(1)
    problem = problem_of(CELL, draw_shots(CELL, rng, 10, n_points=150), PillowError() if request.param == "pillow" else field())
    return problem, bent_state(problem, CELL, rng)


def fits_at(problem: Problem, state: State) -> CentreFits:
    return fit_centres(problem, state, linearise_geometry(problem, state), None)[0]


def test_centres_follow_camera_and_radius_as_refitted_ones_do(bent: tuple[Problem, State]) -> None:
    problem, state = bent
    fits = fits_at(problem, state)
    for k in range(problem.layout.n_camera + 1):
        # the terms are taken at the denoised points, and that these move too is left out: a thousandth of the step
        for step, error in ((1e-3, 2e-6), (1e-2, 3e-5)):
            unit = np.zeros(problem.layout.n_camera)
            unit[k:] = step if k == problem.layout.n_camera else unit[k:]
            if k < problem.layout.n_camera:
                unit[k] = step
            offset = state.radius_offset_mm + (step if k == problem.layout.n_camera else 0.0)
            moved = replace(state, camera_mm=state.camera_mm + unit, radius_offset_mm=offset)
            np.testing.assert_allclose(fits.centres_at(problem, moved), fits_at(problem, moved).centre_in_camera_mm, atol=error)


def test_a_fit_is_where_a_plain_fit_of_its_corrected_points_is(bent: tuple[Problem, State]) -> None:
    """Along the sight or along the radius: with 0.08 mm of noise some micrometres apart, without noise equal."""
    problem, state = bent
    correction = problem.camera_error.basis(problem.points_in_camera_mm) * state.camera_mm
    corrected = problem.points_in_camera_mm.copy()
    for axis in range(3):
        corrected[:, axis] += correction[:, problem.camera_error.axis == axis].sum(axis=1)
    fits, radius = fits_at(problem, state), expected_radius_mm(problem, state)
    for j in range(problem.n_shots):
        piece = corrected[problem.starts[j] : problem.starts[j + 1]]
        plain, covariance = fit_fixed_radius(piece, float(radius[j]), fits.centre_in_camera_mm[j])
        assert np.linalg.norm(plain - fits.centre_in_camera_mm[j]) < 0.3 * np.sqrt(np.trace(covariance))


def test_a_compressed_shot_keeps_what_its_points_say_of_the_centre_and_drops_the_rest(bent: tuple[Problem, State]) -> None:
    problem, state = bent
    geometry = linearise_geometry(problem, state)
    fits, _ = fit_centres(problem, state, geometry, None)
    at_fits = replace(geometry, centre_in_camera_mm=fits.centre_in_camera_mm)
    whole, _ = shot_moments(problem, state, at_fits, np.inf)
    compressed = fits.moments(problem, state, at_fits)
    np.testing.assert_allclose(compressed[:, :3], whole[:, :3], rtol=1e-6, atol=1e-6)
    values = np.linalg.eigvalsh(whole - compressed)
    assert values.min() > -1e-6 * values.max()
    assert values.max() > 1.0


def test_a_solution_holds_its_fits() -> None:
    """Folds take them from its moments instead of the points."""
    rng = np.random.default_rng(4)
    problem = problem_of(CELL, draw_shots(CELL, rng, 30, n_points=80), PillowError())
    solution = solve_centres(problem, start_of(problem, CELL), FIRST_NOISE)
    held, anew = fits_of_solution(solution), fit_centres(problem, solution.state, solution.geometry, solution.noise)[0]
    np.testing.assert_allclose(held.centre_in_camera_mm, anew.centre_in_camera_mm, atol=1e-7)
    np.testing.assert_allclose(held.follows, anew.follows, atol=1e-6)
    np.testing.assert_allclose(held.information, anew.information, rtol=1e-6, atol=1e-6)


def test_without_noise_and_camera_error_both_solvers_agree() -> None:
    cell, rng = replace(CELL, camera_error_mm=lambda points: np.zeros(len(points))), np.random.default_rng(2)
    problem = problem_of(cell, noise_free(cell, rng, 50, n_points=100), NoCameraError())
    start = start_of(problem, cell, rng)
    test = problem_of(cell, noise_free(cell, rng, 20, n_points=100), NoCameraError())
    clouds, centres = (fixed_radius_centres_in_base_mm(test, solve(problem, start, FIRST_NOISE).state) for solve in (solve_clouds, solve_centres))
    np.testing.assert_allclose(se3.apply(se3.fit_rigid(centres, clouds), centres), clouds, atol=1e-4)
    np.testing.assert_allclose(centres - centres.mean(axis=0), 0.0, atol=1e-4)


def test_neither_order_nor_start_changes_the_end() -> None:
    rng = np.random.default_rng(3)
    shots = draw_shots(CELL, rng, 45, n_points=100)
    test = problem_of(CELL, noise_free(CELL, rng, 10, n_points=30), PillowError())
    order = rng.permutation(45)
    ends = []
    for members, seed in ((shots, 1), ([shots[i] for i in order], 1), (shots, 2)):
        problem = problem_of(CELL, members, PillowError())
        start = start_of(problem, CELL, np.random.default_rng(seed))
        ends.append(fixed_radius_centres_in_base_mm(test, solve_centres(problem, start, FIRST_NOISE).state))
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-6)
    # the base is free: places against each other are not
    np.testing.assert_allclose(se3.apply(se3.fit_rigid(ends[2], ends[0]), ends[2]), ends[0], atol=1e-6)


def test_a_start_in_place_and_one_that_is_not_end_alike() -> None:
    """From a start within hundredths of a mm the pose noise is estimated a step earlier: it must end in the same minimum."""
    rng = np.random.default_rng(5)
    problem = problem_of(CELL, draw_shots(CELL, rng, 40, n_points=100))
    base = solve_centres(problem, start_of(problem, CELL, np.random.default_rng(1)), FIRST_NOISE)
    turn = rng.normal(size=(6, 6)) * [1, 1, 1, 2e-3, 2e-3, 2e-3]
    for size in (0.0, 0.003, 0.03, 0.3):
        start = replace(base.state, link_twists=base.state.link_twists + size * turn, pose_noise=0.0 * base.state.pose_noise)
        found = solve_centres(problem, start, FIRST_NOISE)
        np.testing.assert_allclose(found.geometry.centre_in_camera_mm, base.geometry.centre_in_camera_mm, atol=1e-6)


def test_held_out_centres_are_hardly_worse_than_those_of_whole_clouds() -> None:
    """What the shape of a cap tells of the camera is little beside sixty centres."""
    ratios = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        problem = problem_of(CELL, draw_shots(CELL, rng, 60, n_points=150), PillowError())
        start = start_of(problem, CELL, rng)
        test = problem_of(CELL, noise_free(CELL, rng, 20, n_points=100), PillowError())
        found = [solve(problem, start, FIRST_NOISE) for solve in (solve_clouds, solve_centres)]
        ratios.append(held_out_rms_mm(test, found[1].state) / held_out_rms_mm(test, found[0].state))
        folds = cross_validate(found[0]).centre_rms_mm, cross_validate_centres(found[1]).centre_rms_mm
        assert folds[1] == pytest.approx(folds[0], rel=0.1)
    assert np.median(ratios) < 1.3, ratios


def test_points_that_are_not_on_the_sphere_weigh_next_to_nothing() -> None:
    rng = np.random.default_rng(8)
    problem = problem_of(CELL, draw_shots(CELL, rng, 40, n_points=200), PillowError())
    stray = problem.points_in_camera_mm.copy()
    chosen = rng.random(len(stray)) < 0.05
    stray[chosen, 2] += rng.uniform(-8, 8, chosen.sum())
    test = problem_of(CELL, noise_free(CELL, rng, 20, n_points=100), PillowError())
    rms = []
    for points in (problem.points_in_camera_mm, stray):
        spoiled = replace(problem, points_in_camera_mm=points)
        rms.append(held_out_rms_mm(test, solve_centres(spoiled, start_of(problem, CELL), FIRST_NOISE).state))
    assert rms[1] < 1.3 * rms[0]


def test_line_profiles_are_refused_with_the_method_that_takes_them() -> None:
    rng = np.random.default_rng(9)
    problem = replace(problem_of(CELL, noise_free(CELL, rng, 12)), along_sight=False)
    with pytest.raises(SettingsError) as told:
        solve_centres(problem, start_of(problem, CELL), FIRST_NOISE)
    assert "clouds" in str(told.value.remedy)


def test_points_that_leave_a_centre_open_are_a_data_error() -> None:
    """All points of one shot at one place."""
    rng = np.random.default_rng(10)
    problem = problem_of(CELL, draw_shots(CELL, rng, 12, n_points=40), NoCameraError())
    points = problem.points_in_camera_mm.copy()
    points[:40] = points[0]
    with pytest.raises(DataError, match="1 of 12") as told:
        solve_centres(replace(problem, points_in_camera_mm=points), start_of(problem, CELL), FIRST_NOISE)
    assert "clouds" in str(told.value.remedy)
