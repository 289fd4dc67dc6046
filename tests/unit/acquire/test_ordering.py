"""Spread of chosen poses and length of the way through them, each against what chance gives."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.candidates import CandidatePool
from acquire.ordering import choose_spread, order_by_travel, travel_rad
from drivers.errors import SettingsError
from drivers.kinematics import se3


def pool(n: int, seed: int = 0, views: int | None = None) -> CandidatePool:
    rng = np.random.default_rng(seed)
    base_from_camera = se3.exp(rng.normal(size=(n, 6)))
    centres = rng.normal(size=(n, 3)) * [30, 20, 40] + [0, 0, 400]
    view = np.arange(n) if views is None else np.sort(rng.integers(0, views, n))
    return CandidatePool(rng.uniform(-1, 1, (n, 6)), base_from_camera, base_from_camera, centres, view.astype(np.intp), n)


def test_chosen_poses_are_spread_wider_than_random_ones() -> None:
    candidates = pool(500)
    rows = choose_spread(candidates, 40, np.random.default_rng(0))
    rng = np.random.default_rng(1)

    def nearest_pair(of: np.ndarray[tuple[int, ...], np.dtype[np.intp]]) -> float:
        centres = candidates.centre_in_camera_mm[of]
        apart = np.linalg.norm(centres[:, None] - centres, axis=-1) + 1e9 * np.eye(len(of))
        return float(apart.min(axis=1).mean())

    by_chance = [rng.choice(500, 40, replace=False) for _ in range(20)]
    assert nearest_pair(rows) > max(nearest_pair(one) for one in by_chance)
    spread = candidates.centre_in_camera_mm[rows].std(axis=0)
    assert (spread > 1.1 * candidates.centre_in_camera_mm.std(axis=0)).all()


def test_half_of_the_poses_keep_away_from_others_whole_turns_aside() -> None:
    candidates = pool(300)
    others = candidates.joints_rad[candidates.joints_rad[:, 4] > 0] + 2 * np.pi
    rows = choose_spread(candidates, 20, np.random.default_rng(0), others)
    assert len(set(rows.tolist())) == 20
    on_the_other_side = candidates.joints_rad[rows, 4] < 0
    assert on_the_other_side[:10].all()
    assert not on_the_other_side[10:].all()


@pytest.mark.parametrize("n", [0, 1, 7, 30])
def test_no_pose_is_chosen_twice_and_the_seed_decides(n: int) -> None:
    candidates = pool(30)
    rows = choose_spread(candidates, n, np.random.default_rng(3))
    assert len(rows) == len(set(rows.tolist())) == n
    np.testing.assert_array_equal(rows, choose_spread(candidates, n, np.random.default_rng(3)))


def test_every_view_is_used_before_a_second_branch_of_one() -> None:
    candidates = pool(60, views=12)
    n_views = len(np.unique(candidates.view))
    rows = choose_spread(candidates, n_views + 5, np.random.default_rng(0))
    assert len(np.unique(candidates.view[rows[:n_views]])) == n_views
    assert len(set(rows.tolist())) == n_views + 5


def test_more_poses_than_feasible_is_told() -> None:
    with pytest.raises(SettingsError, match="31 poses are wanted and 30 are feasible"):
        choose_spread(pool(30), 31, np.random.default_rng(0))


@given(st.integers(0, 40), st.integers(0, 1000))
def test_an_order_is_a_permutation_and_does_not_depend_on_the_input_order(n: int, seed: int) -> None:
    joints = np.random.default_rng(seed).uniform(-2, 2, (n, 6))
    start = np.zeros(6)
    order = order_by_travel(joints, start_joints_rad=start)
    assert sorted(order.tolist()) == list(range(n))
    shuffle = np.random.default_rng(seed + 1).permutation(n)
    np.testing.assert_array_equal(joints[shuffle][order_by_travel(joints[shuffle], start_joints_rad=start)], joints[order])


@pytest.mark.parametrize("seed", range(5))
def test_the_way_is_near_the_shortest_of_all(seed: int) -> None:
    joints = np.random.default_rng(seed).uniform(-2, 2, (7, 3))
    shortest = min(travel_rad(joints[list(order)]) for order in permutations(range(7)))
    assert travel_rad(joints[order_by_travel(joints)]) <= 1.2 * shortest


def test_the_way_is_much_shorter_than_a_random_one_and_counts_the_start() -> None:
    joints = np.random.default_rng(0).uniform(-2, 2, (60, 6))
    assert travel_rad(joints[order_by_travel(joints)]) < 0.6 * travel_rad(joints)
    line = np.linspace(0, 1, 11)[:, None] * np.ones(6)
    np.testing.assert_array_equal(order_by_travel(line, start_joints_rad=np.full(6, 1.1)), np.arange(10, -1, -1))
