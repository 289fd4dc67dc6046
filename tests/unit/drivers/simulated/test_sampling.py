"""The sparse sampling of a sphere against the sphere itself and against whole frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.kinematics import mdh, se3
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.draws import PAPER_FLANGE_FROM_CAMERA, TABLE_1_ERRORS
from drivers.simulated.sampling import observe_sphere
from drivers.simulated.truth import RobotTruth
from tests.support.simulated import CENTRE_IN_CAMERA_MM, JOINTS_RAD, cell_at, exact_camera, paper_model, truth_with_sphere


def test_points_lie_on_the_sphere_of_the_optical_radius() -> None:
    exact = truth_with_sphere()
    truth = replace(exact, spheres={"A": replace(exact.spheres["A"], optical_offset_mm=0.03)})
    points = observe_sphere(SimulatedCell(truth, paper_model()), JOINTS_RAD, "A", 1000, np.random.default_rng(0), noise=False)
    assert points.shape == (1000, 3)
    assert np.abs(np.linalg.norm(points - CENTRE_IN_CAMERA_MM, axis=1) - 19.08).max() < 1e-9


def test_the_chain_closes_with_the_true_robot_and_not_with_the_nominal_one() -> None:
    model = paper_model()
    truth = truth_with_sphere(robot=TABLE_1_ERRORS)
    cell = cell_at(truth)
    points = observe_sphere(cell, JOINTS_RAD, "A", 500, np.random.default_rng(0), noise=False)
    centre = np.array(truth.spheres["A"].centre_in_base_mm)
    true = se3.apply(cell.true_base_from_camera(), points)
    nominal = se3.apply(mdh.base_from_flange(model, JOINTS_RAD) @ np.array(PAPER_FLANGE_FROM_CAMERA), points)
    assert np.abs(np.linalg.norm(true - centre, axis=1) - 19.05).max() < 1e-9
    assert np.abs(np.linalg.norm(nominal - centre, axis=1) - 19.05).max() > 0.1


def test_incidence_spreads_as_in_a_frame() -> None:
    camera = exact_camera(resolution_px=(1280, 800), incidence_limit_deg=75.0, incidence_softness_deg=10.0)
    truth = truth_with_sphere(camera=camera)
    device = SimulatedCamera(cell_at(truth))
    device.open()
    frame = device.capture(timeout_s=5.0).xyz_mm.reshape(-1, 3).astype(np.float64)
    frame = frame[np.isfinite(frame[:, 0])]
    sparse = observe_sphere(SimulatedCell(truth, paper_model()), JOINTS_RAD, "A", 20000, np.random.default_rng(1))

    def quantiles(points: FloatArray) -> FloatArray:
        normal = (points - CENTRE_IN_CAMERA_MM) / 19.05
        cos = -np.sum(normal * points, axis=1) / np.linalg.norm(points, axis=1)
        return np.asarray(np.quantile(cos, np.linspace(0.05, 0.95, 10)))

    np.testing.assert_allclose(quantiles(sparse), quantiles(frame), atol=0.015)


def fitted_centre(points_mm: FloatArray) -> FloatArray:
    """Centre of the sphere through exact points: |p|² = 2 p.c + const is linear."""
    rows = np.column_stack([2 * points_mm, np.ones(len(points_mm))])
    return np.asarray(np.linalg.lstsq(rows, np.sum(points_mm**2, axis=1), rcond=None)[0][:3])


def test_pose_noise_moves_the_whole_sphere_by_its_sigma() -> None:
    cell, rng = SimulatedCell(truth_with_sphere(robot=RobotTruth(pose_noise_mm=0.02)), paper_model()), np.random.default_rng(3)
    centres = np.array([fitted_centre(observe_sphere(cell, JOINTS_RAD, "A", 50, rng)) for _ in range(200)])
    assert (centres - CENTRE_IN_CAMERA_MM).std() == pytest.approx(0.02, rel=4 / np.sqrt(2 * centres.size))


def test_play_shows_on_both_sides_with_noise_and_on_none_without() -> None:
    cell, rng = SimulatedCell(truth_with_sphere(robot=RobotTruth(backlash_rad=(2e-4, 0, 0, 0, 0, 0))), paper_model()), np.random.default_rng(3)
    centres = np.array([fitted_centre(observe_sphere(cell, JOINTS_RAD, "A", 50, rng)) for _ in range(20)])
    distances = np.linalg.norm(centres - CENTRE_IN_CAMERA_MM, axis=1)
    x, y, _ = cell.truth.spheres["A"].centre_in_base_mm
    np.testing.assert_allclose(distances, 1e-4 * np.hypot(x, y), rtol=1e-3)
    assert len(np.unique(np.round(centres[:, 0], 6))) == 2
    middle = fitted_centre(observe_sphere(cell, JOINTS_RAD, "A", 50, rng, noise=False))
    np.testing.assert_allclose(middle, CENTRE_IN_CAMERA_MM, atol=1e-6)


def test_range_noise_scatters_the_points_along_their_rays() -> None:
    cell = SimulatedCell(truth_with_sphere(camera=exact_camera(range_noise_mm=0.05)), paper_model())
    noisy = observe_sphere(cell, JOINTS_RAD, "A", 4000, np.random.default_rng(3))
    residual = np.linalg.norm(noisy - CENTRE_IN_CAMERA_MM, axis=1) - 19.05
    # along the ray 0.05, so 0.05 cos(incidence) across the surface: rms over the silhouette's disc is 0.05 / sqrt(2)
    assert residual.std() == pytest.approx(0.05 / np.sqrt(2), rel=0.05)


def test_the_cell_is_left_as_it_was() -> None:
    cell = SimulatedCell(truth_with_sphere(), paper_model())
    before = cell.true_base_from_flange()
    observe_sphere(cell, JOINTS_RAD, "A", 10, np.random.default_rng(0))
    np.testing.assert_array_equal(cell.true_base_from_flange(), before)
    assert cell.clock_s == 0.0
