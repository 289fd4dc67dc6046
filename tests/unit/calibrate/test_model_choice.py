"""Choosing a camera error model: linear folds against real ones, the simplest within one standard error, a free sight crossing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate import Calibration
from calibrate.camera_error import CameraError, FreeCrossing, FullPillowError, NoCameraError, PillowError, PolynomialError, correction_in_camera_mm
from calibrate.camera_error_field import affine_error, box_of_points, default_field, richest_field
from calibrate.camera_error_stack import StackedModels
from calibrate.clouds import Solution, solve_clouds
from calibrate.linear_folds import Folds, full_step, held_out_miss_mm, linear_folds, noise_of
from calibrate.model_choice import choose_model, is_open, simplest_of_the_best
from calibrate.problem import Problem
from calibrate.solve import CalibrationSettings, calibrate
from calibrate.start_arcs import start_from_arcs
from calibrate.validation import cross_validate, folds_of
from drivers.files.session import read_session
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from tests.support.bound import FIRST_NOISE, held_out_rms_mm
from tests.support.solving import draw_shots, noise_free, problem_of, start_of
from tests.support.synthetic import bowl_ripple_mm, paper_cell, pillow_error_mm
from tests.support.synthetic_session import write_session
from tests.unit.calibrate.test_start import arcs

CELL = paper_cell()
N_SHOTS, N_POINTS = 60, 120


def no_error_mm(points: FloatArray) -> FloatArray:
    return np.zeros(len(points))


ERRORS: dict[str, Callable[[FloatArray], FloatArray]] = {"none": no_error_mm, "pillow": pillow_error_mm, "ripple": bowl_ripple_mm}


def solved(error_mm: Callable[[FloatArray], FloatArray], seed: int, model: CameraError | None = None) -> Solution:
    """With the default field over the points, or another model."""
    cell, rng = replace(CELL, camera_error_mm=error_mm), np.random.default_rng(seed)
    problem = problem_of(cell, draw_shots(cell, rng, N_SHOTS, n_points=N_POINTS))
    camera = model or default_field(box_of_points(problem.points_in_camera_mm))
    problem = with_model(problem, camera)
    start = start_of(problem, cell)
    return solve_clouds(replace(problem, first_flange_from_camera=start.flange_from_camera), start, FIRST_NOISE)


def with_model(problem: Problem, camera: CameraError) -> Problem:
    return replace(problem, camera_error=camera)


@pytest.fixture(scope="module")
def solutions() -> dict[str, Solution]:
    return {name: solved(error, 50 + i) for i, (name, error) in enumerate(ERRORS.items())}


def models_of(solution: Solution) -> list[CameraError]:
    box = box_of_points(solution.problem.points_in_camera_mm)
    return [NoCameraError(), affine_error(box), PillowError(), default_field(box)]


def folds_about(solution: Solution) -> tuple[StackedModels, Folds]:
    stacked = StackedModels(richest_field(box_of_points(solution.problem.points_in_camera_mm)), (PillowError(),))
    return stacked, linear_folds(solution.problem, solution.state, solution.noise, folds_of(solution.problem, 10), stacked)


@pytest.mark.parametrize("error", ["pillow", "ripple"])
def test_linear_folds_predict_what_solves_of_every_fold_predict(error: str, solutions: dict[str, Solution]) -> None:
    solution = solutions[error]
    stacked, folds = folds_about(solution)
    for model in models_of(solution):
        columns = stacked.columns_of(model)
        miss = held_out_miss_mm(folds, columns, noise_of(folds, columns, solution.noise))
        camera = np.zeros(len(model.axis))
        again = solve_clouds(with_model(solution.problem, model), replace(solution.state, camera_mm=camera), FIRST_NOISE)
        told = cross_validate(again)
        ratio = np.sqrt((miss**2).sum(axis=1).mean()) / told.centre_rms_mm
        assert ratio == pytest.approx(1.0, abs=0.03), (model.name, ratio)
        assert np.abs(miss - told.centre_error_mm).max() < 0.3 * np.abs(told.centre_error_mm).max(), model.name


def test_at_its_own_solution_a_model_has_nowhere_to_go(solutions: dict[str, Solution]) -> None:
    solution = solutions["ripple"]
    stacked, folds = folds_about(solution)
    columns = stacked.columns_of(solution.problem.camera_error)
    moved = folds.sensitivity @ full_step(folds, columns, solution.noise)
    assert np.abs(moved).max() < 2e-4
    to_pillow = folds.sensitivity @ full_step(folds, stacked.columns_of(PillowError()), solution.noise)
    assert np.abs(to_pillow).max() > 0.02


def test_a_shot_says_nothing_to_its_own_prediction(solutions: dict[str, Solution]) -> None:
    """Spoil one shot's own sums: its prediction moves by its own centre alone, those of its fold not at all."""
    solution = solutions["pillow"]
    problem = solution.problem
    spoiled = problem.points_in_camera_mm.copy()
    spoiled[problem.starts[7] : problem.starts[8]] += [0.2, 0.0, 0.0]
    stacked, folds = folds_about(solution)
    _, other = folds_about(replace(solution, problem=replace(problem, points_in_camera_mm=spoiled)))
    columns = stacked.columns_of(PillowError())
    before, after = (held_out_miss_mm(one, columns, solution.noise) for one in (folds, other))
    same_fold = (folds.fold == folds.fold[7]) & (np.arange(problem.n_shots) != 7)
    assert np.abs(after - before)[same_fold].max() < 1e-9
    # rather less than 0.2 mm: points far from their sphere lose weight
    assert np.linalg.norm((after - before)[7]) == pytest.approx(0.18, abs=0.04)
    assert np.abs(after - before)[folds.fold != folds.fold[7]].max() > 1e-3


@pytest.mark.parametrize(("error", "allowed"), [("none", {"none", "affine", "pillow"}), ("pillow", {"pillow"}), ("ripple", {"field"})])
def test_the_model_that_the_camera_needs_is_chosen(error: str, allowed: set[str], solutions: dict[str, Solution]) -> None:
    choice = choose_model(solutions[error], models_of(solutions[error]))
    assert choice.model.name in allowed
    assert list(choice.held_out_rms_mm) == ["none", "affine", "pillow", "field"]
    assert len(choice.state.camera_mm) == len(choice.model.axis)


@pytest.mark.parametrize(("error", "allowed"), [("none", {"none"}), ("pillow", {"pillow", "field"})])
def test_profiles_choose_by_solves_of_each_model(error: str, allowed: set[str]) -> None:
    """Arcs that a camera with three times the paper's error saw; the plane of a profile shows it in depth."""
    problem, cell = arcs(40, noise_mm=0.03, seed=41)
    points = problem.points_in_camera_mm.copy()
    points[:, 2] -= 3.0 * ERRORS[error](points)
    noise = se3.exp(np.random.default_rng(42).normal(size=(40, 6)) * ([0.05] * 3 + [1e-4] * 3))
    problem = replace(problem, points_in_camera_mm=points, base_from_flange=problem.base_from_flange @ noise)
    models: list[CameraError] = [NoCameraError(), affine_error(box_of_points(points)), PillowError(), default_field(box_of_points(points))]
    problem = with_model(problem, models[-1])
    assert is_open(models, problem)
    assert not is_open(models[:1], problem)
    choice = choose_model(solve_clouds(problem, start_from_arcs(problem, cell.flange_from_camera).state, FIRST_NOISE), models)
    assert choice.model.name in allowed
    assert len(choice.state.camera_mm) == len(choice.model.axis)
    held = choice.held_out_rms_mm
    assert list(held) == ["none", "affine", "pillow", "field"]
    assert error == "none" or held[choice.model.name] < 0.9 * held["none"]


def test_left_out_shots_choose_a_stiffer_field_where_there_is_less_to_follow(solutions: dict[str, Solution]) -> None:
    fields = {}
    for error in ("none", "ripple"):
        choice = choose_model(solutions[error], models_of(solutions[error])[-1:])
        assert isinstance(choice.model, PolynomialError)
        assert choice.held_out_rms_mm == {}
        fields[error] = float(np.linalg.norm(choice.model.prior_sigma_mm))
    assert fields["none"] < fields["ripple"]


def test_only_an_open_model_is_asked_about(solutions: dict[str, Solution]) -> None:
    problem = solutions["none"].problem
    field = models_of(solutions["none"])[-1]
    assert is_open([field], problem)
    assert is_open([NoCameraError(), PillowError()], problem)
    assert is_open([FreeCrossing(PillowError(), (0.0,) * 3)], problem)
    assert not is_open([PillowError()], problem)
    assert not is_open([field], replace(problem, along_sight=False))


def test_of_equals_the_simplest_is_taken_and_of_unequals_the_best() -> None:
    rng = np.random.default_rng(3)
    error = rng.chisquare(3, 100)
    assert simplest_of_the_best([error, error.copy(), error]) == 0
    assert simplest_of_the_best([2 * error, error, error]) == 1
    assert simplest_of_the_best([3 * error, 2 * error, error]) == 2
    # better by less than one standard error of the difference
    noise = rng.normal(size=100)
    noise -= noise.mean()
    assert simplest_of_the_best([error + noise + 0.9 * noise.std(ddof=1) / 10, error]) == 0
    assert simplest_of_the_best([error + noise + 1.2 * noise.std(ddof=1) / 10, error]) == 1


def test_a_lone_shot_that_nobody_predicts_decides_nothing() -> None:
    error = np.random.default_rng(4).chisquare(3, 100)
    lone = error.copy()
    lone[0] = 1e6
    assert simplest_of_the_best([2 * error, lone]) == 1


@pytest.mark.parametrize("told_mm", [(90.0, 0.0, 470.0), (40.0, 0.0, 530.0)])
def test_a_crossing_told_wrong_is_found(told_mm: tuple[float, float, float]) -> None:
    """Nothing but the field is told apart well: 60 shots put the crossing nearer, and the field where the true one has it."""
    held: dict[bool, float] = {}
    tests = noise_free(CELL, np.random.default_rng(61), 20, n_points=100)
    for free in (False, True):
        pillow = PillowError(told_mm)
        solution = solved(pillow_error_mm, 60, FreeCrossing(pillow, (0.0,) * 3) if free else pillow)
        if free:
            choice = choose_model(solution, [solution.problem.camera_error])
            model = choice.model
            assert isinstance(model, FreeCrossing)
            off = np.array(model.pillow.sight_crossing_mm) - [60.0, 0.0, 500.0]
            assert np.linalg.norm(off) < np.linalg.norm(np.subtract(told_mm, [60.0, 0.0, 500.0]))
            solution = solve_clouds(with_model(solution.problem, model), choice.state, FIRST_NOISE)
            # what the prior holds back about the crossing told, and no more
            assert np.abs(solution.state.camera_mm[model.coordinate >= 0]).max() < 0.5 * np.linalg.norm(np.subtract(told_mm, [60.0, 0.0, 500.0]))
        held[free] = held_out_rms_mm(problem_of(CELL, tests, solution.problem.camera_error), solution.state)
    assert held[True] < held[False] or held[True] < 0.03, held


def test_the_full_pillow_takes_an_error_across_the_view() -> None:
    """Eq. 4's terms in x and y, 0.2 mm at the edge of the view, which eq. 5 cannot hold."""
    truth = FullPillowError((60.0, 0.0, 500.0))
    coefficients = np.array([-0.9, 0.3, 0.0, 0.9, -0.6, 0.0, 0.6, 0.0, 0.0])
    cell, rng = replace(CELL, camera_error_mm=no_error_mm), np.random.default_rng(70)
    shots = [draw_shots(cell, rng, 60, n_points=N_POINTS), noise_free(cell, rng, 20, n_points=N_POINTS)]
    held = {}
    for model in (PillowError(), truth):
        training, test = (measured_with(problem_of(cell, members, model), truth, coefficients) for members in shots)
        held[model.name] = held_out_rms_mm(test, solve_clouds(training, start_of(training, cell), FIRST_NOISE).state)
    assert held["pillow-full"] < 0.7 * held["pillow"], held


def measured_with(problem: Problem, truth: CameraError, coefficients_mm: FloatArray) -> Problem:
    """A problem whose points a camera measured that `truth` corrects, to first order."""
    points = problem.points_in_camera_mm
    return replace(problem, points_in_camera_mm=points - correction_in_camera_mm(truth, coefficients_mm, points))


@pytest.mark.parametrize("name", ["pillow-free", "pillow-full", "pillow-full-free"])
def test_a_calibration_with_a_pillow_of_any_kind_comes_back_from_its_file(name: str, tmp_path: Path) -> None:
    shots = draw_shots(CELL, np.random.default_rng(80), 40, n_points=80)
    session = read_session(write_session(tmp_path / "s", CELL, {"A": shots}, flange_from_camera=None))
    found = calibrate([session], CalibrationSettings(camera_error=name))
    assert found.camera_error.name == name
    # a crossing that the shots say little of is no shortcoming of theirs
    assert found.verdict == "marginal", found.reasons
    found.save(tmp_path / "c.yaml")
    again = Calibration.load(tmp_path / "c.yaml")
    points, joints = shots[0].points_in_camera_mm, shots[0].joints_rad
    np.testing.assert_array_equal(again.points_in_base_mm(points, joints_rad=joints), found.points_in_base_mm(points, joints_rad=joints))
