"""Quick checks on a simulated cell whose errors are not the solver's models; full counts in tests/qualify/test_quick_check.py."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate.check_design import clarity, ideal_shots
from calibrate.drift_causes import HAND_EYE, SPHERE, causes_of, named
from calibrate.few_parameters import resolve
from calibrate.observations import SphereShot
from calibrate.quick_check import changes_since, check_residuals, known_state
from calibrate.result import Calibration
from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.quick.since import since_earlier
from tests.support.drifting import CheckedCell, after_two, check_shots, diagnosis_of, small_checked_cell, told_of
from tests.support.volume import DIAMETER_MM

SEED = 61_001
N_AXES = 6


@pytest.fixture(scope="module")
def checked() -> CheckedCell:
    return small_checked_cell()


def shots_after(checked: CheckedCell, cause: str | None, size: float = 1.0, seed: int = 0) -> list[SphereShot]:
    return check_shots(checked, cause, np.random.default_rng([SEED, seed]), size=size)


def test_nothing_changed_is_told_as_nothing(checked: CheckedCell) -> None:
    found = [diagnosis_of(checked, shots_after(checked, None, seed=seed)) for seed in range(6)]
    assert sum(d.changed for d in found) <= 1
    assert named(next(d for d in found if not d.changed), N_AXES) == ()
    assert 0.4 < np.mean([d.chi_square / d.freedom for d in found]) < 1.8


@pytest.mark.parametrize("cause", ["hand-eye", "axis 2", "axis 3", "axis 4", "axis 5", "camera"])
def test_a_change_of_twice_the_stated_size_is_named(checked: CheckedCell, cause: str) -> None:
    found = diagnosis_of(checked, shots_after(checked, cause, size=2.0, seed=1))
    assert found.changed
    assert named(found, N_AXES) == (cause,)


@pytest.mark.parametrize(("cause", "alike"), [("axis 1", {"axis 1", SPHERE}), ("axis 6", {"axis 6", HAND_EYE})])
def test_what_no_pose_tells_apart_is_told_together(checked: CheckedCell, cause: str, alike: set[str]) -> None:
    found = diagnosis_of(checked, shots_after(checked, cause, size=6.0, seed=2))
    assert set(named(found, N_AXES)) == alike


def test_the_size_of_a_change_is_told_with_its_sign(checked: CheckedCell) -> None:
    """0.5 mrad on axis 3: what is told is what the axis now reads too little, within its own uncertainty."""
    offset = 5e-4
    shots = [replace(shot, joints_rad=turned(shot.joints_rad, -offset)) for shot in shots_after(checked, None, seed=3)]
    found = diagnosis_of(checked, shots).explanations[0]
    value, sigma = found.amplitudes["axis3_rad"]
    assert found.name == "axis 3"
    assert abs(value - offset) < 4 * sigma < offset


def turned(joints_rad: FloatArray | None, by_rad: float) -> FloatArray:
    assert joints_rad is not None
    return np.asarray(joints_rad + by_rad * np.eye(N_AXES)[2])


def test_residuals_follow_the_calibration_as_their_sensitivity_says(checked: CheckedCell) -> None:
    """Finite differences of every column of the hand-eye and of a sphere's centre."""
    calibration, shots = checked.calibration, shots_after(checked, None, seed=4)
    before = check_residuals(calibration, shots)
    layout = before.problem.layout
    for k, step in enumerate([1e-3] * 3 + [1e-6] * 3):
        moved = replace(calibration, flange_from_camera=se3.exp(step * np.eye(6)[k]) @ calibration.flange_from_camera)
        rate = (check_residuals(moved, shots).residual_mm - before.residual_mm) / step
        expected = before.sensitivity[:, :, layout.hand_eye.start + k]
        assert np.abs(rate - expected).max() < 2e-3 * np.abs(expected).max()


def test_the_order_of_the_shots_changes_nothing(checked: CheckedCell) -> None:
    shots = shots_after(checked, "axis 4", seed=5)
    found, other = diagnosis_of(checked, shots), diagnosis_of(checked, shots[::-1])
    assert other.chi_square == pytest.approx(found.chi_square)
    assert [e.name for e in other.explanations] == [e.name for e in found.explanations]


def test_one_spoiled_shot_is_told_as_that(checked: CheckedCell) -> None:
    shots = shots_after(checked, None, seed=6)
    shots[3] = replace(shots[3], points_in_camera_mm=shots[3].points_in_camera_mm + np.array([0.0, 0.9, 0.0]))
    assert named(diagnosis_of(checked, shots), N_AXES) == ("single shot",)


def test_two_changes_at_once_are_told_as_two(checked: CheckedCell) -> None:
    causes = ("axis 3", SPHERE)
    _, together = told_of(checked, after_two(checked, causes, np.random.default_rng([SEED, 8]), size=4.0))
    assert together is not None
    assert together.log_odds > np.log(1e4)
    assert {*together.pairs[0].causes} == {*causes}
    assert sum(pair.probability for pair in together.pairs) <= 1.0
    for cause in (None, "axis 3", "hand-eye", SPHERE):
        assert told_of(checked, shots_after(checked, cause, size=2.0, seed=9))[1] is None, cause


def test_an_earlier_check_takes_out_what_the_calibration_leaves(checked: CheckedCell) -> None:
    """A calibration that is wrong, and sure of itself, alarms at once; against an earlier check only what changed in between shows."""
    wrong = replace(checked.calibration, flange_from_camera=checked.calibration.flange_from_camera @ se3.exp(np.array([0.4, -0.3, 0.2, 0, 0, 0])))
    of_wrong = replace(checked, calibration=wrong)
    earlier = [replace(shot, session="earlier") for shot in shots_after(checked, None, seed=10)]
    assert diagnosis_of(of_wrong, earlier).changed
    names = []
    for cause, size in ((None, 1.0), ("axis 3", 2.0)):
        since = since_earlier(wrong, "earlier", earlier[::-1], shots_after(checked, cause, size=size, seed=11))
        assert since.n_matched == 8
        names.append(since.named)
    assert names == [(), ("axis 3",)]
    # the two have the noise of poses and points twice, and nothing of the calibration
    residuals = changes_since(wrong, earlier, shots_after(checked, None, seed=12))
    assert residuals is not None
    sure = changes_since(replace(wrong, covariance=1e-12 * wrong.covariance), earlier, shots_after(checked, None, seed=12))
    assert sure is not None
    np.testing.assert_allclose(residuals.covariance_mm2, sure.covariance_mm2, atol=1e-6)
    with pytest.raises(DataError, match="3 of 8 shots repeat a pose"):
        since_earlier(wrong, "earlier", earlier[:3], shots_after(checked, None, seed=12))


def test_a_sphere_that_the_calibration_never_saw_is_refused(checked: CheckedCell) -> None:
    shots = [replace(shot, sphere="T") for shot in shots_after(checked, None)]
    with pytest.raises(DataError, match="has not seen sphere T"):
        check_residuals(checked.calibration, shots)


def test_chosen_poses_tell_causes_apart_better_than_random_ones(checked: CheckedCell) -> None:
    """The least separation of any cause from any other, in standard deviations."""
    rng, pool = np.random.default_rng(SEED), checked.candidates_rad
    random = [_least(checked.calibration, pool[rng.permutation(len(pool))[:8]]) for _ in range(7)]
    assert _least(checked.calibration, checked.joints_rad) > 1.15 * np.median(random)
    assert _least(checked.calibration, checked.joints_rad) == pytest.approx(min(checked.design.separations.values()), rel=1e-6)


def _least(calibration: Calibration, joints: FloatArray) -> float:
    residuals = check_residuals(calibration, ideal_shots(calibration, joints, ["A"] * len(joints), {"A": DIAMETER_MM / 2}))
    state = known_state(calibration, residuals.problem.n_scans)
    told = clarity(residuals, causes_of(residuals, state, tuple(calibration.sphere_centres_in_base_mm)))
    return min(apart for _, apart in told.values())


@pytest.mark.parametrize("cause", ["hand-eye", "axis 3"])
def test_few_parameters_solved_anew_name_their_parent_and_help_shots_that_were_left_out(checked: CheckedCell, cause: str) -> None:
    parent, shots = checked.calibration, shots_after(checked, cause, seed=7)
    found = resolve(parent, shots, cause, created_utc="2026-01-02T00:00:00Z", software="tests", session_names=["s"])
    assert found.accepted
    assert found.p_value_after > 0.01
    new = found.calibration
    assert new.id != parent.id
    assert new.inputs["parent"] == parent.id
    assert new.verdict == "marginal"
    assert len(new.shots) == len(parent.shots) + len(shots)
    # fresh shots, which neither calibration has seen
    fresh = shots_after(checked, cause, seed=7)
    assert check_residuals(new, fresh).rms_mm < 0.8 * check_residuals(parent, fresh).rms_mm
    # the change is not known better than it was measured, and nothing else is known better than before
    assert np.linalg.eigvalsh(new.covariance).min() > -1e-9 * np.linalg.eigvalsh(new.covariance).max()


def test_an_axis_solved_anew_covers_the_change(checked: CheckedCell) -> None:
    shots = [replace(shot, joints_rad=turned(shot.joints_rad, -5e-4)) for shot in shots_after(checked, None, seed=8)]
    found = resolve(checked.calibration, shots, "axis 3", created_utc="2026-01-02T00:00:00Z", software="tests", session_names=["s"])
    value, sigma = found.amplitudes["axis3_rad"]
    assert abs(value - 5e-4) < 4 * sigma < 5e-4


def test_what_few_shots_cannot_settle_is_refused(checked: CheckedCell) -> None:
    shots = shots_after(checked, "camera", seed=9)
    for cause, n, message in (("camera", 8, "cannot settle"), ("axis 9", 8, "nothing that a few shots"), ("axis 2", 3, "too few")):
        with pytest.raises(DataError, match=message):
            resolve(checked.calibration, shots[:n], cause, created_utc="", software="", session_names=[])
