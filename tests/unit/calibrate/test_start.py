"""First guesses: exact on clean data, unmoved by gross outliers, and an error where nothing belongs together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate.camera_error import CameraError, NoCameraError, PillowError
from calibrate.problem import Problem
from calibrate.start import centres_by_median, initial_state, start_from_centres
from calibrate.start_arcs import start_from_arcs
from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from tests.support.solving import noise_free, off_by, problem_of
from tests.support.synthetic import SyntheticCell, paper_cell

FAR_GUESS = se3.from_rotation_translation(se3.exp_so3([2.5, 0.5, -1.0]), [-300.0, 200.0, 400.0])


def perfect_cell(coupled: bool = False) -> SyntheticCell:
    cell = paper_cell(coupled)
    return replace(cell, true=cell.nominal, camera_error_mm=lambda p: np.zeros(len(p)))


def clean(cell: SyntheticCell, n_shots: int, camera_error: CameraError | None = None, seed: int = 1) -> tuple[Problem, FloatArray]:
    """A problem of shots without noise, and the true centres (m, 3) in the camera frame."""
    shots = noise_free(cell, np.random.default_rng(seed), n_shots, n_points=5)
    problem = problem_of(cell, shots, camera_error)
    return problem, np.array([se3.apply(se3.inverse(shot.true_base_from_camera), cell.centre_in_base_mm) for shot in shots])


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("guess", [None, FAR_GUESS], ids=["no guess", "a wrong guess"])
def test_clean_centres_give_the_hand_eye_transform_exactly(coupled: bool, guess: FloatArray | None) -> None:
    cell = perfect_cell(coupled)
    problem, centres = clean(cell, 20)
    start = start_from_centres(problem, centres, guess)
    np.testing.assert_allclose(start.state.flange_from_camera, cell.flange_from_camera, atol=1e-6)
    np.testing.assert_allclose(start.state.centres_in_base_mm[0], cell.centre_in_base_mm, atol=1e-6)
    assert start.miss_mm.max() < 1e-6
    assert not start.spoiled.any()


def test_a_good_guess_is_as_good_as_none() -> None:
    cell = perfect_cell()
    problem, centres = clean(cell, 14)
    guessed = start_from_centres(problem, centres, off_by(cell.flange_from_camera, np.random.default_rng(2), 10.0, 0.05))
    np.testing.assert_allclose(guessed.state.flange_from_camera, cell.flange_from_camera, atol=1e-6)


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_gross_outliers_are_found_and_no_others(coupled: bool, seed: int) -> None:
    """One in ten shots 5 to 300 mm off, in a cell with robot and camera errors."""
    rng, cell = np.random.default_rng(seed), paper_cell(coupled)
    problem, centres = clean(cell, 50, PillowError(), seed)
    spoiled = rng.choice(50, 5, replace=False)
    direction = rng.normal(size=(5, 3))
    size_mm = 10 ** rng.uniform(0.7, 2.5, (5, 1))
    centres[spoiled] += size_mm * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    start = start_from_centres(problem, centres, None)
    assert sorted(np.flatnonzero(start.spoiled)) == sorted(spoiled)
    good = np.setdiff1d(np.arange(50), spoiled)
    assert start.miss_mm[good].max() < 1.0
    np.testing.assert_allclose(start.miss_mm[spoiled], size_mm[:, 0], rtol=0.3, atol=0.5)


def test_several_spheres_are_found_together() -> None:
    first = perfect_cell()
    second = replace(first, centre_in_base_mm=np.array([820.0, -250.0, 380.0]))
    rng = np.random.default_rng(3)
    shots = {"A": noise_free(first, rng, 8, n_points=5), "B": noise_free(second, rng, 8, n_points=5)}
    problem = problem_of(first, shots)
    places = [(shot, cell.centre_in_base_mm) for name, cell in (("A", first), ("B", second)) for shot in shots[name]]
    centres = np.array([se3.apply(se3.inverse(shot.true_base_from_camera), place) for shot, place in places])
    found = start_from_centres(problem, centres, None).state.centres_in_base_mm
    np.testing.assert_allclose(found, [first.centre_in_base_mm, second.centre_in_base_mm], atol=1e-6)


def test_too_few_shots_for_a_first_guess_are_a_data_error() -> None:
    problem, centres = clean(perfect_cell(), 5)
    with pytest.raises(DataError, match="too few") as told:
        start_from_centres(problem, centres, None)
    assert told.value.remedy


@pytest.mark.parametrize("guess", [None, paper_cell().flange_from_camera], ids=["no guess", "a guess"])
def test_centres_that_belong_to_other_poses_are_a_data_error(guess: FloatArray | None) -> None:
    problem, centres = clean(paper_cell(), 40)
    nonsense = np.random.default_rng(4).permutation(centres)
    with pytest.raises(DataError, match="no hand-eye transform") as told:
        start_from_centres(problem, nonsense, guess)
    assert told.value.remedy is not None
    assert "robot model" in told.value.remedy


def test_the_median_of_the_centres_shrugs_off_a_bad_shot() -> None:
    cell = perfect_cell()
    problem, centres = clean(cell, 9)
    centres[4] += 500.0
    np.testing.assert_allclose(centres_by_median(problem, cell.flange_from_camera, centres)[0], cell.centre_in_base_mm, atol=1e-8)


def arcs(n_shots: int, *, n_spheres: int = 1, noise_mm: float = 0.0, seed: int = 5) -> tuple[Problem, SyntheticCell]:
    """Profiles in the plane y = 0 of a sensor on the flange, of spheres of 40 mm radius; flange poses only."""
    cell, rng = replace(perfect_cell(), radius_mm=40.0), np.random.default_rng(seed)
    named = {}
    for s in range(n_spheres):
        placed = replace(cell, centre_in_base_mm=cell.centre_in_base_mm + 200.0 * s * np.array([0.2, -1.0, 0.3]))
        named[f"S{s}"] = [
            replace(shot, points_in_camera_mm=_arc(shot.true_base_from_camera, placed, rng, noise_mm))
            for shot in noise_free(placed, rng, 4 * n_shots, n_points=2)
        ]
        named[f"S{s}"] = [shot for shot in named[f"S{s}"] if len(shot.points_in_camera_mm)][:n_shots]
    problem = problem_of(cell, named, NoCameraError(), pose_only=True)
    return replace(problem, along_sight=False), cell


def _arc(base_from_camera: FloatArray, cell: SyntheticCell, rng: np.random.Generator, noise_mm: float) -> FloatArray:
    """(n, 3) where the sensor's plane cuts the upper side of the sphere; none where it hardly meets it."""
    x, y, z = se3.apply(se3.inverse(base_from_camera), cell.centre_in_base_mm)
    if abs(y) > 0.8 * cell.radius_mm:
        return np.zeros((0, 3))
    angle = np.radians(np.linspace(-55, 55, 9))
    radius = np.sqrt(cell.radius_mm**2 - y**2) + rng.normal(0, noise_mm, 9)
    return np.stack([x + radius * np.sin(angle), np.zeros(9), z - radius * np.cos(angle)], axis=1)


def test_arcs_of_two_spheres_give_the_hand_eye_transform_without_a_guess() -> None:
    problem, cell = arcs(5, n_spheres=2)
    start = start_from_arcs(problem, None)
    np.testing.assert_allclose(start.state.flange_from_camera, cell.flange_from_camera, atol=1e-4)
    np.testing.assert_allclose(start.state.centres_in_base_mm[0], cell.centre_in_base_mm, atol=1e-3)
    assert start.scale_mm < 1e-4


def test_noisy_arcs_come_as_near_as_their_noise_whatever_the_guess() -> None:
    problem, cell = arcs(7, noise_mm=0.02)
    start = start_from_arcs(problem, FAR_GUESS)
    # less than the noise of the arc's own radius: nine unknowns, and the arcs lie beside the middle
    assert 0.008 < start.scale_mm < 0.022
    np.testing.assert_allclose(start.state.flange_from_camera[:3, 3], cell.flange_from_camera[:3, 3], atol=0.5)


def test_too_few_arcs_are_a_data_error() -> None:
    problem, _ = arcs(5)
    with pytest.raises(DataError, match="5 profiles are too few"):
        start_from_arcs(problem, None)


def test_an_initial_state_has_no_error_in_it() -> None:
    cell = perfect_cell()
    problem, _ = clean(cell, 3, PillowError())
    state = initial_state(problem, cell.flange_from_camera, cell.centre_in_base_mm[None])
    assert not any(np.any(part) for part in (state.link_twists, state.camera_mm, state.radius_offset_mm, state.pose_noise))
    assert state.pose_noise.shape == (3, 6)
