"""Maps of what verification leaves over: a known deviation stands in the right bins, and nothing stands where nothing was seen."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.observations import SphereShot
from drivers.kinematics.se3 import FloatArray
from measure.plots_residual import camera_maps_svg, exaggeration_of, form_maps_svg
from measure.proof.residual_maps import LEAST_IN_BIN, MOST_SPHERES, BinnedMap, CameraMaps, camera_maps, form_map, residual_maps
from measure.report_residual import centre_shifts_mm, residual_pictures
from measure.sphere_figures import SphereSize, SphereView, figures_of
from tests.support.sphere_views import cap

RADIUS_MM = 19.05
CENTRE_MM = np.array([700.0, -120.0, 240.0])
UP = np.array([0.0, 0.0, 1.0])


def sphere_points(deviation_mm: FloatArray, directions: FloatArray) -> FloatArray:
    return np.asarray(CENTRE_MM + (RADIUS_MM + deviation_mm)[:, None] * directions)


def at(one: BinnedMap, x: float, y: float) -> float:
    column, row = (int(np.searchsorted(edges, value, side="right")) - 1 for edges, value in ((one.x_edges, x), (one.y_edges, y)))
    return float(one.mean_mm[row, column])


def middles(edges: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (edges[:-1] + edges[1:]))


def shot_and_view(
    rng: np.random.Generator, index: int, in_camera_mm: FloatArray, deviation_mm: float, sphere: str = "A"
) -> tuple[SphereShot, SphereView]:
    """A camera that looks down at a sphere and reads all of it larger by a deviation."""
    up = cap(rng, np.zeros(3), RADIUS_MM, 400, UP)
    seen = in_camera_mm + up * [1, -1, -1]
    joints, flange = np.zeros(6), np.eye(4)
    shot = SphereShot("s", index, sphere, f"{index}", joints, flange, seen, RADIUS_MM, in_camera_mm)
    return shot, SphereView("s", index, sphere, CENTRE_MM + up * (1 + deviation_mm / RADIUS_MM), CENTRE_MM)


def test_an_ellipsoid_stands_out_along_its_long_axis_and_in_between() -> None:
    """r = R + a cos(2 azimuth) cos²(elevation) bulges at azimuth 0 and 180 degrees, and dips at +-90; its mean is zero."""
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(60_000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    found = form_map(sphere_points(0.08 * (directions[:, 0] ** 2 - directions[:, 1] ** 2), directions), RADIUS_MM, CENTRE_MM)
    azimuth, elevation = np.meshgrid(middles(found.x_edges), middles(found.y_edges))
    expected = 0.08 * np.cos(2 * azimuth) * np.cos(elevation) ** 2
    assert found.mean_mm.shape == (12, 24)
    np.testing.assert_allclose(found.mean_mm, expected, atol=0.004)
    assert at(found, 0.05, 0.05) > 0.07 > -0.07 > at(found, np.pi / 2 + 0.05, 0.05)


def test_a_dent_is_at_its_azimuth_and_elevation_and_the_unseen_half_is_empty() -> None:
    rng = np.random.default_rng(6)
    directions = cap(rng, np.zeros(3), 1.0, 30_000, UP, np.pi / 2)
    dent = np.array([-0.5, 0.5, np.sqrt(0.5)])
    found = form_map(sphere_points(np.where(directions @ dent > np.cos(0.2), -0.1, 0.0), directions), RADIUS_MM, CENTRE_MM)
    row, column = np.unravel_index(np.nanargmin(found.mean_mm), found.mean_mm.shape)
    assert found.x_edges[column] - 1e-9 <= np.radians(135) <= found.x_edges[column + 1] + 1e-9
    assert found.y_edges[row] - 1e-9 <= np.radians(45) <= found.y_edges[row + 1] + 1e-9
    assert np.isnan(found.mean_mm[:6]).all()
    assert np.isfinite(found.mean_mm[6:11]).all()


def test_a_field_that_was_left_is_seen_where_the_camera_measured_it() -> None:
    rng = np.random.default_rng(7)
    points = rng.uniform([-120, -60, 260], [120, 60, 440], (40_000, 3))
    points = points[(points[:, 0] < 0) | (points[:, 2] < 350)]
    maps = camera_maps(points, 1e-3 * (points[:, 2] - 350))
    depth = middles(maps.over_x_z.y_edges)
    np.testing.assert_allclose(maps.over_x_z.mean_mm[:, 3], 1e-3 * (depth - 350), atol=1e-3)
    assert np.isnan(at(maps.over_x_z, 60.0, 400.0))
    assert maps.over_x_y is not None
    assert at(maps.over_x_y, 60.0, 0.0) < -0.02  # the right half holds near points only


def test_few_points_are_no_mean_and_a_line_profile_has_one_map() -> None:
    corners = np.array([[-50.0, 0, 300], [50, 0, 400]])
    points = np.concatenate([corners, np.tile([1.0, 0, 310], (LEAST_IN_BIN, 1)), np.tile([1.0, 0, 390], (LEAST_IN_BIN - 1, 1))])
    maps = camera_maps(points, np.ones(len(points)))
    assert maps.over_x_y is None
    assert np.isfinite(maps.over_x_z.mean_mm).sum() == 1
    assert at(maps.over_x_z, 1.0, 310.0) == 1.0
    assert "depth z" in camera_maps_svg(maps)


def test_residuals_go_with_the_shot_that_measured_them() -> None:
    rng = np.random.default_rng(8)
    pairs = [shot_and_view(rng, 0, np.array([-100.0, 0, 350]), 0.05), shot_and_view(rng, 1, np.array([100.0, 30, 350]), -0.05)]
    shots, views = [p[0] for p in pairs], [p[1] for p in pairs]
    sizes = {"A": SphereSize(RADIUS_MM - 0.02, 0.02)}
    maps = residual_maps(shots, views, figures_of(views, sizes, line_profile=False), sizes)
    x = middles(maps.camera.over_x_z.x_edges)
    left, right = (np.nanmean(maps.camera.over_x_z.mean_mm[:, side]) for side in (x < 0, x > 0))
    assert left == pytest.approx(0.05, abs=0.015)
    assert right == pytest.approx(-0.05, abs=0.015)


def test_the_worst_spheres_come_first_and_one_view_is_enough() -> None:
    rng = np.random.default_rng(9)
    found = [shot_and_view(rng, i, np.array([10.0 * i, 0, 350]), 0.0, f"S{i}") for i in range(8)]
    views = []
    for i, (_, view) in enumerate(found):
        noise = 1 + rng.normal(0, 0.01 * (1 + i), (len(view.points_in_base_mm), 1)) / RADIUS_MM
        views.append(SphereView("s", i, view.sphere, CENTRE_MM + (view.points_in_base_mm - CENTRE_MM) * noise, CENTRE_MM))
    sizes = {f"S{i}": SphereSize(RADIUS_MM) for i in range(8)}
    figures = figures_of(views, sizes, line_profile=False)
    maps = residual_maps([shot for shot, _ in found], views, figures, sizes)
    assert [form.sphere for form in maps.forms] == ["S7", "S6", "S5", "S4", "S3", "S2"]
    assert len(maps.forms) == MOST_SPHERES
    assert centre_shifts_mm(figures)[0].shape == (0, 3)
    pictures = residual_pictures(figures, maps)
    assert [picture.title for picture in pictures] == ["Residual over the camera's view", "Form of the spheres"]
    assert "The 6 of 8 spheres" in pictures[1].caption
    assert "S7: 1 view," in form_maps_svg(maps.forms[:1])


@pytest.mark.parametrize("shift_mm", [3e-4, 0.07, 4.0])
def test_arrows_are_a_round_number_of_times_too_long_and_fit_the_picture(shift_mm: float) -> None:
    places = np.array([[0.0, 0, 0], [800.0, 200, 100]])
    factor = exaggeration_of(places, np.full((2, 3), shift_mm / np.sqrt(3)))
    assert 0.04 * 800 <= factor * shift_mm <= 0.12 * 800
    assert float(f"{factor:.0e}"[0]) in {1, 2, 5}
    assert factor == pytest.approx(float(f"{factor:.0e}"))


def test_a_camera_without_residuals_still_draws() -> None:
    flat = camera_maps(np.tile([0.0, 0, 300], (2, 1)), np.zeros(2))
    assert isinstance(flat, CameraMaps)
    assert "<svg" in camera_maps_svg(flat)
