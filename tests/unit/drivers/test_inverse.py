"""Inverse kinematics: round trips through the forward chain, completeness of the branches, limits, singular poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.errors import DataError, SettingsError
from drivers.kinematics import mdh, se3
from drivers.kinematics.inverse import all_branches, branches_of_many, inverse_near
from drivers.kinematics.jacobian import joint_jacobian
from drivers.kinematics.mdh import LinearLimit, RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model, shipped_models

UR = ("ur5e", "ur10e")
ABB = ("abb_irb1410", "irb1410_paper")
every_model = pytest.mark.parametrize("name", shipped_models())
HALF_PI = np.pi / 2


def joints_within_limits(model: RobotModel, n: int, seed: int = 0) -> FloatArray:
    low, high = model.joint_limits_rad.T
    q = np.random.default_rng(seed).uniform(low, high, (20 * n, model.n_joints))
    return np.asarray(q[mdh.within_limits(model, q)][:n])


def away_from_singular(model: RobotModel, q: FloatArray) -> FloatArray:
    """Those of the axis angles (k, n) that the pose determines well: a nearly singular arm loses its digits in the pose already."""
    weights = np.array([1, 1, 1, 500, 500, 500])[:, None]
    smallest = np.linalg.svd(joint_jacobian(model, q) * weights, compute_uv=False)[..., -1]
    return np.asarray(q[smallest > 1.0])


def twists(seed: int = 0) -> FloatArray:
    """Robot errors as large as real ones: 0.5 mm and 2 mrad a link."""
    return np.random.default_rng(seed).normal(size=(6, 6)) * [0.5, 0.5, 0.5, 2e-3, 2e-3, 2e-3]


def turned_apart(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray((first - second) - 2 * np.pi * np.round((first - second) / (2 * np.pi)))


def assert_reaches(model: RobotModel, joints: FloatArray, target: FloatArray) -> None:
    flange = mdh.base_from_flange(model, joints)
    assert np.abs(flange[..., :3, 3] - target[..., :3, 3]).max(initial=0) < 1e-9
    assert np.abs(flange[..., :3, :3] - target[..., :3, :3]).max(initial=0) < 1e-10
    assert mdh.within_limits(model, joints, -1e-11).all()


def lateral_shoulder() -> RobotModel:
    """A spherical-wrist arm with every offset that the family allows (shoulder, elbow and two side steps)."""
    return RobotModel(
        name="offsets",
        a_mm=np.array([30.0, 120, -430, 95, 0, 0]),
        alpha_rad=np.array([0.2, -1.1, np.pi, 1.3, -0.9, 1.2]),
        d_mm=np.array([400.0, 110, -60, 480, 0, 90]),
        theta_offset_rad=np.array([0.1, -0.7, 0.4, 1.0, 0.2, -2.0]),
        coupling=np.eye(6),
        joint_limits_rad=np.tile([-np.pi, np.pi], (6, 1)),
    )


@every_model
def test_the_branches_hold_the_axis_angles_that_made_the_pose(name: str) -> None:
    model = load_robot_model(name)
    q = away_from_singular(model, joints_within_limits(model, 150))
    assert len(q) > 100
    for one in q:
        target = mdh.base_from_flange(model, one)
        branches = all_branches(model, target)
        assert_reaches(model, branches, target)
        assert np.abs(branches - one).max(axis=1).min() < 1e-9


@every_model
def test_no_branch_is_returned_twice(name: str) -> None:
    model = load_robot_model(name)
    for one in joints_within_limits(model, 30):
        branches = all_branches(model, mdh.base_from_flange(model, one))
        apart = np.abs(branches[:, None] - branches).max(axis=-1) + 10 * np.eye(len(branches))
        assert apart.min() > 1e-7


def test_an_arm_with_every_offset_of_the_family_is_solved() -> None:
    model = lateral_shoulder()
    for one in away_from_singular(model, joints_within_limits(model, 60)):
        target = mdh.base_from_flange(model, one)
        branches = all_branches(model, target)
        assert_reaches(model, branches, target)
        assert np.abs(branches - one).max(axis=1).min() < 1e-9


@every_model
def test_branches_are_all_branches_found_by_random_newton_starts(name: str) -> None:
    """Completeness, by a method that shares nothing with the closed form but the forward chain."""
    model = load_robot_model(name)
    free = replace(model, joint_limits_rad=np.tile([-np.inf, np.inf], (6, 1)), linear_limits=())
    rng = np.random.default_rng(5)
    target = mdh.base_from_flange(model, away_from_singular(model, joints_within_limits(model, 20, seed=3))[0])
    ours, seen = all_branches(free, target), []
    for start in rng.uniform(-np.pi, np.pi, (150, 6)):
        found = by_newton(free, target, start)
        if found is not None:
            seen.append(int(np.argmin(np.abs(turned_apart(mdh.link_angles_rad(free, ours), found)).max(axis=1))))
            assert np.abs(turned_apart(mdh.link_angles_rad(free, ours), found)).max(axis=1).min() < 1e-6
    assert len(set(seen)) == len(ours)


def by_newton(model: RobotModel, target: FloatArray, start: FloatArray) -> FloatArray | None:
    """Link angles by damped finite-difference Newton steps, or None."""
    q = start
    for _ in range(60):
        miss = se3.log(target @ se3.inverse(mdh.base_from_flange(model, q)))
        if np.abs(miss).max() < 1e-8:
            return mdh.link_angles_rad(model, q)
        step = np.linalg.lstsq(joint_jacobian(model, q), miss)[0]
        q = q + step * min(1.0, 0.5 / np.abs(step).max())
    return None


@pytest.mark.parametrize("name", UR)
def test_all_whole_turns_of_a_ur_are_found(name: str) -> None:
    model = load_robot_model(name)
    one = np.array([0.3, -1.2, 1.4, -0.9, 0.8, 0.5])
    branches = all_branches(model, mdh.base_from_flange(model, one))
    same_arm = np.abs(turned_apart(branches, one)).max(axis=1) < 1e-6
    assert same_arm.sum() == 2**6  # each angle, and itself one turn back


def test_whole_turns_respect_the_parallelogram() -> None:
    """A turn of theta2 is a turn of q2 and of q3, since theta3 = q3 - q2 must stay."""
    model = replace(load_robot_model("abb_irb1410"), joint_limits_rad=np.tile([-6.3, 6.3], (6, 1)))
    one = np.array([0.1, 0.2, 0.5, 0.3, 0.8, 0.4])
    branches = all_branches(model, mdh.base_from_flange(model, one))
    assert_reaches(model, branches, mdh.base_from_flange(model, one))
    same_arm = branches[np.abs(turned_apart(branches, one)).max(axis=1) < 1e-6]
    turns = np.round((same_arm - one) / (2 * np.pi)).astype(int)
    assert {tuple(row) for row in turns[:, 1:3]} == {(0, 0), (-1, -1)}
    assert len(same_arm) == 2**5


@every_model
def test_limits_are_kept_and_nothing_inside_them_is_lost(name: str) -> None:
    """The branches of a narrowed robot are those of the wide one that pass the narrow limits."""
    model = load_robot_model(name)
    rows = (*model.linear_limits, LinearLimit(np.array([0.0, 1, 0, 0.5, 0, 0]), -0.9, 0.8))
    narrow = replace(model, joint_limits_rad=model.joint_limits_rad * 0.6 + 0.1, linear_limits=rows)
    narrowed = 0
    for one in joints_within_limits(model, 40, seed=2):
        target = mdh.base_from_flange(model, one)
        wide, inside = all_branches(model, target), all_branches(narrow, target)
        expected = wide[mdh.within_limits(narrow, wide)]
        narrowed += len(wide) - len(expected)
        assert len(inside) >= len(expected)
        assert all(np.abs(inside - row).max(axis=1).min() < 1e-8 for row in expected)
        assert mdh.within_limits(narrow, inside).all()
    assert narrowed > 0


@every_model
def test_the_many_are_the_single_ones_each_in_one_turn(name: str) -> None:
    model = load_robot_model(name)
    q = joints_within_limits(model, 25)
    targets = mdh.base_from_flange(model, q)
    targets[3, :3, 3] += 5000  # out of reach
    many = branches_of_many(model, targets)
    assert not many.reachable[3]
    assert many.reachable.sum() == 24
    assert (np.diff(many.target) >= 0).all()
    assert_reaches(model, many.joints_rad, targets[many.target])
    for i in range(25):
        single, rows = all_branches(model, targets[i]), many.joints_rad[many.target == i]
        assert all(np.abs(single - row).max(axis=1).min() < 1e-8 for row in rows)
        arms = {tuple(np.round(turned_apart(row, np.zeros(6)), 5) % np.round(2 * np.pi, 5)) for row in single}
        assert len(rows) == len(arms)


@every_model
def test_the_margin_is_kept_from_every_limit(name: str) -> None:
    model = load_robot_model(name)
    targets = mdh.base_from_flange(model, joints_within_limits(model, 200))
    many = branches_of_many(model, targets, margin_rad=0.2)
    assert 0 < len(many.target) < len(branches_of_many(model, targets).target) or name in UR
    assert mdh.within_limits(model, many.joints_rad, 0.2).all()


@every_model
def test_out_of_reach_gives_no_branch(name: str) -> None:
    model = load_robot_model(name)
    target = mdh.base_from_flange(model, np.full(6, 0.2))
    target[:3, 3] = [5000, 0, 0]
    assert all_branches(model, target).shape == (0, 6)


@pytest.mark.parametrize("name", ABB)
@pytest.mark.parametrize("wrist", [0.0, 1e-13, 1e-11, 1e-10, 1e-9, 3e-8, 1e-6])
def test_a_straight_wrist_is_solved(name: str, wrist: float) -> None:
    model = load_robot_model(name)
    one = np.array([0.2, 0.3, 0.6, 0.7, wrist, 0.4])
    target = mdh.base_from_flange(model, one)
    branches = all_branches(model, target)
    assert_reaches(model, branches, target)
    same_arm = np.abs(branches[:, :3] - one[:3]).max(axis=1) < 1e-6
    assert same_arm.any()


@pytest.mark.parametrize("name", UR)
@pytest.mark.parametrize("one", [(0.1, -1, 1.2, -0.4, 0, 0.3), (0.1, -1, 1.2, -0.4, 1e-10, 0.3), (0, -HALF_PI, 0, -HALF_PI, 0, 0), (0,) * 6])
def test_a_ur_with_its_last_axis_along_the_arm_is_solved(name: str, one: tuple[float, ...]) -> None:
    model = load_robot_model(name)
    target = mdh.base_from_flange(model, one)
    branches = all_branches(model, target)
    assert len(branches) > 0
    assert_reaches(model, branches, target)


@every_model
def test_a_stretched_arm_is_not_lost_to_rounding(name: str) -> None:
    """At the end of its reach two branches become one, and the cosine of the elbow may round above 1."""
    model = load_robot_model(name)
    # spherical wrists: the wrist point lies a3, d4 from the elbow, so the arm is straight where these line up with the upper arm
    theta3 = 0.0 if name in UR else np.arctan2(720, 120) * (1 if name == "irb1410_paper" else -1)
    free = replace(model, joint_limits_rad=np.tile([-7.0, 7.0], (6, 1)), linear_limits=())
    for seed in range(20):
        theta = mdh.link_angles_rad(free, np.random.default_rng(seed).uniform(-1, 1, 6))
        theta[2], theta[4] = theta3, 1.0
        one = mdh.joints_from_link_angles_rad(free, theta)
        target = mdh.base_from_flange(free, one)
        branches = all_branches(free, target)
        assert_reaches(free, branches, target)
        assert np.abs(turned_apart(branches, one)).max(axis=1).min() < 1e-4


@pytest.mark.parametrize("name", ABB)
def test_a_wrist_on_the_first_axis_is_solved(name: str) -> None:
    """There axis 1 turns freely; the pose is bent back until the wrist point stands above the base."""
    model = replace(load_robot_model(name), joint_limits_rad=np.tile([-7.0, 7.0], (6, 1)), linear_limits=())
    target = se3.from_rotation_translation(np.eye(3), [0, 0, 475 + 700 + 85])
    branches = all_branches(model, target)
    assert len(branches) > 0
    assert_reaches(model, branches, target)


@every_model
def test_a_rounded_rotation_from_a_file_is_taken(name: str) -> None:
    model = load_robot_model(name)
    target = mdh.base_from_flange(model, away_from_singular(model, joints_within_limits(model, 10))[0])
    assert len(all_branches(model, np.round(target, 7))) == len(all_branches(model, target))


@every_model
def test_near_with_link_twists_reaches_with_the_corrected_robot(name: str) -> None:
    model, xi = load_robot_model(name), twists()
    rng = np.random.default_rng(1)
    inner = replace(model, joint_limits_rad=model.joint_limits_rad * 0.95)
    for one in away_from_singular(model, joints_within_limits(inner, 20)):
        target = mdh.base_from_flange(model, one, xi)
        near = one + rng.uniform(-0.02, 0.02, 6)
        found = inverse_near(model, target, near, xi)
        assert np.abs(mdh.base_from_flange(model, found, xi) - target).max() < 1e-9
        assert np.abs(found - near).max() <= np.abs(one - near).max() + 1e-9


@every_model
def test_near_chooses_the_branch_with_the_least_motion(name: str) -> None:
    model = load_robot_model(name)
    for one in away_from_singular(model, joints_within_limits(model, 8)):
        target = mdh.base_from_flange(model, one)
        for branch in all_branches(model, target)[::37]:
            np.testing.assert_allclose(inverse_near(model, target, branch), branch, atol=1e-8)


def test_near_keeps_a_straight_wrist_where_it_was() -> None:
    """All splits between axes 4 and 6 reach the pose; the one at hand is kept."""
    model = load_robot_model("abb_irb1410")
    one = np.array([0.2, 0.3, 0.6, 0.7, 0.0, 0.4])
    np.testing.assert_allclose(inverse_near(model, mdh.base_from_flange(model, one), one), one, atol=1e-9)


def test_near_tells_out_of_reach_from_outside_the_limits() -> None:
    model = load_robot_model("abb_irb1410")
    target = mdh.base_from_flange(model, np.full(6, 0.2))
    with pytest.raises(DataError, match="outside the limits"):
        inverse_near(replace(model, joint_limits_rad=np.tile([2.0, 2.1], (6, 1))), target, np.full(6, 2.05))
    target[:3, 3] = [3000, 0, 500]
    with pytest.raises(DataError, match=r"3000.*cannot reach"):
        inverse_near(model, target, np.zeros(6))


def seven_axes() -> RobotModel:
    return RobotModel(
        name="seven",
        a_mm=np.zeros(7),
        alpha_rad=np.array([0, -1, 1, 1, -1, 1, -1]) * HALF_PI,
        d_mm=np.array([340.0, 0, 400, 0, 400, 0, 126]),
        theta_offset_rad=np.zeros(7),
        coupling=np.eye(7),
        joint_limits_rad=np.tile([-2.9, 2.9], (7, 1)),
    )


def test_an_arm_without_closed_form_is_told_and_still_solved_from_a_near_pose() -> None:
    model, q = seven_axes(), np.array([0.1, 0.5, -0.3, 1.0, 0.2, 0.7, -0.1])
    target = mdh.base_from_flange(model, q)
    with pytest.raises(SettingsError, match=r"no closed-form.*'seven'"):
        all_branches(model, target)
    found = inverse_near(model, target, q + 0.05)
    np.testing.assert_allclose(mdh.base_from_flange(model, found), target, atol=1e-9)


@pytest.mark.parametrize("target", [np.eye(3), np.full((4, 4), np.nan), np.diag([1, 1, 2, 1.0])])
def test_a_target_that_is_no_transform_is_refused(target: FloatArray) -> None:
    with pytest.raises(SettingsError, match="no rigid transform"):
        all_branches(load_robot_model("ur5e"), target)
