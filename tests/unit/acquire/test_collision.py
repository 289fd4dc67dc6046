"""Collision checks against distances computed point by point, and on poses a person can picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from acquire.collision import CollisionSettings, collision_check
from acquire.obstacles import BoxObstacle, CylinderObstacle, MeshObstacle, Obstacle
from acquire.poses import PoseLaw, sphere_candidates
from acquire.visibility import CameraView
from drivers.errors import FileError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import Capsule, RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model, shipped_models
from tests.support.robotstudio import pairs

CAPSULE = Capsule(2, (30.0, -20, 10), (-40.0, 60, 80), 25.0)
NO_MARGIN = CollisionSettings(margin_mm=0.0)
FLANGE_FROM_CAMERA = se3.from_rotation_translation([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [60.0, 60, 85])


def one_capsule() -> RobotModel:
    return replace(load_robot_model("ur5e"), shape=(CAPSULE,))


def segments(model: RobotModel, q: FloatArray) -> FloatArray:
    """Points (k, 400, 3) along the capsule's middle line, in the base."""
    share = np.linspace(0, 1, 400)[:, None]
    line = np.array(CAPSULE.start_mm) * (1 - share) + np.array(CAPSULE.end_mm) * share
    return se3.apply(mdh.chain(model, q)[:, None, CAPSULE.link], line)


def random_joints(n: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (n, 6))


def to_box(points: FloatArray, size: Sequence[float]) -> FloatArray:
    return np.asarray(np.linalg.norm(np.maximum(np.abs(points) - np.array(size) / 2, 0), axis=-1))


def to_cylinder(points: FloatArray, diameter_mm: float, height_mm: float) -> FloatArray:
    beside = np.maximum(np.hypot(points[..., 0], points[..., 1]) - diameter_mm / 2, 0)
    return np.asarray(np.hypot(beside, np.maximum(np.abs(points[..., 2]) - height_mm / 2, 0)))


def assert_agrees(blocked: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], distance_mm: FloatArray) -> None:
    """Equal to the sampled distance wherever that is clear of the sampling's own grain."""
    gap = distance_mm - CAPSULE.radius_mm
    clear = np.abs(gap) > 0.2
    assert clear.sum() > 0.9 * len(gap)
    assert 10 < (gap < 0).sum() < len(gap) - 10
    np.testing.assert_array_equal(blocked[clear], gap[clear] < 0)


def test_a_turned_box_is_met_where_the_distances_say() -> None:
    model, q = one_capsule(), random_joints(400)
    box = BoxObstacle(name="box", kind="box", centre_in_base_mm=(100, 50, 150), rotation_deg=(20, -30, 50), size_mm=(80, 120, 50))
    points = se3.apply(se3.inverse(box.base_from_obstacle), segments(model, q))
    assert_agrees(collision_check(model, obstacles=[box], settings=NO_MARGIN)(q), to_box(points, box.size_mm).min(axis=1))


def test_a_cylinder_is_met_where_the_distances_say() -> None:
    model, q = one_capsule(), random_joints(400, 1)
    post = CylinderObstacle(name="post", kind="cylinder", centre_in_base_mm=(90, -40, 120), rotation_deg=(40, 0, 10), diameter_mm=60, height_mm=140)
    points = se3.apply(se3.inverse(post.base_from_obstacle), segments(model, q))
    assert_agrees(collision_check(model, obstacles=[post], settings=NO_MARGIN)(q), to_cylinder(points, 60, 140).min(axis=1))


def test_a_sphere_is_met_where_the_distances_say_and_the_margin_counts() -> None:
    model, q, centre = one_capsule(), random_joints(400, 2), np.array([80.0, 60, 160])
    distance = np.linalg.norm(segments(model, q) - centre, axis=-1).min(axis=1) - 30
    assert_agrees(collision_check(model, spheres=[(centre, 30.0)], settings=NO_MARGIN)(q), distance)
    assert_agrees(collision_check(model, spheres=[(centre, 30.0)], settings=CollisionSettings(margin_mm=15))(q), distance - 15)


def test_a_mesh_is_met_like_the_box_it_shows_and_scaled(tmp_path: Path) -> None:
    model, q = one_capsule(), random_joints(300, 3)
    trimesh.creation.box((0.08, 0.12, 0.05)).export(tmp_path / "box.stl")
    placed = {"centre_in_base_mm": (100.0, 50.0, 150.0), "rotation_deg": (20.0, -30.0, 50.0)}
    mesh = MeshObstacle.model_validate({"name": "part", "kind": "mesh", "file": "box.stl", "scale": 1000.0, **placed})
    box = BoxObstacle.model_validate({"name": "part", "kind": "box", "size_mm": (80.0, 120.0, 50.0), **placed})
    as_mesh, as_box = (collision_check(model, obstacles=[one], folder=tmp_path, settings=NO_MARGIN)(q) for one in (mesh, box))
    assert as_box.any()
    np.testing.assert_array_equal(as_mesh, as_box)


@pytest.mark.parametrize(("content", "found"), [(None, "no such mesh"), (b"solid nothing", "mesh|triangles"), (b"\x00" * 90, "mesh|triangles")])
def test_a_broken_mesh_is_told_with_its_file(tmp_path: Path, content: bytes | None, found: str) -> None:
    if content is not None:
        (tmp_path / "part.stl").write_bytes(content)
    obstacle: Obstacle = MeshObstacle(name="part", kind="mesh", file="part.stl")
    with pytest.raises(FileError, match=found) as caught:
        collision_check(one_capsule(), obstacles=[obstacle], folder=tmp_path)
    assert caught.value.file == str(tmp_path / "part.stl")


@pytest.mark.parametrize("name", shipped_models())
def test_an_arm_standing_upright_in_free_space_touches_nothing(name: str) -> None:
    upright = [0, -1.5, 0.3, -1.5, 0.5, 0] if name.startswith("ur") else [0, 0, 0, 0, 0.5, 0]
    assert not collision_check(load_robot_model(name), flange_from_camera=FLANGE_FROM_CAMERA)(np.array([upright])).any()


def test_robotstudio_poses_are_no_self_collisions() -> None:
    joints, _, _ = pairs()
    assert not collision_check(load_robot_model("abb_irb1410"))(joints).any()


def test_a_ur_folded_onto_its_base_touches_itself() -> None:
    folded = np.array([[0, -1.5, 2.9, -2.0, -1.57, 0]])
    assert collision_check(load_robot_model("ur5e"))(folded).all()


def test_the_camera_is_part_of_the_arm() -> None:
    model = replace(load_robot_model("ur10e"), shape=())
    q = np.array([[0.1, -1.2, 1.4, -1.7, -1.5, 0.3]])
    eye = (mdh.base_from_flange(model, q[0]) @ FLANGE_FROM_CAMERA)[:3, 3]
    assert collision_check(model, flange_from_camera=FLANGE_FROM_CAMERA, spheres=[(eye, 5.0)])(q).all()
    assert not collision_check(model, spheres=[(eye, 5.0)])(q).any()
    bare = CollisionSettings(camera_radius_mm=0)
    assert not collision_check(model, flange_from_camera=FLANGE_FROM_CAMERA, spheres=[(eye, 5.0)], settings=bare)(q).any()


def test_no_poses_give_no_answers() -> None:
    assert collision_check(load_robot_model("ur5e"))(np.zeros((0, 6))).shape == (0,)


def test_planned_poses_keep_out_of_a_wall_and_the_refused_are_counted() -> None:
    model = load_robot_model("abb_irb1410")
    view = CameraView((250.0, 450.0), (float(np.radians(27.5)), float(np.radians(18))))
    wall = BoxObstacle(name="wall", kind="box", centre_in_base_mm=(900, 350, 500), size_mm=(800, 20, 1000))
    blocked = collision_check(model, flange_from_camera=FLANGE_FROM_CAMERA, obstacles=[wall])
    pool = sphere_candidates(
        model, FLANGE_FROM_CAMERA, (900, 100, 300), 19.05, view, 200, np.random.default_rng(0), law=PoseLaw(), blocked=blocked
    )
    assert 20 < pool.rejected["collision"] < 180
    assert not blocked(pool.joints_rad).any()
    assert pool.base_from_camera[:, 1, 3].max() < 340
