"""Points that stray, what residuals add to known errors, and cones that voxels cut: what made figures of walls wrong or wide."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.inspecting.fitting import FitPoints, fit_shape
from measure.inspecting.geometry import Element
from measure.inspecting.shapes import ConeShape, PlaneShape, StadiumShape
from measure.inspecting.strays import mode_mm
from measure.inspecting.uncertainty import SeenField, residual_covariances
from tests.support.machined import voxel_means

CIRCLE = StadiumShape(np.eye(4), 12.0, 0.0, 3.0, 2.0)


def wall_points(n: int, rng: np.random.Generator, noise_mm: float = 0.05) -> FloatArray:
    angle, radius = rng.uniform(-np.pi, np.pi, n), 12.1 + rng.normal(0, noise_mm, n)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-3, 3, n)])


@pytest.mark.parametrize("share", [0.0, 0.2, 0.45])
def test_pixels_between_two_depths_do_not_widen_a_bore(share: float) -> None:
    """On the upper half of the wall, up to 1 mm inside the material, as flying pixels at a bore's mouth lie."""
    errors, sharp = [], []
    for seed in range(12):
        rng = np.random.default_rng([81, seed])
        points = wall_points(250, rng)
        flying = rng.permutation(250)[: int(share * 250)]
        points[flying, 2] = np.abs(points[flying, 2])
        points[flying, :2] *= 1 + rng.uniform(0, 1.0, (len(flying), 1)) / 12.1
        fit = fit_shape(CIRCLE, FitPoints(points, np.ones(250), np.arange(250)), name="bore")
        errors.append(2 * (fit.params[2] - 0.1))
        sharp.append(fit.rms_mm)
    assert np.abs(np.mean(errors)) < 0.005 + 0.06 * share  # a plain fit is 0.45 mm wide where 45 % fly
    assert np.mean(sharp) == pytest.approx(0.05, rel=0.25)


def test_the_mode_is_where_the_peak_is() -> None:
    rng = np.random.default_rng(2)
    residual = np.concatenate([rng.normal(-0.3, 0.02, 400), rng.uniform(-1, 1, 500)])
    assert mode_mm(residual) == pytest.approx(-0.3, abs=0.03)


def test_strays_near_a_plane_that_was_not_seen_make_no_plane() -> None:
    rng = np.random.default_rng(4)
    shape = PlaneShape(np.eye(4), (50.0, 8.0), 2.0)
    few = np.column_stack([rng.uniform(-45, 45, 13), rng.uniform(-7, 7, 13), rng.uniform(-2, 2, 13)])
    with pytest.raises(DataError, match="13 points"):
        fit_shape(shape, FitPoints(few, np.ones(13), np.arange(13)), name="riser")


def test_what_the_cloud_s_known_errors_do_to_residuals_is_not_charged_twice_and_what_nobody_stated_is() -> None:
    """Two views, each with a known error of its own, see one half of a wall each; then one half bulges as well."""
    rng = np.random.default_rng(6)
    wall = wall_points(3000, rng, 0.01)
    halves = wall[:, 0] > 0
    quiet = fit_shape(CIRCLE, FitPoints(wall, np.ones(3000), np.arange(3000)), name="bore")
    variances, sigma_mm = [], 0.05
    for _ in range(30):
        shift = rng.normal(0, sigma_mm, (2, 3)) * [1, 1, 0]
        moved = wall + shift[halves.astype(int)]
        fit = fit_shape(CIRCLE, FitPoints(moved, np.ones(3000), np.arange(3000), 0.5), name="bore")
        motion = np.zeros((len(fit.response.centre_in_part_mm), 3, 6))
        right = (fit.response.centre_in_part_mm[:, 0] > 0).astype(int)
        for i in range(2):
            motion[np.arange(len(right)), i, 3 * right + i] = 1.0
        field = SeenField(motion, np.eye(6) * sigma_mm**2, "two views")
        variances.append((fit.covariance()[2, 2], residual_covariances([fit], [fit.response], field)[0][2, 2]))
    alone, beyond = np.median(variances, axis=0)  # of what two views show the mean is made by few draws
    assert beyond < 0.1 * alone
    assert quiet.covariance()[2, 2] < 1e-6  # noise alone is charged as noise
    angle = np.arctan2(wall[:, 1], wall[:, 0])
    bulged = wall * (1 + 0.05 * np.cos(3 * angle) / 12.1)[:, None] ** [1, 1, 0]
    fit = fit_shape(CIRCLE, FitPoints(bulged, np.ones(3000), np.arange(3000), 0.5), name="bore")
    assert np.sqrt(fit.covariance()[2, 2]) > 4 * np.sqrt(quiet.covariance()[2, 2])


def test_a_cone_cut_by_voxels_keeps_its_angle() -> None:
    errors = []
    for seed in range(10):
        rng = np.random.default_rng([12, seed])
        z, angle = rng.uniform(-3, 3, 60_000), rng.uniform(-np.pi, np.pi, 60_000)
        ray = rng.normal(0, 0.06, 60_000) / np.sqrt(2)
        radius = 12.5 + z + ray
        raw = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z - ray + 0.05 * seed])
        points, count = voxel_means(raw, 0.5)
        points[:, 2] -= 0.05 * seed
        shape = ConeShape(np.eye(4), 12.5, np.pi / 4, 1.5, 2.0)
        inside = np.flatnonzero(shape.near(points))
        errors.append(np.degrees(2 * fit_shape(shape, FitPoints(points[inside], count[inside], inside, 0.5), name="sink").params[5]))
    assert np.sqrt(np.mean(np.square(errors))) < 0.12


def test_an_axis_has_its_place_and_a_cone_its_diameter_at_the_nominal_centre_wherever_the_part_lay() -> None:
    axis = np.array([0.02, -0.01, 1.0]) / np.linalg.norm([0.02, -0.01, 1.0])
    nominal = Element("cone", np.zeros(3), np.array([0.0, 0, 1]), 20.0, angle_deg=90.0)
    at = Element("cone", np.array([0.1, 0.2, 0.0]), axis, 20.0, angle_deg=90.0)
    risen = at.moved(se3.from_rotation_translation(np.eye(3), [0.0, 0.0, 0.3])).passing(nominal)
    assert risen.point_mm[2] == pytest.approx(0.0, abs=1e-12)
    assert risen.point_mm[:2] == pytest.approx(at.point_mm[:2] - 0.3 * axis[:2] / axis[2])
    # 0.3 mm higher, the mantle of 90 degrees is 0.6 mm narrower at the nominal height
    assert risen.diameter_mm == pytest.approx(20.0 - 0.6, abs=1e-3)
