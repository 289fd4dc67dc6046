"""Terms of the arm: those that a simulated arm has are found and make unseen lengths better, and nothing is found where none is."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.robot_terms import RobotTerm
from calibrate.solve import CalibrationSettings, Solved, solve_observations
from calibrate.term_choice import choose_terms
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.draws import Sizes
from tests.support.solving import one_thread
from tests.support.volume import UNSEEN, VolumeCell, measured_centres, random_shots, unseen_lengths, volume_cell


def solved(volume: VolumeCell, robot_terms: str, seed: int) -> tuple[Solved, dict[str, float], FloatArray]:
    """A solve on 90 random shots, what was compared, and the errors of unseen lengths."""
    rng = np.random.default_rng([seed, 1])
    shots = random_shots(volume, volume.spheres, 15, rng, n_points=150)
    test = random_shots(volume, tuple(UNSEEN), 5, rng, noise=False, n_points=100)
    with one_thread():
        found, compared = solve_observations(shots, volume.cell, volume.model, CalibrationSettings("field", robot_terms=robot_terms))
    return found, compared, unseen_lengths(measured_centres(found, test))


@pytest.mark.parametrize(
    ("sizes", "expected"),
    [(Sizes(droop_rad=1e-3), {"compliance"}), pytest.param(Sizes(gear_rad=2e-4), {"sine", "cosine"}, marks=pytest.mark.qualify)],
    ids=["droop", "gears"],
)
def test_what_the_arm_has_is_found_and_makes_lengths_better(sizes: Sizes, expected: set[str]) -> None:
    volume = volume_cell(77, "bar3", sizes=sizes)
    rigid, _, before_mm = solved(volume, "none", 77)
    found, compared, after_mm = solved(volume, "auto", 77)
    assert {term.kind for term in found.solution.problem.terms if term.estimated} == expected
    assert not any(term.estimated for term in rigid.solution.problem.terms)
    assert np.sqrt((after_mm**2).mean()) < 0.75 * np.sqrt((before_mm**2).mean())
    assert found.held_out.centre_rms_mm < 0.95 * rigid.held_out.centre_rms_mm
    # the linear folds of the choice are those of the solve
    assert list(compared.values())[-1] == pytest.approx(found.held_out.centre_rms_mm, rel=0.05)
    if expected == {"sine", "cosine"}:
        right = {RobotTerm(kind, axis, 12, True) for kind in ("sine", "cosine") for axis in (1, 2)}
        assert {term for term in found.solution.problem.terms if term.estimated} == right


def test_a_rigid_arm_stays_rigid() -> None:
    volume = volume_cell(78, "bar3", sizes=Sizes(droop_rad=0.0, gear_rad=0.0, backlash_rad=0.0))
    found, compared, _ = solved(volume, "auto", 78)
    assert not compared
    assert not any(term.estimated for term in found.solution.problem.terms)
    assert choose_terms(found.solution).names == ()
