"""Rays against spheres, boxes and meshes: exact surfaces, nearest hit, independent oracles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.camera import SimulatedCamera, frame_points
from drivers.simulated.draws import post, table, transform_rows
from drivers.simulated.scene import mesh_of, nearest_hits, ray_grid
from drivers.simulated.truth import BoxTruth, SphereTruth, Truth, WorkpieceTruth
from drivers.simulated.workpiece import stepped_block
from tests.support.simulated import CENTRE_IN_CAMERA_MM, cell_at, exact_camera, truth_with_sphere

BASE_FROM_CAMERA = se3.exp([200.0, -100.0, 700.0, 0.0, 0.0, 0.0]) @ se3.exp([0, 0, 0, 3.0, 0.2, 0.1])


def points_of(truth: Truth, base_from_camera: FloatArray, *, mesh: bool = False) -> FloatArray:
    """(h, w, 3) exact hits in the base, NaN where there is none."""
    grid = ray_grid(truth.camera)
    hits = nearest_hits(truth, base_from_camera, grid, mesh_of(*stepped_block()) if mesh else None)
    depth = np.where(np.isfinite(hits.depth_mm), hits.depth_mm, np.nan)
    x, y = np.meshgrid(grid.x_slopes, grid.y_slopes)
    return se3.apply(base_from_camera, np.stack([x * depth, y * depth, depth], axis=-1))


def in_front(x: float, y: float, z: float) -> tuple[float, float, float]:
    point = se3.apply(BASE_FROM_CAMERA, [x, y, z])
    return float(point[0]), float(point[1]), float(point[2])


def test_every_point_lies_on_the_sphere_it_hit() -> None:
    spheres = {"A": SphereTruth(in_front(30, -20, 400), 38.1, 0.03), "B": SphereTruth(in_front(-60, 40, 700), 60.0)}
    truth = Truth(camera=exact_camera(resolution_px=(640, 400)), spheres=spheres)
    points = points_of(truth, BASE_FROM_CAMERA).reshape(-1, 3)
    points = points[np.isfinite(points[:, 0])]
    residuals = np.array([np.linalg.norm(points - s.centre_in_base_mm, axis=1) - s.seen_radius_mm for s in spheres.values()])
    assert len(points) > 3000
    assert np.abs(residuals).min(axis=0).max() < 1e-9


def test_number_of_points_is_the_area_of_the_silhouette() -> None:
    radius, distance = 19.05, 400.0
    truth = Truth(camera=exact_camera(resolution_px=(640, 400)), spheres={"A": SphereTruth(in_front(0, 0, distance), 2 * radius)})
    grid = ray_grid(truth.camera)
    seen = np.isfinite(nearest_hits(truth, BASE_FROM_CAMERA, grid).depth_mm).sum()
    # a centred sphere covers the slopes within tan(asin(r / d))
    slope = np.tan(np.arcsin(radius / distance))
    pixel = (grid.x_slopes[1] - grid.x_slopes[0]) * (grid.y_slopes[1] - grid.y_slopes[0])
    assert seen == pytest.approx(np.pi * slope**2 / pixel, rel=0.01)


def test_the_near_sphere_hides_the_far_one_in_any_order() -> None:
    near, far = SphereTruth(in_front(0, 0, 350), 40.0), SphereTruth(in_front(0, 0, 450), 40.0)
    camera = exact_camera()
    grid = ray_grid(camera)
    alone = nearest_hits(Truth(camera=camera, spheres={"near": near}), BASE_FROM_CAMERA, grid)
    for spheres in ({"near": near, "far": far}, {"far": far, "near": near}):
        both = nearest_hits(Truth(camera=camera, spheres=spheres), BASE_FROM_CAMERA, grid)
        np.testing.assert_array_equal(both.depth_mm, alone.depth_mm)
        np.testing.assert_array_equal(both.cos_incidence, alone.cos_incidence)


def test_a_sphere_behind_the_camera_is_not_seen() -> None:
    truth = Truth(camera=exact_camera(), spheres={"A": SphereTruth(in_front(0, 0, -300), 100.0)})
    assert not np.isfinite(points_of(truth, BASE_FROM_CAMERA)).any()


def test_a_board_between_hides_the_sphere() -> None:
    board = BoxTruth((400.0, 400.0, 5.0), transform_rows(BASE_FROM_CAMERA @ se3.exp([0, 0, 300.0, 0, 0, 0])))
    truth = Truth(camera=exact_camera(), spheres={"A": SphereTruth(in_front(0, 0, 400), 40.0)}, boxes=(board,))
    points = se3.apply(se3.inverse(BASE_FROM_CAMERA), points_of(truth, BASE_FROM_CAMERA))
    assert np.nanmax(np.abs(points[..., 2] - 297.5)) < 1e-9


def test_a_table_fills_the_view_and_a_post_carries_its_sphere() -> None:
    sphere = SphereTruth(in_front(0, 0, 450), 40.0)
    truth = Truth(camera=exact_camera(), spheres={"A": sphere}, boxes=(table(0.0, (200.0, -100.0)), post(sphere, 0.0)))
    points = points_of(truth, BASE_FROM_CAMERA)
    height = points[..., 2]
    on_sphere = np.abs(np.linalg.norm(points - sphere.centre_in_base_mm, axis=-1) - 20.0) < 1e-9
    on_post = np.abs(np.abs(points[..., :2] - sphere.centre_in_base_mm[:2]).max(axis=-1) - 5.0) < 1e-9
    assert np.isfinite(height).all()
    assert (on_sphere | on_post | (np.abs(height) < 1e-9)).all()
    assert on_sphere.sum() > 100


def test_box_and_mesh_of_the_same_block_agree() -> None:
    base_from_part = se3.exp([200.0, -100.0, 300.0, 0.1, -0.2, 0.4])
    # the raised step of the built-in workpiece is a plain block, 40 x 100 x 60 mm
    step = BoxTruth((40.0, 100.0, 60.0), transform_rows(base_from_part @ se3.exp([60.0, 0, 30.0, 0, 0, 0])))
    camera = exact_camera()
    by_mesh = points_of(Truth(camera=camera, workpiece=WorkpieceTruth(transform_rows(base_from_part))), BASE_FROM_CAMERA, mesh=True)
    by_box = points_of(Truth(camera=camera, boxes=(step,)), BASE_FROM_CAMERA)
    in_part = se3.apply(se3.inverse(base_from_part), by_box)
    on_top = np.isfinite(in_part[..., 2]) & (np.abs(in_part[..., 2] - 60.0) < 1e-6)
    clear_of_boss = on_top & (np.hypot(in_part[..., 0] - 60, in_part[..., 1]) > 30) & (np.abs(in_part[..., 0] - 60) < 19)
    assert clear_of_boss.sum() > 50
    assert np.abs(by_mesh - by_box)[clear_of_boss].max() < 1e-3


def test_incidence_of_a_board_is_that_of_its_normal() -> None:
    board = BoxTruth((4000.0, 4000.0, 5.0), transform_rows(BASE_FROM_CAMERA @ se3.exp([0, 0, 400.0, 0, 0, 0])))
    grid = ray_grid(exact_camera())
    hits = nearest_hits(Truth(camera=exact_camera(), boxes=(board,)), BASE_FROM_CAMERA, grid)
    x, y = np.meshgrid(grid.x_slopes, grid.y_slopes)
    np.testing.assert_allclose(hits.cos_incidence, 1 / np.sqrt(1 + x * x + y * y), rtol=1e-12)


def test_a_line_profile_is_a_slice_of_the_sphere() -> None:
    truth = truth_with_sphere(camera=exact_camera(kind="line_profile", resolution_px=(2000, 1)))
    camera = SimulatedCamera(cell_at(truth))
    assert camera.open().kind == "line_profile"
    xyz = camera.capture(timeout_s=5.0).xyz_mm
    seen = xyz[np.isfinite(xyz[..., 0])].astype(np.float64)
    assert xyz.shape == (1, 2000, 3)
    assert len(seen) > 100
    assert np.abs(seen[:, 1]).max() == 0.0
    # float32 at 350 mm keeps 3e-5 mm
    assert np.abs(np.linalg.norm(seen - CENTRE_IN_CAMERA_MM, axis=1) - 19.05).max() < 1e-4


def test_flying_pixels_lie_behind_the_edge_on_their_own_rays() -> None:
    camera = exact_camera(resolution_px=(320, 200), flying_pixel_fraction=1.0, flying_pixel_mm=6.0)
    truth = Truth(camera=camera, spheres={"A": SphereTruth(in_front(0, 0, 400), 60.0)})
    grid = ray_grid(camera)
    hits = nearest_hits(truth, BASE_FROM_CAMERA, grid)
    plain = frame_points(replace(camera, flying_pixel_fraction=0.0), grid, hits, np.random.default_rng(0))
    flown = frame_points(camera, grid, hits, np.random.default_rng(0))
    moved = np.nan_to_num(flown[..., 2] - plain[..., 2])
    inside = np.isfinite(hits.depth_mm)
    edge = inside & ~(np.roll(inside, 1, 0) & np.roll(inside, -1, 0) & np.roll(inside, 1, 1) & np.roll(inside, -1, 1))
    # float32 between 350 and 420 mm steps by 3e-5 mm
    assert (moved[edge] > 1e-4).mean() > 0.95
    assert moved.max() <= 6.0 + 1e-4
    assert moved[inside & ~edge].max() < 5.0
    np.testing.assert_allclose((flown[..., 0] / flown[..., 2])[inside], (plain[..., 0] / plain[..., 2])[inside], atol=1e-6)
