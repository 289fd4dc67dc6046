"""Spheres in a part's view: warm-up and a bumped camera are taken out of its lengths, and what it does not know is left alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from calibrate.part_correction import correct_for_part
from calibrate.result import Calibration
from drivers.errors import DataError
from drivers.kinematics import se3
from tests.support.volume import VolumeCell, calibrated, random_shots, volume_cell
from tests.support.warmed import PART, STEEL_PER_K, length_errors_mm, warmed

SEED = 71000


@dataclass(frozen=True)
class Case:
    volume: VolumeCell
    calibration: Calibration


@pytest.fixture(scope="module")
def case() -> Case:
    volume = volume_cell(SEED, "five")
    shots = random_shots(volume, volume.spheres, 14, np.random.default_rng([SEED, 1]), n_points=250)
    return Case(volume, calibrated(volume, shots))


def rms(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    return float(np.sqrt((values**2).mean()))


def test_lengths_of_a_part_come_right_again(case: Case) -> None:
    rng = np.random.default_rng([SEED, 2])
    later = warmed(case.volume, rng, kelvin=25.0, bump_mm=0.3)
    found = correct_for_part(case.calibration, random_shots(later, case.volume.spheres, 4, rng, n_points=250).shots)
    assert found.accepted, found.reason
    part = random_shots(later, PART, 6, rng, noise=False, n_points=150).shots
    before, after = (length_errors_mm(c, part) for c in (case.calibration, found.calibration))
    assert rms(after) < 0.06
    assert rms(after) < 0.4 * rms(before)
    assert found.calibration.inputs["parent"] == case.calibration.id != found.calibration.id
    value, sigma = found.changes["expansion"]
    assert abs(value - 25 * STEEL_PER_K) < 3 * sigma
    assert sigma < 25 * STEEL_PER_K / 3
    assert found.left_out_mm["everything"] < 0.5 * found.left_out_mm["as it was"]


def test_where_nothing_changed_nothing_gets_worse(case: Case) -> None:
    rng = np.random.default_rng([SEED, 3])
    found = correct_for_part(case.calibration, random_shots(case.volume, case.volume.spheres, 4, rng, n_points=250).shots)
    inside = [abs(value) <= 3 * sigma for value, sigma in found.changes.values()]
    assert np.mean(inside) > 0.9
    part = random_shots(case.volume, PART, 6, rng, noise=False, n_points=150).shots
    before, after = (length_errors_mm(c, part) for c in (case.calibration, found.calibration))
    assert rms(after) < rms(before) + 0.015


def test_a_moved_fixture_moves_the_datum_with_it(case: Case) -> None:
    """Spheres and part on one fixture, set down elsewhere: in the base they are where they were."""
    rng = np.random.default_rng([SEED, 4])
    shots = random_shots(case.volume, case.volume.spheres, 4, rng, n_points=250).shots
    motion = se3.exp(np.array([0.8, -0.5, 0.6, 1e-3, -5e-4, 8e-4]))
    # a base frame that moved the other way is the same thing to arm and spheres
    moved = replace(case.calibration, datum=replace(case.calibration.datum, base_from_solver=motion @ case.calibration.datum.base_from_solver))
    found = correct_for_part(moved, shots)
    assert found.accepted
    assert found.left_out_mm["fixture"] < 0.2 * found.left_out_mm["as it was"]
    for shot in shots:
        at = np.array([shot.centre_in_camera_mm])
        centre, kept = (c.points_in_base_mm(at, joints_rad=shot.joints_rad)[0] for c in (found.calibration, case.calibration))
        assert np.linalg.norm(centre - kept) < 0.15


def test_what_the_correction_does_not_know_is_told_and_left_alone(case: Case) -> None:
    """One sphere was knocked against: spheres left out do not agree."""
    rng = np.random.default_rng([SEED, 5])
    places = dict(case.calibration.sphere_centres_in_base_mm)
    places["C"] = places["C"] + [0.6, -0.5, 0.4]
    knocked = replace(case.calibration, sphere_centres_in_base_mm=places)
    found = correct_for_part(knocked, random_shots(case.volume, case.volume.spheres, 4, rng, n_points=250).shots)
    assert not found.accepted
    assert found.calibration is knocked
    assert "sphere left out" in found.reason or "spheres left out" in found.reason


def test_too_few_spheres_and_no_axes_are_told(case: Case) -> None:
    rng = np.random.default_rng([SEED, 6])
    few = random_shots(case.volume, ("A", "B"), 5, rng, n_points=100).shots
    found = correct_for_part(case.calibration, few)
    assert not found.accepted
    assert "10 shots of 2 spheres are too few" in found.reason
    with pytest.raises(DataError, match="axis by axis"):
        correct_for_part(replace(case.calibration, model=None), few)
