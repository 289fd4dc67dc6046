"""The whole-cloud solver recovers synthetic cells as well as their shots allow."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from calibrate.camera_error import NoCameraError, PillowError
from calibrate.camera_error_field import box_of_points, default_field
from calibrate.clouds import solve_clouds
from calibrate.normal import NoiseModel
from calibrate.validation import cross_validate, folds_of, predict
from drivers.errors import DataError
from drivers.kinematics import se3
from tests.support.bound import FIRST_NOISE, bound_mm, fixed_radius_centres_in_base_mm, held_out_rms_mm, information, recover
from tests.support.solving import draw_shots, noise_free, problem_of, start_of
from tests.support.synthetic import paper_cell


@pytest.mark.parametrize("coupled", [False, True])
def test_held_out_centres_are_as_good_as_the_shots_allow(coupled: bool) -> None:
    """METHOD.md 4's reference, fewer and smaller shots; the full count is in tests/qualify."""
    recoveries = [recover(seed, coupled=coupled, n_shots=60, n_points=120, n_tests=20) for seed in range(3)]
    assert np.median([r.ratio for r in recoveries]) <= 1.25, [round(r.ratio, 2) for r in recoveries]
    # the noise that was put in: 0.08 mm along the depth axis, 0.01 mm and 0.1 mrad of pose
    noise = [r.solution.noise for r in recoveries]
    assert np.median([n.point_mm for n in noise]) == pytest.approx(0.06, abs=0.005)
    assert np.median([n.pose_rad for n in noise]) == pytest.approx(1e-4, rel=0.2)
    assert np.median([n.pose_mm for n in noise]) == pytest.approx(0.01, rel=0.7)


def test_noise_free_shots_are_explained_to_some_micrometres() -> None:
    """What stays is the pillow as a correction at the measured point instead of an error at the true one, and priors."""
    cell, rng = paper_cell(), np.random.default_rng(1)
    problem = problem_of(cell, noise_free(cell, rng, 60, n_points=100), PillowError())
    solution = solve_clouds(problem, start_of(problem, cell, rng), FIRST_NOISE)
    test = problem_of(cell, noise_free(cell, rng, 20, n_points=100), PillowError())
    assert held_out_rms_mm(test, solution.state) < 0.005
    assert solution.point_rms_mm.max() < 0.003


def test_the_end_does_not_depend_on_the_start() -> None:
    cell, rng = paper_cell(True), np.random.default_rng(2)
    problem = problem_of(cell, draw_shots(cell, rng, 50, n_points=100), PillowError())
    test = problem_of(cell, noise_free(cell, rng, 10, n_points=30), PillowError())
    ends = [
        fixed_radius_centres_in_base_mm(test, solve_clouds(problem, start_of(problem, cell, np.random.default_rng(s)), first).state)
        for s, first in ((3, FIRST_NOISE), (4, FIRST_NOISE), (5, NoiseModel(0.02, 0.1, 1e-3)))
    ]
    for end in ends[1:]:
        # the base is free: places against each other are not
        np.testing.assert_allclose(se3.apply(se3.fit_rigid(end, ends[0]), end), ends[0], atol=1e-6)


def test_a_turn_that_camera_field_and_hand_eye_may_share_is_shared_in_one_way_from_every_start() -> None:
    """The data say nothing of it; a solve once drifted along it for ever and ended as a failure of good shots."""
    cell, rng = paper_cell(True), np.random.default_rng(12)
    shots = draw_shots(cell, rng, 50, n_points=200)
    box = box_of_points(np.concatenate([shot.points_in_camera_mm for shot in shots]))
    field = default_field(box)
    problem = problem_of(cell, shots, field)
    start = start_of(problem, cell)
    turn_rad = np.array([3e-3, -2e-3, 4e-3])
    # each turn of the field is about one axis of the camera; the hand-eye transform turns back
    centre = se3.apply(start.flange_from_camera, field.centre_mm)
    about = se3.from_rotation_translation(np.eye(3), centre)
    back = about @ se3.exp(np.concatenate([np.zeros(3), start.flange_from_camera[:3, :3] @ turn_rad])) @ se3.inverse(about)
    turned = replace(start, flange_from_camera=back @ start.flange_from_camera, camera_mm=field.turns @ turn_rad[[2, 0, 1]])
    plain, other = (solve_clouds(problem, s, FIRST_NOISE) for s in (start, turned))
    assert max(plain.passes, other.passes) < 15
    assert not any(solution.held for solution in (plain, other))
    np.testing.assert_allclose(other.state.camera_mm, plain.state.camera_mm, atol=1e-5)
    prior = field.prior_sigma_mm**-2.0
    share = np.abs(field.turns.T @ (prior * plain.state.camera_mm)) / np.sqrt((field.turns**2 * prior[:, None]).sum(axis=0))
    assert share.max() < 0.01


def test_many_equal_spheres_in_one_shot_order_or_another_give_one_state() -> None:
    cell, rng = paper_cell(), np.random.default_rng(6)
    shots = draw_shots(cell, rng, 40, n_points=80)
    order = rng.permutation(40)
    states = []
    for members in (shots, [shots[i] for i in order]):
        problem = problem_of(cell, members, PillowError())
        states.append(solve_clouds(problem, start_of(problem, cell), FIRST_NOISE).state)
    test = problem_of(cell, noise_free(cell, rng, 10, n_points=30), PillowError())
    first, second = (fixed_radius_centres_in_base_mm(test, state) for state in states)
    np.testing.assert_allclose(first, second, atol=1e-6)
    np.testing.assert_allclose(states[0].pose_noise[order], states[1].pose_noise, atol=1e-6)


def test_a_sphere_that_reads_large_has_a_radius_offset_and_no_worse_centres() -> None:
    cell, rng = replace(paper_cell(), reads_large_mm=0.03), np.random.default_rng(7)
    problem = problem_of(cell, draw_shots(cell, rng, 60, n_points=200), PillowError())
    solution = solve_clouds(problem, start_of(problem, cell, rng), FIRST_NOISE)
    offset = problem.layout.radius_offset.start
    sigma = float(np.sqrt(np.linalg.pinv(information(solution.problem, solution.state), rcond=1e-15, hermitian=True)[offset, offset]))
    assert abs(solution.state.radius_offset_mm - 0.03) < 4 * sigma
    assert sigma < 0.02
    test = problem_of(cell, noise_free(cell, rng, 20, n_points=100), PillowError())
    assert held_out_rms_mm(test, solution.state) < 2 * bound_mm(solution.problem, solution.state, test)


def test_points_that_are_not_on_the_sphere_weigh_next_to_nothing() -> None:
    cell, rng = paper_cell(), np.random.default_rng(8)
    problem = problem_of(cell, draw_shots(cell, rng, 40, n_points=200), PillowError())
    stray = problem.points_in_camera_mm.copy()
    chosen = rng.random(len(stray)) < 0.03
    stray[chosen, 2] += rng.uniform(-8, 8, chosen.sum())
    test = problem_of(cell, noise_free(cell, rng, 20, n_points=100), PillowError())
    rms = []
    for points in (problem.points_in_camera_mm, stray):
        spoiled = replace(problem, points_in_camera_mm=points)
        rms.append(held_out_rms_mm(test, solve_clouds(spoiled, start_of(problem, cell), FIRST_NOISE).state))
    assert rms[1] < 1.3 * rms[0]


def test_data_that_do_not_belong_together_do_not_pass_silently() -> None:
    """Either the solve says so, or its figures do."""
    cell, rng = paper_cell(), np.random.default_rng(9)
    problem = problem_of(cell, draw_shots(cell, rng, 30, n_points=50))
    assert problem.joints_rad is not None
    mixed = replace(problem, joints_rad=rng.permutation(problem.joints_rad))
    solution = None
    with suppress(DataError):
        solution = solve_clouds(mixed, start_of(problem, cell), FIRST_NOISE)
    assert solution is None or solution.noise.pose_mm > 10 or np.median(solution.point_rms_mm) > 1


def test_held_out_shots_are_missed_as_the_noise_predicts() -> None:
    cell, rng = paper_cell(), np.random.default_rng(10)
    problem = problem_of(cell, draw_shots(cell, rng, 60, n_points=150), PillowError())
    solution = solve_clouds(problem, start_of(problem, cell, rng), FIRST_NOISE)
    held_out, trained = cross_validate(solution), predict(solution.problem, solution.state)
    assert held_out.centre_error_mm.shape == (60, 3)
    # 0.01 mm and 0.1 mrad on 450 mm, each axis, with what 60 shots leave open
    assert 0.05 < held_out.centre_rms_mm < 0.12
    assert trained.centre_rms_mm < held_out.centre_rms_mm
    assert 0.05 < held_out.radial_rms_mm < 0.12


@pytest.mark.parametrize("n_shots", [8, 14, 33])
def test_folds_share_out_the_shots_whatever_their_order(n_shots: int) -> None:
    cell, rng = paper_cell(), np.random.default_rng(11)
    problem = problem_of(cell, {name: draw_shots(cell, rng, n_shots, n_points=2) for name in "AB"}, NoCameraError())
    fold = folds_of(problem, 10)
    counts = np.bincount(fold)
    assert len(counts) == (10 if 2 * n_shots >= 30 else 2 * n_shots)
    assert np.ptp(counts) <= 1
    for sphere in (0, 1):
        assert np.ptp(np.bincount(fold[problem.sphere == sphere], minlength=len(counts))) <= 1
    order = rng.permutation(2 * n_shots)
    shuffled = replace(problem, base_from_flange=problem.base_from_flange[order], sphere=problem.sphere[order])
    np.testing.assert_array_equal(folds_of(shuffled, 10), fold[order])


def test_shots_of_one_pose_are_left_out_together() -> None:
    cell, rng = paper_cell(), np.random.default_rng(12)
    problem = problem_of(cell, draw_shots(cell, rng, 40, n_points=2))
    repeated = replace(problem, base_from_flange=problem.base_from_flange[np.arange(40) // 2])
    fold = folds_of(repeated, 5)
    np.testing.assert_array_equal(fold[::2], fold[1::2])
