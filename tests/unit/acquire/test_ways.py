"""Ways between poses: clear everywhere by a look of another kind, round what stands in them, and back from anywhere."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acquire.arm_body import ArmBody, segment_distance
from acquire.cell import Cell
from acquire.collision import CollisionCheck, CollisionSettings, cell_collisions, collision_check
from acquire.detour import find_way
from acquire.obstacles import BoxObstacle
from acquire.ordering import unwound
from acquire.plan import PlannedPose
from acquire.poses import sphere_candidates
from acquire.routing import APPROACH_RAD, route
from acquire.sweep import swept_ways, touching_ways
from acquire.visibility import camera_view
from acquire.way import NoClearWay, Way
from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model
from tests.support.room import least_room_mm, points_of_ways, room

UR = load_robot_model("ur5e")
# on both sides of a wall
LEFT, RIGHT = (np.array([q, -0.3, 0.3, 0.0, 0.5, 0.0]) for q in (1.5, -1.5))
WALL = BoxObstacle(name="wall", kind="box", size_mm=(20, 300, 900), centre_in_base_mm=(-500, 0, 0))
MARGINS = CollisionSettings()


def walled(*obstacles: BoxObstacle) -> CollisionCheck:
    return collision_check(UR, obstacles=obstacles or (WALL,))


def cell_with(tmp_path: Path, model: str = "ur5e", kind: str = "boxes", seed: int = 0) -> tuple[Cell, RobotModel]:
    return room(tmp_path, model, kind, seed), load_robot_model(model)


POINT = st.lists(st.floats(-5, 5), min_size=3, max_size=3)


@settings(max_examples=60)
@given(POINT, POINT, POINT, POINT)
def test_segments_are_as_far_apart_as_their_nearest_points(a: list[float], b: list[float], c: list[float], d: list[float]) -> None:
    first, end, second, other = (np.array(point) for point in (a, b, c, d))
    share = np.linspace(0, 1, 81)[:, None]
    sampled = np.linalg.norm((first + share * (end - first))[:, None] - (second + share * (other - second)), axis=-1).min()
    grain = (np.linalg.norm(end - first) + np.linalg.norm(other - second)) / 160
    found = float(segment_distance(first, end, second, other))
    assert sampled - grain - 1e-6 <= found <= sampled + 1e-6


@settings(max_examples=15)
@given(st.integers(0, 10**6), st.sampled_from(["abb_irb1410", "ur5e"]))
def test_no_point_of_the_arm_gets_further_than_its_bound(seed: int, name: str) -> None:
    rng, model = np.random.default_rng(seed), load_robot_model(name)
    middle, turns = rng.uniform(-2, 2, 6), rng.uniform(0, 0.4, 6)
    body = ArmBody(model, np.eye(4) + 60 * np.eye(4, k=3), 70.0)
    theta = np.abs(model.coupling) @ turns
    bound, between = body.excursions_mm(mdh.chain(model, middle[None]), theta[None], 0.0)
    moved = middle + rng.uniform(-1, 1, (200, 6)) * turns
    frames, still = mdh.chain(model, moved), mdh.chain(model, middle)
    for capsule in body.capsules:
        for end in (capsule.start_mm, capsule.end_mm):
            point = np.array([*end, 1.0])
            assert np.linalg.norm((frames[:, capsule.link] @ point - still[capsule.link] @ point)[:, :3], axis=-1).max() <= bound[0] + 1e-9
    change = body.gaps_mm(still[None]) - body.gaps_mm(frames)
    assert (np.abs(change).max(axis=0) <= between[0] + 1e-6).all()


def test_a_way_that_is_clear_is_clear_between_all_samples() -> None:
    """Against thin posts, which samples would step over."""
    rng = np.random.default_rng(3)
    found = {True: 0, False: 0}
    for _ in range(14):
        x, y = rng.uniform(-700, 700, 2)
        post = BoxObstacle(name="post", kind="box", size_mm=(2, 2, 1200), centre_in_base_mm=(x, y, 300))
        bare = collision_check(UR, obstacles=[post], settings=replace(MARGINS, margin_mm=MARGINS.way_margin_mm - 0.01))
        first, second = rng.uniform(-1.5, 1.5, (2, 6))
        fine = first + np.linspace(0, 1, 700)[:, None] * (second - first)
        share = collision_check(UR, obstacles=[post]).trouble(first, second)
        found[share is None] += 1
        if share is None:
            assert not bare(fine).any()
        else:
            assert collision_check(UR, obstacles=[post])((first + share * (second - first))[None])[0]
    assert min(found.values()) > 2


def test_a_wall_is_gone_round() -> None:
    check = walled()
    share = check.trouble(LEFT, RIGHT)
    assert share is not None
    assert check((LEFT + share * (RIGHT - LEFT))[None])[0]
    vias = find_way(UR, check, LEFT, RIGHT)
    assert vias
    assert all(check.trouble(a, b) is None for a, b in pairwise([LEFT, *vias, RIGHT]))
    assert mdh.within_limits(UR, np.array(vias)).all()
    again = find_way(UR, check, LEFT, RIGHT)
    assert again is not None
    np.testing.assert_array_equal(vias, again)
    assert find_way(UR, check, LEFT, LEFT + 0.1) == ()


def test_where_there_is_no_way_none_is_told() -> None:
    # a cage that the arm reaches out of nowhere
    cage = [BoxObstacle(name=str(x), kind="box", size_mm=(20, 4000, 4000), centre_in_base_mm=(x, 0, 0)) for x in (-250, 250)]
    assert find_way(UR, walled(*cage), LEFT, RIGHT) is None


@pytest.mark.parametrize(("name", "kind"), [("ur5e", "boxes"), ("abb_irb1410", "bars")])
def test_a_route_passes_every_pose_and_touches_nothing(name: str, kind: str, tmp_path: Path) -> None:
    cell, model = cell_with(tmp_path, name, kind)
    check, rng = cell_collisions(cell, model), np.random.default_rng(5)
    sphere = np.array(cell.spheres["B"].centre_in_base_mm)
    pool = sphere_candidates(model, np.asarray(cell.flange_from_camera), sphere, 19.05, camera_view(cell.camera), 60, rng, blocked=check)
    joints = unwound(model, pool.joints_rad[rng.permutation(len(pool.view))[:8]]).round(6)
    found = route(model, check, joints, start_rad=joints[0])
    assert sorted([*found.rows, *found.lost]) == list(range(8))
    assert len(found.rows) >= 7
    poses = [PlannedPose(str(row), None, joints[row], vias) for row, vias in zip(found.rows, found.via_rad, strict=True)]
    assert touching_ways(poses, cell, model) == ()
    assert least_room_mm(cell, model, points_of_ways(poses, np.radians(2.0))) > MARGINS.way_margin_mm - 0.5
    one_sided = [np.allclose(pose.joints_rad - pose.via_rad[-1], APPROACH_RAD, atol=2e-6) for pose in poses if pose.via_rad]
    assert sum(one_sided) == found.n_one_sided >= 5


def test_a_pose_without_a_way_is_left_out() -> None:
    cage = [BoxObstacle(name=str(x), kind="box", size_mm=(20, 4000, 4000), centre_in_base_mm=(x, 0, 0)) for x in (-250, 250)]
    found = route(UR, walled(*cage), np.array([LEFT, LEFT + 0.01, RIGHT, LEFT + 0.02, LEFT - 0.01]))
    assert (set(found.rows), found.lost) == ({0, 1, 3, 4}, (2,))


@settings(max_examples=25)
@given(st.lists(st.lists(st.floats(-3.1, 3.1), min_size=6, max_size=6), min_size=1, max_size=8))
def test_unwound_poses_are_the_same_poses(joints: list[list[float]]) -> None:
    for name in ("ur5e", "abb_irb1410", "irb1410_paper"):
        model = load_robot_model(name)
        before: FloatArray = np.clip(joints, model.joint_limits_rad[:, 0] + 0.04, model.joint_limits_rad[:, 1] - 0.04)
        after = unwound(model, before)
        np.testing.assert_allclose(mdh.base_from_flange(model, after), mdh.base_from_flange(model, before), atol=1e-6)
        assert (after >= model.joint_limits_rad[:, 0]).all()
        assert (after <= model.joint_limits_rad[:, 1]).all()
        if name == "ur5e":
            assert np.ptp(after, axis=0).max() <= 2 * np.pi * (1 - 1 / len(joints)) + 1e-9


def test_an_edited_plan_is_seen_to_touch(tmp_path: Path) -> None:
    cell, model = cell_with(tmp_path)
    data = cell.model_copy(update={"obstacles": (WALL,)})
    poses = [PlannedPose("a", None, LEFT), PlannedPose("b", None, RIGHT)]
    (touching,) = touching_ways(poses, data, model)
    assert touching.pose.id == "b"
    vias = find_way(model, cell_collisions(data, model), LEFT, RIGHT)
    assert vias
    assert touching_ways([poses[0], replace(poses[1], via_rad=vias)], data, model) == ()
    # and where the first pose has via points of its own
    (first, _) = swept_ways([replace(poses[1], via_rad=(LEFT,)), poses[1]], cell_collisions(data, model))
    assert first.touches.any()
    assert touching_ways(poses, data.model_copy(update={"robot": cell.robot.model_copy(update={"driver": "recorded"})}), model) == ()


POSES = [PlannedPose(f"p{i}", None, np.array([float(i), 0.0]), (np.array([i - 0.05, 0.0]),)) for i in range(5)]


def found_by(first: FloatArray, second: FloatArray) -> tuple[FloatArray, ...] | None:
    """Everything is clear but a bar at y = 5, which is passed at x = -9."""
    if second[1] > 50:
        return None
    return () if (first[1] - 5) * (second[1] - 5) > 0 else (np.array([-9.0, first[1]]), np.array([-9.0, second[1]]))


def visited(way: Way, pose: PlannedPose, at: tuple[float, float]) -> list[list[float]]:
    return [point.tolist() for point in way.to(pose, np.array(at))]


def test_a_robot_that_left_the_way_is_led_back_to_the_pose_that_comes_next() -> None:
    way = Way(POSES, found_by)
    assert visited(way, POSES[2], (0.3, 9.0)) == [[-9, 9], [-9, 0], [1.95, 0], [2, 0]]
    assert visited(way, POSES[3], (2.0, 0.0)) == [[2.95, 0], [3, 0]]
    # skipped poses are passed, as planned
    assert visited(way, POSES[1], (3.0, 0.0)) == [[2.95, 0], [2, 0], [1.95, 0], [1, 0], [0.95, 0], [1, 0]]
    # somebody has moved it
    assert visited(way, POSES[2], (1.0, 8.0)) == [[-9, 8], [-9, 0], [1.95, 0], [2, 0]]
    added = PlannedPose("x", None, np.array([7.0, 7.0]))
    way.add(added)
    assert visited(way, added, (2.0, 0.0)) == [[-9, 0], [-9, 7], [7, 7]]
    assert visited(way, POSES[4], (7.0, 7.0)) == [[-9, 7], [-9, 0], [3.95, 0], [4, 0]]


def test_past_poses_of_a_plan_without_via_points_the_way_is_looked_for() -> None:
    poses = [PlannedPose(f"p{i}", None, np.array([float(i), 9.0 * (i % 2)])) for i in range(4)]
    way = Way(poses, found_by)
    assert visited(way, poses[0], (0.0, 1.0)) == [[0, 0]]
    assert visited(way, poses[1], (0.0, 0.0)) == [[1, 9]]  # planned, and so looked at when the plan was loaded
    assert visited(way, poses[2], (1.0, 9.0)) == [[2, 0]]
    assert visited(way, poses[3], (1.0, 9.0)) == [[3, 9]]
    assert visited(way, poses[0], (3.0, 9.0)) == [[-9, 9], [-9, 0], [0, 0]]


def test_no_clear_way_is_an_error_with_its_pose() -> None:
    way = Way([PlannedPose("high", None, np.array([0.0, 60.0]))], found_by)
    with pytest.raises(NoClearWay, match="pose high"):
        visited(way, PlannedPose("high", None, np.array([0.0, 60.0])), (0.0, 0.0))
