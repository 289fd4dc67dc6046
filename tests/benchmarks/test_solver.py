"""The whole-cloud solver on METHOD's reference data: 100 shots of one sphere on the paper's robot and camera."""

from __future__ import annotations

import resource

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from calibrate.camera_error import PillowError
from calibrate.clouds import solve_clouds
from calibrate.normal import NoiseModel
from calibrate.problem import Problem, State, linearise_geometry
from calibrate.start import initial_state
from calibrate.sums import shot_moments
from drivers.kinematics import mdh, se3
from tests.support.synthetic import draw_shot, paper_cell
from tests.support.timing import best_of, tell

pytestmark = pytest.mark.bench

SEED = 20260101
N_SHOTS = 100
NOISE = NoiseModel(point_mm=0.08, pose_mm=0.01, pose_rad=1e-4)


def reference_problem(n_points: int) -> tuple[Problem, State]:
    """The problem, and a start 2 mm and 7 mrad off in the hand-eye transform."""
    rng = np.random.default_rng(SEED)
    cell = paper_cell()
    shots = [draw_shot(cell, rng, n_points=n_points) for _ in range(N_SHOTS)]
    joints = np.stack([shot.joints_rad for shot in shots])
    points = np.concatenate([shot.points_in_camera_mm for shot in shots])
    camera_error = PillowError()
    problem = Problem(
        model=cell.nominal,
        joints_rad=joints,
        base_from_flange=mdh.base_from_flange(cell.nominal, joints),
        scan=np.arange(N_SHOTS),
        sphere=np.zeros(N_SHOTS, dtype=np.int64),
        points_in_camera_mm=points,
        starts=np.arange(N_SHOTS + 1) * n_points,
        camera_error=camera_error,
        radius_mm=np.array([cell.radius_mm]),
        radius_sigma_mm=np.array([0.00025]),
    )
    off = se3.exp([2.0, 0, 0, 0.007, 0, 0])
    return problem, initial_state(problem, off @ cell.flange_from_camera, cell.centre_in_base_mm[None] + 1.0)


@pytest.mark.parametrize(("n_points", "limit_s"), [(1000, 0.1), (20_000, 1.0)])
def test_solve_100_shots_with_covariance(n_points: int, limit_s: float) -> None:
    problem, start = reference_problem(n_points)
    geometry = linearise_geometry(problem, start)
    shot_moments(problem, start, geometry, np.inf)

    tell(f"moments of 100 x {n_points} points, one pass", best_of(5, lambda: shot_moments(problem, start, geometry, np.inf)))
    tell("camera poses and Jacobian columns of 100 shots", best_of(5, lambda: linearise_geometry(problem, start)))
    with threadpool_limits(1, user_api="blas"):  # as calibrate does
        solution = solve_clouds(problem, start, NOISE)
        best_s = best_of(7, lambda: solve_clouds(problem, start, NOISE).covariance)
    tell(f"whole solve of 100 x {n_points} points", best_s, f"{solution.passes} passes, point rms {np.median(solution.point_rms_mm):.3f} mm")
    assert 0.02 < np.median(solution.point_rms_mm) < 0.08
    assert best_s <= limit_s
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 1_000_000  # kB on Linux
