"""Camera errors against their own definition and inverse; noise by its statistics."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.camera_error import PillowError
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.optics import measured_points, noisy_points, range_sigma_mm, seen_under_incidence
from drivers.simulated.truth import CameraErrorTruth, FieldTruth, NoError, PillowTruth, StereoTruth
from tests.support.simulated import exact_camera


def cloud(n: int = 500) -> FloatArray:
    rng = np.random.default_rng(5)
    z = rng.uniform(250, 700, n)
    return np.column_stack([z * rng.uniform(-0.5, 0.5, n), z * rng.uniform(-0.3, 0.3, n), z])


def test_the_papers_correction_undoes_the_pillow_exactly() -> None:
    error = PillowTruth()
    true_points = cloud()
    measured = measured_points(error, true_points)
    # the calibrator's own formula, with the negative of k in its scaled form
    basis = PillowError(sight_crossing_mm=error.sight_crossing_mm).basis(measured)
    coefficients_mm = -np.array(error.k) * 250.0 ** np.array([3, 5, 7])
    corrected = measured.copy()
    corrected[:, 2] += basis @ coefficients_mm
    assert np.abs(measured - true_points).max() > 0.3
    assert np.abs(corrected - true_points).max() < 1e-8


def test_the_paper_pillow_is_of_the_size_the_method_states() -> None:
    z = np.linspace(250, 400, 50)
    points = np.column_stack([np.linspace(-100, 100, 50), 0 * z, z])
    shift = measured_points(PillowTruth(), points)[:, 2] - z
    assert 0.3 < np.abs(shift).max() < 1.7


@pytest.mark.parametrize("error", [NoError(), StereoTruth(), FieldTruth(), PillowTruth(k=(0.0, 0.0, 0.0))])
def test_no_error_measures_true_points(error: CameraErrorTruth) -> None:
    points = cloud()
    np.testing.assert_allclose(measured_points(error, points), points, atol=1e-9)


def test_wrong_baseline_scales_the_whole_scene() -> None:
    points = cloud()
    error = StereoTruth(baseline_mm=120.0, baseline_error_mm=0.6)
    # real baseline longer than assumed: everything is believed to be smaller by the same factor
    np.testing.assert_allclose(measured_points(error, points), points * (120.0 / 120.6), rtol=1e-12)


def test_wrong_focal_length_stretches_across_the_view() -> None:
    points = np.array([[50.0, 40.0, 500.0]])
    measured = measured_points(StereoTruth(focal_error_px=1.2), points)
    np.testing.assert_allclose(measured[:, :2] / measured[:, 2:], points[:, :2] / points[:, 2:] * (1201.2 / 1200.0), rtol=1e-12)


def test_toe_in_error_grows_with_depth_squared() -> None:
    def depth_error(z: float) -> float:
        return float(measured_points(StereoTruth(toe_in_error_rad=1e-6), np.array([[60.0, 0.0, z]]))[0, 2] - z)

    # on the middle line dz = (z² + (b/2)²) / b * angle, from triangulation
    for z in (300.0, 600.0):
        assert abs(depth_error(z)) == pytest.approx((z**2 + 60.0**2) / 120.0 * 1e-6, rel=1e-3)


def test_stereo_is_no_pillow() -> None:
    error = StereoTruth(focal_error_px=0.3, principal_error_px=(0.05, -0.2), toe_in_error_rad=5e-5, baseline_error_mm=0.03)
    points = cloud()
    moved = measured_points(error, points) - points
    assert np.abs(moved[:, :2]).max() > 0.02  # moves points sideways, which no pillow can
    assert 0.02 < np.abs(moved[:, 2]).max() < 1.0


def test_field_acts_on_depth_only_by_bowl_and_ripple() -> None:
    points = cloud()
    moved = measured_points(FieldTruth(bowl_mm=0.1, ripple_mm=0.05), points) - points
    assert np.abs(moved[:, :2]).max() == 0.0
    bowl = 0.1 * (points[:, 0] ** 2 + points[:, 1] ** 2) / 150.0**2
    assert np.abs(moved[:, 2] - bowl).max() == pytest.approx(0.05, rel=0.05)


def test_range_noise_acts_along_the_ray_with_its_sigma() -> None:
    camera = exact_camera(range_noise_mm=0.08, range_noise_at_mm=400.0, range_noise_growth=2.0)
    true_points = np.tile([80.0, -60.0, 500.0], (20000, 1))
    shift = noisy_points(camera, true_points, np.random.default_rng(0)) - true_points
    ray = true_points[0] / np.linalg.norm(true_points[0])
    along = shift @ ray
    expected = 0.08 * (np.linalg.norm(true_points[0]) / 400.0) ** 2
    assert np.abs(shift - along[:, None] * ray).max() < 1e-12
    assert along.std() == pytest.approx(expected, rel=4 / np.sqrt(2 * 20000))
    assert abs(along.mean()) < 4 * expected / np.sqrt(20000)
    assert float(range_sigma_mm(camera, 400.0)) == 0.08


def test_incidence_drop_out_is_soft_below_the_limit_and_total_beyond() -> None:
    camera = exact_camera(incidence_limit_deg=75.0, incidence_softness_deg=10.0)

    def share(angle_deg: float) -> float:
        return float(seen_under_incidence(camera, np.full(20000, np.cos(np.radians(angle_deg))), np.random.default_rng(1)).mean())

    assert share(64.9) == 1.0
    assert share(70.0) == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(20000))
    assert share(75.1) == 0.0
