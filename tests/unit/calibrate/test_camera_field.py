"""The camera's field: rigid parts are nothing, U is the scatter of repeated calibrations, and cells tell what was seen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from calibrate import Calibration
from calibrate.camera_error import PillowError, PolynomialError
from calibrate.camera_field import SHAPE, SeenCells, camera_field, seen_cells, seen_cells_from_data
from calibrate.clouds import solve_clouds
from drivers.kinematics.se3 import FloatArray
from tests.support.bound import FIRST_NOISE
from tests.support.solving import draw_shots, problem_of, start_of
from tests.support.synthetic import paper_cell, pillow_error_mm

BOX = np.array([[-120.0, -70.0, 260.0], [110.0, 80.0, 410.0]])
AFFINE = PolynomialError((0.0, 5.0, 330.0), (120.0, 75.0, 80.0), 1, 1, name="affine")
TURN_ABOUT_X = {(2, (0, 1, 0)): 75.0, (1, (0, 0, 1)): -80.0}


def whole() -> SeenCells:
    return SeenCells(BOX, np.ones(SHAPE, dtype=np.bool_))


def points(n: int = 50) -> FloatArray:
    return np.random.default_rng(1).uniform(BOX[0], BOX[1], (n, 3))


def turned(angle_rad: float) -> FloatArray:
    """Coefficients of an affine model that turn the view about x and do nothing else."""
    return np.array([angle_rad * TURN_ABOUT_X.get(term, 0.0) for term in AFFINE.terms])


def test_a_turn_of_the_whole_view_is_no_camera_error() -> None:
    coefficients = turned(1e-3)
    raw = AFFINE.basis(points()) @ coefficients
    assert np.abs(raw).max() > 0.05
    field = camera_field(AFFINE, coefficients, np.outer(coefficients, coefficients), whole(), points())
    np.testing.assert_allclose(field.correction_mm, 0.0, atol=1e-12)
    np.testing.assert_allclose(field.covariance_mm2, 0.0, atol=1e-12)


def test_what_the_hand_eye_can_take_over_changes_neither_field_nor_u() -> None:
    rng = np.random.default_rng(2)
    coefficients, root = rng.normal(0, 0.1, len(AFFINE.axis)), rng.normal(0, 0.02, (len(AFFINE.axis), len(AFFINE.axis)))
    one = camera_field(AFFINE, coefficients, root @ root.T, whole(), points())
    more = turned(2e-3)
    other = camera_field(AFFINE, coefficients + more, root @ root.T + np.outer(more, more), whole(), points())
    np.testing.assert_allclose(other.correction_mm, one.correction_mm, atol=1e-10)
    np.testing.assert_allclose(other.covariance_mm2, one.covariance_mm2, atol=1e-10)


def test_only_a_rigid_motion_is_taken_out(calibration: Calibration) -> None:
    cells = calibration.seen_cells
    assert cells is not None
    where = cells.centres_mm
    taken = calibration.camera_correction_mm(where) - calibration.camera_field(where).correction_mm
    small = np.concatenate([np.broadcast_to(np.eye(3), (len(where), 3, 3)), -np.cross(where[:, None], np.eye(3)).swapaxes(1, 2)], axis=-1)
    left = taken.ravel() - small.reshape(-1, 6) @ np.linalg.lstsq(small.reshape(-1, 6), taken.ravel(), rcond=None)[0]
    assert np.abs(left).max() < 1e-9
    # and what is left of the field is at right angles to all of them
    assert np.abs(small.reshape(-1, 6).T @ calibration.camera_field(where).correction_mm.ravel()).max() < 1e-6


def test_u_is_the_scatter_of_the_field_when_the_coefficients_scatter() -> None:
    rng, error = np.random.default_rng(3), PillowError()
    root = rng.normal(0, 0.05, (3, 3))
    field = camera_field(error, np.zeros(3), root @ root.T, whole(), points(20))
    drawn = [camera_field(error, root @ rng.normal(size=3), np.zeros((3, 3)), whole(), points(20)).correction_mm for _ in range(3000)]
    np.testing.assert_allclose(field.expanded_uncertainty_mm, 2 * np.std(drawn, axis=0), rtol=0.1, atol=1e-5)


def test_u_of_the_map_is_what_repeated_calibrations_of_small_cells_miss_by() -> None:
    cell, error = paper_cell(), PillowError()
    misses = []
    for seed in range(16):
        rng = np.random.default_rng([41, seed])
        problem = problem_of(cell, draw_shots(cell, rng, 30), error)
        solution = solve_clouds(problem, start_of(problem, cell, rng), FIRST_NOISE)
        part = problem.layout.camera
        cells = seen_cells(problem.points_in_camera_mm)
        where = cells.centres_mm
        found = camera_field(error, solution.state.camera_mm, solution.covariance[part, part], cells, where)
        true = -np.stack([np.zeros(len(where)), np.zeros(len(where)), pillow_error_mm(where)], axis=-1)
        small = np.concatenate([np.broadcast_to(np.eye(3), (len(where), 3, 3)), -np.cross(where[:, None], np.eye(3)).swapaxes(1, 2)], axis=-1)
        flat = small.reshape(-1, 6)
        true = (true.ravel() - flat @ np.linalg.lstsq(flat, true.ravel(), rcond=None)[0]).reshape(-1, 3)
        misses.append((((found.correction_mm - true)[:, 2] / (0.5 * found.expanded_uncertainty_mm[:, 2])) ** 2).mean())
    assert 0.5 < np.sqrt(np.mean(misses)) < 1.5


def test_cells_hold_the_points_they_were_made_from_and_none_outside() -> None:
    made_from = np.random.default_rng(4).normal([0, 0, 330], [40, 30, 25], (300, 3))
    cells = seen_cells(made_from)
    assert cells.holds(made_from).all()
    assert not cells.holds(cells.box_mm[1:] + 0.01).any()
    assert cells.holds(cells.centres_mm).all()
    assert len(cells.centres_mm) == cells.seen.sum() < cells.seen.size


@settings(max_examples=50, deadline=None)
@given(arrays(np.bool_, st.tuples(*[st.integers(1, 6)] * 3)))
def test_cells_come_back_from_their_text(seen: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> None:
    again = seen_cells_from_data(SeenCells(BOX, seen).to_data(), BOX)
    np.testing.assert_array_equal(again.seen, seen)


@pytest.mark.parametrize("rows", [None, [], ["#. .#", "#."], ["#x"], [["#"], "."], ["## #"]])
def test_a_text_that_holds_no_cells_is_refused(rows: object) -> None:
    with pytest.raises(ValueError, match="seen_cells"):
        seen_cells_from_data(rows, BOX)
