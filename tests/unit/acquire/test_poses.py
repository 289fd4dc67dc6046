"""Feasible poses: every promise checked on the poses themselves by the forward chain, refusals counted, same seed same pool."""

from __future__ import annotations

import numpy as np
import pytest

from acquire.candidates import COLLISION
from acquire.poses import CandidatePool, PoseLaw, sphere_candidates, workpiece_poses
from acquire.visibility import CameraView, sees_sphere
from drivers.errors import SettingsError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model, shipped_models

VIEW = CameraView((250.0, 750.0), (float(np.radians(27.5)), float(np.radians(18))))
FLANGE_FROM_CAMERA = se3.from_rotation_translation([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [60.0, 60, 85])
RADIUS_MM = 19.05
CENTRE_MM = {"abb_irb1410": (900.0, 100, 300), "irb1410_paper": (900.0, 100, 300), "ur5e": (400.0, 100, 0), "ur10e": (600.0, 100, 50)}
every_model = pytest.mark.parametrize("name", shipped_models())


def pool_of(name: str, n: int = 300, seed: int = 0, law: PoseLaw | None = None, centre: tuple[float, float, float] | None = None) -> CandidatePool:
    model, rng = load_robot_model(name), np.random.default_rng(seed)
    return sphere_candidates(model, FLANGE_FROM_CAMERA, centre or CENTRE_MM[name], RADIUS_MM, VIEW, n, rng, law=law or PoseLaw())


def tilt_rad(pool: CandidatePool, direction: FloatArray) -> FloatArray:
    return np.asarray(np.arccos(np.clip(pool.base_from_camera[:, :3, 2] @ direction, -1, 1)))


@every_model
def test_every_pose_puts_the_sphere_where_it_says(name: str) -> None:
    model, pool = load_robot_model(name), pool_of(name)
    base_from_camera = mdh.base_from_flange(model, pool.joints_rad) @ FLANGE_FROM_CAMERA
    seen = se3.apply(se3.inverse(base_from_camera), CENTRE_MM[name])
    np.testing.assert_allclose(seen, pool.centre_in_camera_mm, atol=1e-6)
    np.testing.assert_allclose(pool.base_from_flange, mdh.base_from_flange(model, pool.joints_rad), atol=1e-7)
    np.testing.assert_allclose(pool.base_from_camera, base_from_camera, atol=1e-7)
    assert sees_sphere(VIEW, seen, RADIUS_MM - 1e-6).all()


@every_model
def test_every_pose_keeps_limits_tilt_and_floor(name: str) -> None:
    law = PoseLaw(largest_tilt_rad=0.6, limit_margin_rad=0.1, floor_mm=50.0)
    model, pool = load_robot_model(name), pool_of(name, law=law, centre=(CENTRE_MM[name][0], 100.0, 300.0))
    assert len(pool.view) > 0
    assert mdh.within_limits(model, pool.joints_rad, 0.1).all()
    assert tilt_rad(pool, np.array([0, 0, -1.0])).max() <= 0.6 + 1e-9
    assert pool.base_from_camera[:, 2, 3].min() > 50
    assert mdh.chain(model, pool.joints_rad)[:, 3:, 2, 3].min() > 50


@every_model
def test_views_are_feasible_or_refused_and_each_is_counted_once(name: str) -> None:
    pool = pool_of(name)
    assert pool.n_candidates == 300 == pool.n_feasible + sum(pool.rejected.values())
    assert pool.n_feasible > 150
    assert (np.diff(pool.view) >= 0).all()


@every_model
def test_the_same_seed_gives_the_same_pool_and_another_another(name: str) -> None:
    first, again, other = pool_of(name, 50), pool_of(name, 50), pool_of(name, 50, seed=1)
    np.testing.assert_array_equal(first.joints_rad, again.joints_rad)
    assert first.rejected == again.rejected
    assert not np.array_equal(first.joints_rad[0], other.joints_rad[0])


def test_branches_of_one_view_share_the_pose_and_differ_in_the_arm() -> None:
    pool = pool_of("ur10e", 40)
    for view in np.unique(pool.view):
        rows = pool.view == view
        np.testing.assert_array_equal(pool.base_from_flange[rows], np.broadcast_to(pool.base_from_flange[rows][0], (rows.sum(), 4, 4)))
    assert np.bincount(pool.view).max() == 8


def test_depth_lateral_tilt_and_roll_are_spread_as_the_law_says() -> None:
    """Of views drawn; what the arm cannot reach is missing, so the arm here is one that reaches nearly all."""
    pool = pool_of("ur10e", 2000, law=PoseLaw(depth_mm=(280, 480), largest_tilt_rad=0.6), centre=(600, 0, 100))
    _, first = np.unique(pool.view, return_index=True)
    pool = pool.take(first)
    assert pool.n_feasible > 1900
    assert np.abs(np.histogram(pool.centre_in_camera_mm[:, 2], 4, (280, 480))[0] / len(first) - 0.25).max() < 0.04
    assert np.abs(np.histogram(tilt_rad(pool, np.array([0, 0, -1.0])), 4, (0, 0.6))[0] / len(first) - 0.25).max() < 0.04
    roll = np.arctan2(pool.base_from_camera[:, 1, 0], pool.base_from_camera[:, 0, 0])
    assert np.abs(np.histogram(roll, 4, (-np.pi, np.pi))[0] / len(first) - 0.25).max() < 0.05
    assert np.abs(np.corrcoef(pool.centre_in_camera_mm.T) - np.eye(3)).max() < 0.08


def test_the_preferred_direction_may_be_any() -> None:
    direction = np.array([1.0, 0, -0.3]) / np.linalg.norm([1, 0, -0.3])
    law = PoseLaw(largest_tilt_rad=0.3, direction_in_base=(1.0, 0, -0.3))
    pool = pool_of("ur10e", 100, law=law, centre=(800, 0, 400))
    assert pool.n_feasible > 20
    assert tilt_rad(pool, direction).max() <= 0.3 + 1e-9


def test_a_sphere_out_of_reach_is_refused_as_unreachable() -> None:
    pool = pool_of("ur5e", 50, centre=(3000, 0, 0))
    assert pool.rejected == {"unreachable": 50}
    assert pool.joints_rad.shape == (0, 6)
    assert pool.base_from_flange.shape == (0, 4, 4)


def test_narrow_limits_are_told_as_axis_limits() -> None:
    assert pool_of("abb_irb1410", 50, law=PoseLaw(limit_margin_rad=1.1)).rejected["axis limits"] > 40


def test_a_high_floor_is_told_as_below_table() -> None:
    assert pool_of("abb_irb1410", 50, law=PoseLaw(floor_mm=2000.0)).rejected["below table"] > 40


def test_spheres_in_the_line_of_sight_hide_the_one_behind() -> None:
    model, centre = load_robot_model("ur10e"), np.array(CENTRE_MM["ur10e"])
    above, beside = centre + np.array([0, 0, 120.0]), centre - np.array([0, 0, 120.0])
    pools = [
        sphere_candidates(model, FLANGE_FROM_CAMERA, centre, RADIUS_MM, VIEW, 200, np.random.default_rng(0), other_spheres=[(other, RADIUS_MM)])
        for other in (above, beside)
    ]
    assert pools[0].rejected["not in view"] > 20
    assert "not in view" not in pools[1].rejected
    eye, sight = pools[0].base_from_camera[:, :3, 3], centre - pools[0].base_from_camera[:, :3, 3]
    distance = np.linalg.norm(np.cross(above - eye, sight), axis=1) / np.linalg.norm(sight, axis=1)
    assert distance.min() > 2 * RADIUS_MM


def test_collisions_are_asked_for_every_branch_and_counted_by_view() -> None:
    model, asked = load_robot_model("ur10e"), []

    def elbow_down(joints_rad: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        asked.append(len(joints_rad))
        return np.asarray(joints_rad[:, 0] > 0)

    rng = np.random.default_rng(0)
    pool = sphere_candidates(model, FLANGE_FROM_CAMERA, CENTRE_MM["ur10e"], RADIUS_MM, VIEW, 60, rng, blocked=elbow_down)
    assert len(asked) == 1
    assert (pool.joints_rad[:, 0] <= 0).all()
    assert pool.n_feasible + sum(pool.rejected.values()) == 60
    rng = np.random.default_rng(0)
    nothing = sphere_candidates(model, FLANGE_FROM_CAMERA, CENTRE_MM["ur10e"], RADIUS_MM, VIEW, 60, rng, blocked=lambda q: q[:, 0] < 9)
    assert nothing.rejected[COLLISION] == 60 - nothing.rejected.get("unreachable", 0)


def covered(pool: CandidatePool, points: FloatArray) -> FloatArray:
    """Which points (p, 3) some view of the pool sees."""
    in_camera = se3.apply(se3.inverse(pool.base_from_camera)[:, None], points)
    return np.asarray(sees_sphere(VIEW, in_camera, 1e-9).any(axis=0))


def grid(box: FloatArray) -> FloatArray:
    axes = [np.linspace(low, high, 7) for low, high in box.T]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize(("name", "size_mm"), [("ur10e", (700, 300, 60)), ("abb_irb1410", (200, 500, 100)), ("irb1410_paper", (150, 150, 80))])
def test_workpiece_views_cover_the_whole_region_and_are_feasible(name: str, size_mm: tuple[float, float, float]) -> None:
    model, centre = load_robot_model(name), np.array(CENTRE_MM[name])
    box = np.stack([centre - np.array(size_mm) / 2, centre + np.array(size_mm) / 2])
    pool = workpiece_poses(model, FLANGE_FROM_CAMERA, VIEW, box, 30, np.random.default_rng(0))
    assert len(pool.view) <= 30
    assert len(pool.uncovered_in_base_mm) == 0
    assert covered(pool, grid(box)).all()
    assert mdh.within_limits(model, pool.joints_rad).all()
    np.testing.assert_allclose(mdh.base_from_flange(model, pool.joints_rad) @ FLANGE_FROM_CAMERA, pool.base_from_camera, atol=1e-7)


def test_workpiece_views_begin_straight_and_go_on_tilted() -> None:
    model = load_robot_model("ur10e")
    pool = workpiece_poses(model, FLANGE_FROM_CAMERA, VIEW, [[500, -50, 0], [600, 50, 40]], 8, np.random.default_rng(0))
    tilts = tilt_rad(pool, np.array([0, 0, -1.0]))
    assert len(tilts) == 8
    assert tilts[0] == pytest.approx(0, abs=1e-6)
    assert (tilts[1:] > 1e-3).all()
    assert tilts.max() <= np.radians(45)


def test_what_no_pose_can_see_is_told() -> None:
    pool = workpiece_poses(load_robot_model("ur5e"), FLANGE_FROM_CAMERA, VIEW, [[200, -100, 0], [1600, 100, 50]], 60, np.random.default_rng(0))
    assert len(pool.uncovered_in_base_mm) > 0
    assert pool.uncovered_in_base_mm[:, 0].min() > 600
    assert (pool.joints_rad.shape[0]) > 0


@pytest.mark.parametrize(
    ("box", "n", "found"),
    [
        ([[0, 0, 0], [2000, 2000, 10]], 5, r"5 poses cannot cover.*Ask for \d+"),
        ([[1, 0, 0], [0, 0, 0]], 5, "no box"),
        ([[0, 0], [1, 1]], 5, "no box"),
    ],
)
def test_regions_that_cannot_be_planned_are_told(box: list[list[float]], n: int, found: str) -> None:
    with pytest.raises(SettingsError, match=found):
        workpiece_poses(load_robot_model("ur5e"), FLANGE_FROM_CAMERA, VIEW, box, n, np.random.default_rng(0))


def test_no_direction_is_refused() -> None:
    with pytest.raises(SettingsError, match="no length"):
        pool_of("ur5e", 5, law=PoseLaw(direction_in_base=(0, 0, 0)))


def test_a_robot_without_closed_form_is_told() -> None:
    model: RobotModel = load_robot_model("ur5e")
    bent = RobotModel(**{**{name: getattr(model, name) for name in model.__slots__}, "alpha_rad": model.alpha_rad + 0.01})
    with pytest.raises(SettingsError, match="no closed-form"):
        sphere_candidates(bent, FLANGE_FROM_CAMERA, CENTRE_MM["ur5e"], RADIUS_MM, VIEW, 5, np.random.default_rng(0))
