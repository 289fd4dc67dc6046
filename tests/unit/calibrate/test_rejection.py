"""Rejection: studentised misses are what shots without them would say, are honest of clean ones, and the guilty goes first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate.assemble import subset, without_pose_noise
from calibrate.camera_error import PillowError
from calibrate.clouds import Solution, solve_clouds
from calibrate.problem import Problem
from calibrate.rejection import unexplained
from calibrate.start_arcs import start_from_arcs
from calibrate.validation import predict
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from tests.support.bound import FIRST_NOISE
from tests.support.solving import draw_shots, problem_of, start_of
from tests.support.synthetic import paper_cell
from tests.unit.calibrate.test_start import arcs

CELL = paper_cell()


def problem_with(shift_mm: dict[int, FloatArray], seed: int = 5, n_shots: int = 50) -> Problem:
    problem = problem_of(CELL, draw_shots(CELL, np.random.default_rng(seed), n_shots, n_points=80), PillowError())
    points = problem.points_in_camera_mm.copy()
    for shot, shift in shift_mm.items():
        points[problem.starts[shot] : problem.starts[shot + 1]] += shift
    return replace(problem, points_in_camera_mm=points, first_flange_from_camera=CELL.flange_from_camera)


def solved(problem: Problem) -> Solution:
    return solve_clouds(problem, start_of(problem, CELL), FIRST_NOISE)


@pytest.fixture(scope="module")
def clean() -> Solution:
    return solved(problem_with({}))


def test_clean_shots_pass(clean: Solution) -> None:
    assert not unexplained(clean.problem, clean).far.any()


def test_the_miss_is_that_from_a_solve_without_the_shot(clean: Solution) -> None:
    told = unexplained(clean.problem, clean).miss_mm
    inside = np.linalg.norm(predict(clean.problem, clean.state).centre_error_mm, axis=1)
    for shot in (3, 17, 40):
        keep = np.setdiff1d(np.arange(50), [shot])
        state = solve_clouds(subset(clean.problem, keep), start_of(subset(clean.problem, keep), CELL), clean.noise, estimate_noise=False).state
        without = np.linalg.norm(predict(subset(clean.problem, np.array([shot])), state).centre_error_mm)
        assert told[shot] == pytest.approx(without, rel=0.25, abs=0.01)
        assert told[shot] > 0.9 * inside[shot]


@pytest.mark.parametrize("spoiled", [(7,), (7, 23, 41)])
def test_spoiled_shots_go_and_no_others(spoiled: tuple[int, ...]) -> None:
    rng = np.random.default_rng(6)
    shifts = {shot: 1.5 * direction / np.linalg.norm(direction) for shot, direction in zip(spoiled, rng.normal(size=(3, 3)), strict=False)}
    solution = solved(problem_with(shifts))
    found = unexplained(solution.problem, solution)
    assert np.flatnonzero(found.far).tolist() == list(spoiled)
    assert found.miss_mm[list(spoiled)] == pytest.approx(1.5, abs=0.5)


def test_a_spoiled_shot_with_leverage_is_found_and_alone() -> None:
    """A spoiled shot in the posture furthest from all others bends the solution for the rest of them."""
    joints = problem_with({}).joints_rad
    assert joints is not None
    alone = int(np.argmax(np.linalg.norm(joints - np.median(joints, axis=0), axis=1)))
    spoiled = problem_with({alone: np.array([1.0, 0.6, 0.0])})
    assert np.flatnonzero(unexplained(spoiled, solved(spoiled)).far).tolist() == [alone]


@pytest.fixture(scope="module")
def profiles() -> Problem:
    """Arcs with noise of points and poses."""
    problem, _ = arcs(50, noise_mm=0.03, seed=31)
    noise = se3.exp(np.random.default_rng(32).normal(size=(50, 6)) * ([0.05] * 3 + [1e-4] * 3))
    return replace(problem, base_from_flange=problem.base_from_flange @ noise)


def judged(problem: Problem) -> tuple[list[int], Solution]:
    start = start_from_arcs(problem, None)
    keep = np.flatnonzero(~start.spoiled)
    part = subset(problem, keep)
    solution = solve_clouds(part, without_pose_noise(start.state, part.n_scans), FIRST_NOISE)
    gone = set(range(problem.n_shots)) - set(keep[~unexplained(part, solution).far].tolist())
    return sorted(gone), solution


def test_clean_profiles_pass_and_miss_by_what_noise_explains(profiles: Problem) -> None:
    gone, solution = judged(profiles)
    assert gone == []
    found = unexplained(solution.problem, solution)
    assert ((found.directions > 2) & (found.directions < 3)).all()
    assert found.chi2.sum() / found.directions.sum() == pytest.approx(1.0, abs=0.35)  # of some 140: one in a million is further off


@pytest.mark.parametrize("degrees", [0.3, 1.0, 4.0])
def test_spoiled_profiles_go_and_no_others(profiles: Problem, degrees: float) -> None:
    """Poses turned about an axis in space: the sphere then lies 2 to 30 mm from where the others put it."""
    axes = np.random.default_rng(33).normal(size=(3, 3))
    turns = se3.exp(np.column_stack([np.zeros((3, 3)), np.radians(degrees) * axes / np.linalg.norm(axes, axis=1)[:, None]]))
    poses = profiles.base_from_flange.copy()
    poses[[4, 20, 37]] = turns @ poses[[4, 20, 37]]
    assert judged(replace(profiles, base_from_flange=poses))[0] == [4, 20, 37]
