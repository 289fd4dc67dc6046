"""The fits against their own definition: stationary points, finite differences, coverage, and an oracle."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from acquire.sphere import fit_fixed_radius, fit_free_radius
from drivers.errors import DataError
from drivers.kinematics import se3
from tests.support.scenes import cap

CENTRE = np.array([30.0, -20.0, 420.0])
RADIUS = 19.05


@pytest.mark.parametrize("half_angle_rad", [0.35, 0.7, 1.05])
def test_exact_points_give_the_exact_sphere(half_angle_rad: float) -> None:
    points = cap(400, centre_mm=CENTRE, radius_mm=RADIUS, half_angle_rad=half_angle_rad, noise_mm=0.0)
    start = np.add(CENTRE, (1.5, -2.0, 3.0))
    centre, _ = fit_fixed_radius(points, RADIUS, start)
    np.testing.assert_allclose(centre, CENTRE, atol=1e-7)
    free_centre, radius, _ = fit_free_radius(points, RADIUS + 1, start)
    np.testing.assert_allclose([*free_centre, radius], [*CENTRE, RADIUS], atol=1e-5)


def test_fits_agree_with_scipy() -> None:
    points = cap(300, centre_mm=CENTRE, radius_mm=RADIUS, noise_mm=0.1, seed=3)
    fixed, _ = fit_fixed_radius(points, RADIUS, CENTRE)

    def residual(parameters: np.ndarray) -> np.ndarray:
        radius = parameters[3] if len(parameters) == 4 else RADIUS
        return np.asarray(np.linalg.norm(points - parameters[:3], axis=1) - radius)

    oracle = least_squares(residual, CENTRE, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(fixed, oracle.x, atol=1e-6)
    centre, radius, covariance = fit_free_radius(points, RADIUS, CENTRE)
    free = least_squares(residual, np.append(CENTRE, RADIUS), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose([*centre, radius], free.x, atol=1e-5)
    jacobian = np.asarray(free.jac)
    np.testing.assert_allclose(covariance, np.linalg.inv(jacobian.T @ jacobian) * 2 * free.cost / (300 - 4), rtol=1e-3)


@given(st.integers(0, 1000))
def test_fit_moves_with_the_points(seed: int) -> None:
    points = cap(80, centre_mm=CENTRE, radius_mm=RADIUS, seed=seed)
    rng = np.random.default_rng(seed)
    moved_from_camera = se3.exp(np.append(rng.normal(0, 100, 3), rng.normal(0, 1, 3)))
    centre, covariance = fit_fixed_radius(points, RADIUS, CENTRE)
    moved, moved_covariance = fit_fixed_radius(se3.apply(moved_from_camera, points), RADIUS, se3.apply(moved_from_camera, CENTRE))
    np.testing.assert_allclose(moved, se3.apply(moved_from_camera, centre), atol=1e-6)
    rotation = moved_from_camera[:3, :3]
    np.testing.assert_allclose(moved_covariance, rotation @ covariance @ rotation.T, atol=1e-8)


def test_a_weight_of_two_is_a_point_given_twice() -> None:
    points = cap(60, centre_mm=CENTRE, radius_mm=RADIUS, seed=5)
    weights = np.where(np.arange(60) < 20, 2.0, 1.0)
    weighted, _ = fit_fixed_radius(points, RADIUS, CENTRE, weights)
    doubled, _ = fit_fixed_radius(np.concatenate([points, points[:20]]), RADIUS, CENTRE)
    np.testing.assert_allclose(weighted, doubled, atol=1e-7)


def test_covariance_covers() -> None:
    normalised = []
    for seed in range(150):
        points = cap(120, centre_mm=CENTRE, radius_mm=RADIUS, noise_mm=0.0, half_angle_rad=0.9, seed=seed)
        normal = (points - CENTRE) / RADIUS
        points = points + normal * np.random.default_rng(seed).normal(0, 0.08, (len(points), 1))
        centre, covariance = fit_fixed_radius(points, RADIUS, CENTRE)
        normalised.append((centre - CENTRE) @ np.linalg.solve(covariance, centre - CENTRE))
    # chi squared with 3 degrees: mean 3, its standard error sqrt(6/150) = 0.2
    assert 2.3 < np.mean(normalised) < 3.7


@pytest.mark.parametrize("points", [np.zeros((3, 3)), np.tile([0.0, 0.0, 400.0], (50, 1))])
def test_points_that_fix_nothing_are_refused(points: np.ndarray) -> None:
    with pytest.raises(DataError):
        fit_fixed_radius(points, RADIUS, CENTRE)


def test_a_plane_has_no_free_radius() -> None:
    grid = np.stack([*np.meshgrid(np.arange(8.0), np.arange(8.0)), np.full((8, 8), 400.0)], -1).reshape(-1, 3)
    with pytest.raises(DataError):
        fit_free_radius(grid[:4], RADIUS, CENTRE)
