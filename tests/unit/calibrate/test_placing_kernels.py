"""Whole scans through the compiled kernel: the same points as through numpy, whatever the model and the holes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate import Calibration
from calibrate.camera_error import CameraError, FreeCrossing, FullPillowError, NoCameraError, PillowError, correction_in_camera_mm
from calibrate.camera_error_field import PolynomialError, affine_error
from calibrate.placing_kernels import place_points
from drivers.kinematics import se3
from tests.support.recorded import nominal_calibration, record_session, write_cell

BOX = ((10.0, -5.0, 475.0), (150.0, 100.0, 150.0))
PILLOW = PillowError((60.0, 0.0, 500.0))
MODELS: list[CameraError] = [
    NoCameraError(),
    PILLOW,
    FullPillowError((60.0, 0.0, 500.0)),
    FreeCrossing(PILLOW, (0.3, -0.2, 0.1)),
    affine_error(BOX),
    PolynomialError(*BOX, 6, 2),
]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_kernel_places_points_as_numpy_does(model: CameraError, dtype: type[np.floating]) -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([-200, -150, 250], [200, 150, 700], (1337, 3)).astype(dtype)  # beyond the box too, and no whole block
    points[::50], points[7, 1], points[9, 2] = np.nan, np.nan, np.inf
    coefficients, base_from_camera = rng.normal(0, 0.1, len(model.axis)), se3.exp(np.array([900.0, -400.0, 300.0, 0.4, -1.0, 2.0]))
    found = np.empty((1337, 3))
    place_points(points, model.polynomials, coefficients, base_from_camera, found)
    whole = np.isfinite(points).all(axis=1)
    assert np.isnan(found[~whole]).all()
    exact = points[whole].astype(np.float64)
    if len(coefficients):
        exact = exact + correction_in_camera_mm(model, coefficients, exact)
    np.testing.assert_allclose(found[whole], se3.apply(base_from_camera, exact), rtol=0, atol=1e-9)


def test_a_calibration_places_a_whole_scan_as_it_places_its_parts(tmp_path: Path) -> None:
    cell = write_cell(tmp_path)
    session = record_session(tmp_path / "session", cell, np.random.default_rng(1), shots_per_sphere=2)
    calibration: Calibration = replace(nominal_calibration(cell, [session]), link_twists=np.random.default_rng(2).normal(0, 1e-3, (6, 6)))
    rng = np.random.default_rng(3)
    points = rng.uniform([-100, -80, 250], [100, 80, 450], (25_000, 3))
    points[::11] = np.nan
    q = rng.uniform(-0.5, 0.5, 6)
    parts = [calibration.points_in_base_mm(part, joints_rad=q) for part in np.array_split(points, 5)]
    np.testing.assert_allclose(calibration.points_in_base_mm(points, joints_rad=q), np.concatenate(parts), rtol=0, atol=1e-9)
    alone = calibration.points_in_base_mm(points, joints_rad=np.tile(q, (25_000, 1)))
    np.testing.assert_allclose(calibration.points_in_base_mm(points, joints_rad=q), alone, rtol=0, atol=1e-9)
