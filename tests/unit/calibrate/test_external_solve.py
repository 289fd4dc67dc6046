"""A robot calibrated by a laser tracker alone: accuracy against the bound, first guess from nothing, spoiled points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calibrate.external import external_rows
from calibrate.external_points import ExternalShot, external_points
from calibrate.external_solve import ExternalSolved, folds_of, predicted_rms_mm, rms_mm, solve_robot_alone
from calibrate.normal import symmetric_inverse
from calibrate.problem import Priors, State
from calibrate.robot_terms import arm_terms, deflection_rad
from drivers.errors import DataError
from drivers.kinematics import mdh, se3
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.draws import Sizes
from tests.support.tracker import TrackedRobot, pose_errors_mm, tracked_robot

OWN_MODEL = Sizes(droop_rad=0.0, backlash_rad=0.0, gear_rad=0.0, drift_mm_per_hour=0.0, drift_rad_per_hour=0.0)


def solved(robot: TrackedRobot, shots: list[ExternalShot]) -> ExternalSolved:
    return solve_robot_alone(shots, robot.model, Priors(), None)


def flange_of(robot: TrackedRobot, found: ExternalSolved, joints_rad: FloatArray) -> FloatArray:
    state, terms = found.solution.state, found.solution.problem.terms
    return mdh.base_from_flange(robot.model, joints_rad, state.link_twists, deflection_rad(terms, state.terms_rad, robot.model, joints_rad))


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.square(values).mean()))


def test_held_out_places_are_missed_by_what_the_first_order_bound_says() -> None:
    seen, bound = [], []
    for seed in range(4):
        robot, rng = tracked_robot(100 + seed, sizes=OWN_MODEL), np.random.default_rng([seed, 3])
        found = solved(robot, robot.shots(rng, 40))
        quiet = replace(robot, noise_mm=0.0, truth=replace(robot.truth, pose_noise_mm=0.0, pose_noise_rad=0.0))
        unseen = quiet.shots(rng, 100)
        problem = found.solution.problem
        rows = external_rows(replace(problem, external=external_points(unseen, robot.model, arm_terms(robot.model))), _quiet(found, 100))
        assert rows is not None
        spread = rows.columns @ symmetric_inverse(found.solution.reduced.hessian) @ np.swapaxes(rows.columns, 1, 2)
        seen.append(rms(np.linalg.norm(rows.residual_mm, axis=1)))
        bound.append(float(np.sqrt(np.trace(spread, axis1=1, axis2=2).mean())))
    assert 0.75 < np.median(np.array(seen) / bound) < 1.25
    assert max(bound) < 0.06


def _quiet(found: ExternalSolved, n_stops: int) -> State:
    return replace(found.solution.state, pose_noise=np.zeros((n_stops, 6)))


@pytest.mark.parametrize("model_name", ["abb_irb1410", "ur10e"])
def test_a_robot_that_droops_and_tilts_comes_out_ten_times_better(model_name: str) -> None:
    robot, rng = tracked_robot(7, model_name=model_name), np.random.default_rng(8)
    found = solved(robot, robot.shots(rng, 40))
    joints = robot.poses(rng, 200)
    true = robot.true_flange(joints)
    before, after = rms(pose_errors_mm(mdh.base_from_flange(robot.model, joints), true)), rms(pose_errors_mm(flange_of(robot, found, joints), true))
    assert after < 0.06
    assert after < before / 10
    # what it says of itself: points left out are missed by the noise of a point and the robot's own error together
    held_out = rms_mm(found.held_out_mm)
    assert after < held_out < 3 * after
    assert 0.6 < held_out / predicted_rms_mm(found.solution) < 1.3
    assert not found.rejected
    # gravity shows in the points, and is estimated where it pays
    assert found.compared["yielding"] < 0.9 * found.compared["rigid"]
    droop = deflection_rad(found.solution.problem.terms, found.solution.state.terms_rad, robot.model, joints)
    assert droop is not None
    assert 2e-5 < rms(droop[:, 1]) < 2e-4


def test_an_arm_without_droop_is_held_rigid() -> None:
    yields = []
    for seed in range(3):
        robot = tracked_robot(300 + seed, sizes=OWN_MODEL)
        found = solved(robot, robot.shots(np.random.default_rng(seed), 25))
        yields.append(bool(found.solution.problem.free_terms.any()))
        assert bool((np.abs(found.solution.state.terms_rad) > 1e-9).any()) == yields[-1]
    assert sum(yields) <= 1


def test_the_trackers_scale_is_the_robots() -> None:
    """A robot whose every length is 0.05 % off: a tracker shows it, and lengths between flange places come right."""
    robot, rng = tracked_robot(9, sizes=OWN_MODEL), np.random.default_rng(10)
    grown = replace(robot.truth, a_error_mm=tuple(5e-4 * robot.model.a_mm), d_error_mm=tuple(5e-4 * robot.model.d_mm))
    robot = replace(robot, truth=grown)
    found = solved(robot, robot.shots(rng, 40))
    joints = robot.poses(rng, 60)

    def lengths(flange: FloatArray) -> FloatArray:
        places = se3.apply(flange, [0.0, 0.0, 150.0])
        return np.asarray(np.linalg.norm(places[:30] - places[30:], axis=1))

    true = lengths(robot.true_flange(joints))
    nominal, calibrated = lengths(mdh.base_from_flange(robot.model, joints)), lengths(flange_of(robot, found, joints))
    scale = [float((of @ true) / (true @ true)) for of in (nominal, calibrated)]
    assert abs(scale[0] - 1) > 3e-4
    assert abs(scale[1] - 1) < 4e-5


@pytest.mark.parametrize("turn", [[0, 0, 0], [np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi], [2.2, 2.2, 0.1]])
def test_any_orientation_of_the_tracker_will_do(turn: list[float]) -> None:
    robot, rng = tracked_robot(11), np.random.default_rng(12)
    turned = replace(robot, base_from_tracker=se3.from_rotation_translation(se3.exp_so3(turn), [3000.0, -2000.0, 500.0]))
    found = solved(turned, turned.shots(rng, 25))
    off = se3.log(se3.inverse(turned.base_from_tracker) @ found.solution.state.base_from_reference[0])
    assert np.linalg.norm(off[3:]) < 5e-3
    assert not found.rejected


def test_two_frames_and_two_targets_are_found_together() -> None:
    targets = {"high": (45.0, -30.0, 120.0), "low": (-120.0, 60.0, 20.0)}
    robot, rng = tracked_robot(13, targets=targets), np.random.default_rng(14)
    other = replace(robot, base_from_tracker=se3.exp([500, 200, 1800, 0.4, 2.0, -1.0]))
    shots = []
    for i, q in enumerate(robot.poses(rng, 40)):
        station, name = (robot, "front") if i < 20 else (other, "back")
        shots += [ExternalShot("s", 2 * i + k, name, target, q, station.see(rng, q, target)) for k, target in enumerate(targets)]
    state = solved(robot, shots).solution.state
    high, low = targets.values()
    between = np.linalg.norm(state.target_in_flange_mm[0] - state.target_in_flange_mm[1])
    assert between == pytest.approx(np.linalg.norm(np.subtract(high, low)), abs=0.1)
    found = se3.inverse(state.base_from_reference[1]) @ state.base_from_reference[0]  # front from back
    wanted = se3.inverse(robot.base_from_tracker) @ other.base_from_tracker
    assert np.linalg.norm(found[:3, 3] - wanted[:3, 3]) < 0.5


@pytest.mark.parametrize("miss_mm", [1.0, 700.0])
def test_spoiled_points_are_rejected_with_the_reason_and_harm_nothing(miss_mm: float) -> None:
    robot, rng = tracked_robot(15), np.random.default_rng(16)
    shots = robot.shots(rng, 40)
    clean = solved(robot, shots)
    bad = {3, 17, 20, 36}
    step = miss_mm * np.array([0.6, -0.8, 0.0])
    spoiled = [replace(s, point_in_reference_mm=s.point_in_reference_mm + step) if s.index in bad else s for s in shots]
    found = solved(robot, spoiled)
    assert {shot.index for shot in found.rejected} == bad
    assert all(shot.reason.startswith("outlier: its target reflector lies") for shot in found.rejected)
    joints = robot.poses(rng, 100)
    moved = pose_errors_mm(flange_of(robot, found, joints), flange_of(robot, clean, joints))
    assert rms(moved) < 0.05


def test_the_order_of_shots_changes_nothing() -> None:
    robot, rng = tracked_robot(17), np.random.default_rng(18)
    shots = robot.shots(rng, 30)
    order = rng.permutation(30).tolist()
    first, second = solved(robot, shots), solved(robot, [shots[i] for i in order])
    joints = robot.poses(rng, 50)
    apart = flange_of(robot, first, joints)[:, :3, 3] - flange_of(robot, second, joints)[:, :3, 3]
    assert np.abs(apart).max() < 1e-6
    np.testing.assert_allclose(second.held_out_mm, first.held_out_mm[order], atol=1e-5)


_MISTAKES: dict[str, Callable[[ExternalShot], ExternalShot]] = {
    "metres": lambda s: replace(s, point_in_reference_mm=s.point_in_reference_mm / 1000),
    "left-handed": lambda s: replace(s, point_in_reference_mm=s.point_in_reference_mm * [1, 1, -1]),
    "reverse order": lambda s: replace(s, joints_rad=s.joints_rad[::-1]),
    "degrees": lambda s: replace(s, joints_rad=np.degrees(s.joints_rad)),
}


@pytest.mark.parametrize("cause", list(_MISTAKES))
def test_a_mistake_is_named(cause: str) -> None:
    robot, rng = tracked_robot(19), np.random.default_rng(20)
    with pytest.raises(DataError, match=cause):
        solved(robot, [_MISTAKES[cause](shot) for shot in robot.shots(rng, 25)])


def test_points_that_belong_to_other_poses_are_no_calibration() -> None:
    robot, rng = tracked_robot(19), np.random.default_rng(20)
    shots = robot.shots(rng, 25)
    points = rng.permutation([shot.point_in_reference_mm for shot in shots])
    with pytest.raises(DataError, match="no single cause"):
        solved(robot, [replace(shot, point_in_reference_mm=point) for shot, point in zip(shots, points, strict=True)])
    rolled = [replace(shot, point_in_reference_mm=shots[i - 1].point_in_reference_mm) for i, shot in enumerate(shots)]
    with pytest.raises(DataError, match="shifted by one shot"):
        solved(robot, rolled)


def test_a_target_seen_once_in_its_own_frame_cannot_be_left_out() -> None:
    robot, rng = tracked_robot(21), np.random.default_rng(22)
    shots = robot.shots(rng, 25)
    lone = replace(robot.shots(rng, 1, first=99)[0], target="other")
    found = solved(robot, [*shots, lone])
    points = found.solution.problem.external
    assert points is not None
    assert folds_of(points, 10).max() == 25
    assert np.isnan(found.held_out_mm).any(axis=1).tolist() == [False] * 25 + [True]
    assert np.isfinite(rms_mm(found.held_out_mm))
