"""What a camera sees, against sampled points of the sphere and the exact bounds of the view."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.cell import CameraSection
from acquire.visibility import CameraView, camera_view, draw_centres, sees_sphere, whole_sphere_depths_mm
from drivers.errors import SettingsError
from drivers.kinematics.se3 import FloatArray

AREA = CameraView((250.0, 750.0), (float(np.radians(27.5)), float(np.radians(18))))
PROFILE = CameraView((150.0, 300.0), (float(np.radians(20)), 0.0), "line_profile")
RADIUS_MM = 19.05


def points_inside(view: CameraView, points: FloatArray) -> bool:
    """The view's definition, point by point."""
    x, y, z = points.T
    across, down = np.tan(view.half_angle_rad)
    inside = (z >= view.working_range_mm[0]) & (z <= view.working_range_mm[1]) & (np.abs(x) <= z * across)
    return bool((inside & ((np.abs(y) <= z * down) if view.kind == "area" else True)).all())


def surface(centre: FloatArray, radius_mm: float) -> FloatArray:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(4000, 3))
    return np.asarray(centre + radius_mm * directions / np.linalg.norm(directions, axis=1, keepdims=True))


@given(st.floats(-250, 250), st.floats(-160, 160), st.floats(240, 760))
def test_a_sphere_is_seen_if_all_its_points_are(x: float, y: float, z: float) -> None:
    centre = np.array([x, y, z])
    if sees_sphere(AREA, centre, RADIUS_MM):
        assert points_inside(AREA, surface(centre, RADIUS_MM))
    elif not sees_sphere(AREA, centre, RADIUS_MM * 0.95):
        assert not points_inside(AREA, surface(centre, RADIUS_MM))


@pytest.mark.parametrize("view", [AREA, PROFILE], ids=["area", "profile"])
def test_drawn_centres_are_seen_and_fill_depth_and_width(view: CameraView) -> None:
    centres = draw_centres(view, RADIUS_MM, 4000, np.random.default_rng(1))
    assert sees_sphere(view, centres, RADIUS_MM).all()
    low, high = whole_sphere_depths_mm(view, RADIUS_MM)
    depth = (centres[:, 2] - low) / (high - low)
    assert np.abs(np.histogram(depth, 5, (0, 1))[0] / 4000 - 0.2).max() < 0.03
    edge = centres[:, 2] * np.tan(view.half_angle_rad[0]) - RADIUS_MM / np.cos(view.half_angle_rad[0])
    assert np.abs(np.histogram(centres[:, 0] / edge, 5, (-1, 1))[0] / 4000 - 0.2).max() < 0.03
    assert abs(np.corrcoef(centres[:, 0], centres[:, 2])[0, 1]) < 0.06


def test_profiles_are_drawn_beside_the_centre_on_both_sides_but_not_at_the_rim() -> None:
    beside = draw_centres(PROFILE, RADIUS_MM, 500, np.random.default_rng(2))[:, 1] / RADIUS_MM
    assert beside.min() < -0.6
    assert beside.max() > 0.6
    assert np.abs(beside).max() <= 0.7
    assert not sees_sphere(PROFILE, [0, 0.9 * RADIUS_MM, 220], RADIUS_MM)


def test_a_narrow_view_moves_the_nearest_depth_out() -> None:
    narrow = CameraView((50.0, 500.0), (float(np.radians(20)), float(np.radians(5))))
    low, _ = whole_sphere_depths_mm(narrow, RADIUS_MM)
    assert low == pytest.approx(RADIUS_MM / np.sin(np.radians(5)))
    assert sees_sphere(narrow, [0, 0, low + 1e-6], RADIUS_MM)
    assert not sees_sphere(narrow, [0, 0, low - 1e-3], RADIUS_MM)


def test_asked_depths_are_kept() -> None:
    depth = draw_centres(AREA, RADIUS_MM, 300, np.random.default_rng(3), (300, 400))[:, 2]
    assert 300 <= depth.min() < 305
    assert 395 < depth.max() <= 400


@pytest.mark.parametrize(("radius_mm", "depth_mm"), [(300.0, None), (RADIUS_MM, (10, 100))])
def test_a_sphere_that_is_never_seen_whole_is_told(radius_mm: float, depth_mm: tuple[float, float] | None) -> None:
    with pytest.raises(SettingsError, match="never sees"):
        draw_centres(AREA, radius_mm, 10, np.random.default_rng(0), depth_mm)


def test_the_view_of_a_cell_is_in_radians_and_halved() -> None:
    section = CameraSection.model_validate({"driver": "simulated", "working_range_mm": [250, 750], "field_of_view_deg": [55, 36]})
    view = camera_view(section)
    assert view == AREA
    assert view.middle_mm == 500


def test_a_cell_without_a_view_is_told_what_to_add() -> None:
    section = CameraSection.model_validate({"driver": "simulated", "working_range_mm": [250, 750]})
    with pytest.raises(SettingsError, match=r"without field_of_view_deg.*Add"):
        camera_view(section)
