"""Whose errors a feature has: those of the views that saw it, not of those that saw what stands beside it."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.inspecting.fitting import FitPoints, fit_shape
from measure.inspecting.shapes import PlaneShape, frame_about
from measure.inspecting.views import View, seen_field
from tests.unit.measure.test_inspection import DrawnSystem

PERFECT = DrawnSystem(np.zeros(12), np.full(12, 1e-9))


def view(in_part: FloatArray, place_mm: FloatArray) -> View:
    """From above; the part stands in the base."""
    pose = se3.from_rotation_translation(se3.exp_so3([np.pi, 0, 0]), place_mm)
    return View(se3.apply(se3.inverse(pose), in_part), None, pose)


@pytest.mark.parametrize("n_others", [0, 9])
def test_a_wall_that_one_view_sees_has_its_whole_error_however_many_see_its_foot(n_others: int) -> None:
    rng = np.random.default_rng(8)
    wall = np.column_stack([rng.normal(0, 0.02, 900), rng.uniform(-20, 20, 900), rng.uniform(0, 18, 900)])
    foot = np.column_stack([rng.uniform(-20, -0.5, 4000), rng.uniform(-25, 25, 4000), rng.normal(0, 0.02, 4000)])
    place = np.array([-60.0, 0.0, 350.0])
    views = [view(np.concatenate([wall, foot]), place), *(view(foot, place + np.array([5.0 * i, 0, 0])) for i in range(n_others))]
    shape = PlaneShape(frame_about([0, 0, 9], [-1, 0, 0], [0, 1, 0]), (18.0, 7.5), 2.0)
    fit = fit_shape(shape, FitPoints(wall, np.ones(len(wall)), np.arange(len(wall))), name="wall")
    (covariance,) = seen_field(PERFECT, views, [fit.response], np.eye(4)).covariances([fit.response])
    lever_mm = 350.0 - 9.0
    whole = np.hypot(PERFECT.noise.pose_mm, PERFECT.noise.pose_rad * lever_mm)
    assert np.sqrt(covariance[0, 0]) == pytest.approx(whole, rel=0.05)


def test_views_that_all_see_a_wall_share_its_error_and_one_too_small_for_them_has_that_of_its_place() -> None:
    rng = np.random.default_rng(9)
    wall = np.column_stack([rng.normal(0, 0.02, 900), rng.uniform(-20, 20, 900), rng.uniform(0, 18, 900)])
    place = np.array([-60.0, 0.0, 350.0])
    shape = PlaneShape(frame_about([0, 0, 9], [-1, 0, 0], [0, 1, 0]), (18.0, 7.5), 2.0)
    fit = fit_shape(shape, FitPoints(wall, np.ones(len(wall)), np.arange(len(wall))), name="wall")
    whole = np.hypot(PERFECT.noise.pose_mm, PERFECT.noise.pose_rad * 341.0)
    (shared,) = seen_field(PERFECT, [view(wall, place)] * 4, [fit.response], np.eye(4)).covariances([fit.response])
    assert np.sqrt(shared[0, 0]) == pytest.approx(whole / 2, rel=0.05)
    beside = wall - np.array([1.0, 0, 0])  # none of the thinned points is on the wall itself
    (nearby,) = seen_field(PERFECT, [view(beside, place)], [fit.response], np.eye(4)).covariances([fit.response])
    assert np.sqrt(nearby[0, 0]) == pytest.approx(whole, rel=0.05)


@pytest.mark.parametrize("times", [1.0, 3.0])
def test_views_that_differ_more_than_the_calibration_s_pose_noise_are_taken_at_their_word(times: float) -> None:
    """A plate seen whole by 12 views, each off by the stated pose noise, or by three times as much."""
    rng = np.random.default_rng(int(10 * times))
    found = []
    for _ in range(8):
        grid = np.column_stack([rng.uniform(-60, 60, (3000, 2)), np.zeros(3000)])
        views, seen = [], []
        for number in range(12):
            stated = se3.from_rotation_translation(se3.exp_so3([np.pi, 0, 0.5 * number]), [rng.uniform(-30, 30), 0.0, 350.0])
            twist = times * np.concatenate([rng.normal(0, PERFECT.noise.pose_mm, 3), rng.normal(0, PERFECT.noise.pose_rad, 3)])
            about = se3.from_rotation_translation(np.eye(3), stated[:3, 3])
            true = about @ se3.exp(twist) @ se3.inverse(about) @ stated
            views.append(View(se3.apply(se3.inverse(true), grid), None, stated))
            seen.append(se3.apply(stated, views[-1].points_in_camera_mm))
        points = np.concatenate(seen)
        fit = fit_shape(PlaneShape(np.eye(4), (55.0, 55.0), 2.0), FitPoints(points, np.ones(len(points)), np.arange(len(points)), 0.5), name="plate")
        field = seen_field(PERFECT, views, [fit.response], np.eye(4))
        found.append(np.sqrt(field.covariance[-1, -1]) / PERFECT.noise.pose_rad)
    assert np.mean(found) == pytest.approx(times, rel=0.25)
    assert min(found) >= 1.0


def test_two_views_that_see_the_two_halves_of_a_narrow_wall_tilt_it() -> None:
    """A line through a step d in the middle of a height h has the slope 1.5 d / h."""
    rng = np.random.default_rng(11)
    wall = np.column_stack([rng.normal(0, 0.02, 4000), rng.uniform(-50, 50, 4000), rng.uniform(-8, 8, 4000)])
    place = np.array([-60.0, 0.0, 350.0])
    shape = PlaneShape(frame_about([0, 0, 0], [-1, 0, 0], [0, 1, 0]), (50.0, 8.0), 2.0)
    fit = fit_shape(shape, FitPoints(wall, np.ones(len(wall)), np.arange(len(wall))), name="wall")
    halves = [view(wall[wall[:, 2] > 0], place), view(wall[wall[:, 2] < 0], place)]
    (covariance,) = seen_field(PERFECT, halves, [fit.response], np.eye(4)).covariances([fit.response])
    whole = np.hypot(PERFECT.noise.pose_mm, PERFECT.noise.pose_rad * 350.0)
    assert np.sqrt(covariance[2, 2]) == pytest.approx(1.5 * np.sqrt(2) * whole / 16, rel=0.15)
