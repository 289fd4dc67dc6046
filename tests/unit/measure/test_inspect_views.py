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
