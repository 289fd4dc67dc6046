"""Finding the sphere in one full frame, which the capture run waits for."""

from __future__ import annotations

import numpy as np
import pytest

from acquire.sphere import find_sphere
from tests.support.scenes import frame, plane_range_mm, rays
from tests.support.timing import best_of, tell

pytestmark = pytest.mark.bench

CENTRE_MM = np.array([30.0, -20.0, 500.0])
RADIUS_MM = 19.05


@pytest.mark.parametrize("predicted", [True, False], ids=["predicted", "anywhere"])
def test_find_sphere_in_a_million_pixels(predicted: bool) -> None:
    sight = rays(1280, 800)
    table = plane_range_mm(sight, [0, 0, 560], [0, 0.1, 1])
    scan = frame([(CENTRE_MM, RADIUS_MM)], sight=sight, surfaces=[table], noise_mm=0.05, flying=0.5, outliers=0.02, seed=7)
    guess = np.add(CENTRE_MM, (5, -5, 8)) if predicted else None

    finding = find_sphere(scan, radius_mm=RADIUS_MM, predicted_centre_in_camera_mm=guess)
    error_mm = float(np.linalg.norm(finding.centre_in_camera_mm - CENTRE_MM))
    best_s = best_of(5, lambda: find_sphere(scan, radius_mm=RADIUS_MM, predicted_centre_in_camera_mm=guess))
    where = "near a prediction" if predicted else "anywhere in the frame"
    tell(f"sphere in 1280 x 800, table and clutter, {where}", best_s, f"{finding.n_points} points, centre off by {error_mm * 1e3:.1f} um")
    assert error_mm < 0.05
