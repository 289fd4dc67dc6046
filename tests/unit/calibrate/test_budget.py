"""The error budget: its total is the covariance of a point, its shares are those of their blocks, and gauge moves nothing."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from calibrate import Calibration
from calibrate.budget import ErrorBudget, Views, _without_gauge, blocks, error_budget, shares_of_views, views_at
from calibrate.camera_error import PillowError
from calibrate.clouds import solve_clouds
from calibrate.normal import symmetric_inverse
from calibrate.problem import LengthConstraint
from calibrate.sources import artefact_covariance
from drivers.kinematics.se3 import FloatArray
from tests.support.bound import FIRST_NOISE
from tests.support.solving import draw_shots, problem_of, start_of
from tests.support.synthetic import paper_cell

BOX = np.array([[750.0, -150.0, 200.0], [1000.0, 150.0, 400.0]])
NAMES = ("robot_geometry_mm", "hand_eye_mm", "camera_field_mm", "arm_physics_mm")


def some_views(calibration: Calibration, n: int = 40) -> Views:
    rng = np.random.default_rng(0)
    return views_at(calibration, rng.uniform(BOX[0], BOX[1], (n, 3)), rng, np.ones(n, dtype=np.int64))


def covariance_of(calibration: Calibration, views: Views) -> FloatArray:
    p = views.jacobian.shape[-1]
    return calibration.covariance[:p, :p]


def test_the_total_is_the_trace_of_the_point_s_covariance(calibration: Calibration) -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([-90, -50, 260], [90, 50, 390], (12, 3))
    joints = calibration.datum.references.joints_rad[rng.integers(len(calibration.datum.references.joints_rad), size=12)]
    pose, point = calibration.noise_covariances_mm2(points, calibration.base_from_flange(joints))
    views = Views(np.arange(12), points, calibration.point_jacobian(points, joints_rad=joints), pose, point)
    expected = np.trace(calibration.point_covariance_in_base_mm2(points, joints_rad=joints), axis1=1, axis2=2)
    np.testing.assert_allclose(shares_of_views(calibration, covariance_of(calibration, views), views)["total_mm"], expected, rtol=1e-9)


def test_views_lie_where_they_should_and_gauge_does_not_change_the_total(calibration: Calibration) -> None:
    rng = np.random.default_rng(2)
    places = rng.uniform(BOX[0], BOX[1], (30, 3))
    views = views_at(calibration, places, rng, np.full(30, 2))
    assert len(views.place) > 30
    seen = calibration.seen_cells
    assert seen is not None
    assert (views.points_in_camera_mm[:, 2] > 200).all()
    raw, short = covariance_of(calibration, views), _without_gauge(calibration, views.jacobian)
    with_gauge, without = (shares_of_views(calibration, used, views) for used in (raw, short))
    np.testing.assert_allclose(without["calibration_mm"], with_gauge["calibration_mm"], rtol=1e-4)
    # how link 6 and hand-eye divide what is one displacement is no uncertainty of anything
    assert without["hand_eye_mm"].mean() < 0.01 * with_gauge["hand_eye_mm"].mean()


@pytest.mark.parametrize("name", NAMES)
def test_a_block_that_is_known_has_no_share_and_leaves_the_others_alone(name: str, calibration: Calibration) -> None:
    views = some_views(calibration)
    covariance = covariance_of(calibration, views)
    part = blocks(calibration)[name]
    known = covariance.copy()
    known[part, :] = known[:, part] = 0.0
    before, after = shares_of_views(calibration, covariance, views), shares_of_views(calibration, known, views)
    np.testing.assert_allclose(after[name], 0.0, atol=1e-15)
    for other in (*NAMES, "pose_noise_mm", "point_noise_mm"):
        if other != name:
            np.testing.assert_allclose(after[other], before[other])
    alone = np.zeros_like(covariance)
    alone[part, part] = covariance[part, part]
    np.testing.assert_allclose(shares_of_views(calibration, alone, views)["calibration_mm"], before[name])


def test_blocks_cover_the_jacobian_once(calibration: Calibration, pose_only_calibration: Calibration) -> None:
    for one in (calibration, pose_only_calibration):
        found = sorted((part.start, part.stop) for part in blocks(one).values())
        assert found[0][0] == 0
        assert all(last == first for (_, last), (first, _) in pairwise(found))
        assert found[-1][1] == some_views(one).jacobian.shape[-1]


def test_a_calibration_tells_its_budget(calibration: Calibration) -> None:
    budget = calibration.error_budget
    assert budget is not None
    for shares in (budget.point, budget.length):
        squares = shares.calibration_mm**2 + shares.pose_noise_mm**2 + shares.point_noise_mm**2
        assert shares.total_mm == pytest.approx(np.sqrt(squares))
        assert shares.artefact_mm is not None
        assert 0 < shares.artefact_mm < shares.calibration_mm
    # the base frame and all that moves every point alike cancels in lengths
    assert budget.length.calibration_mm < budget.point.calibration_mm
    assert np.nanmax(budget.plan_mm) <= budget.largest_point_mm
    assert budget.plan_mm.shape == (len(budget.plan_y_mm), len(budget.plan_x_mm))
    again = ErrorBudget.from_json_dict(budget.to_json_dict())
    assert again.point == budget.point
    assert again.length == budget.length
    np.testing.assert_allclose(again.plan_mm, budget.plan_mm, atol=1e-4)


def test_flange_poses_have_no_share_of_the_robot(pose_only_calibration: Calibration) -> None:
    budget = pose_only_calibration.error_budget
    assert budget is not None
    assert budget.point.robot_geometry_mm == budget.point.arm_physics_mm == 0.0
    assert budget.point.calibration_mm > 0


def test_a_place_out_of_reach_has_no_budget(calibration: Calibration) -> None:
    far = BOX + np.array([5000.0, 0.0, 0.0])
    assert error_budget(calibration, far, "work volume") is None
    half = np.array([[750.0, -100.0, 200.0], [2600.0, 100.0, 300.0]])
    found = error_budget(calibration, half, "work volume")
    assert found is not None
    assert np.isnan(found.plan_mm).any()
    assert found.point.artefact_mm is None


def test_the_artefact_s_part_is_its_term_of_the_covariance() -> None:
    cell = paper_cell()
    shots = {"A": draw_shots(cell, np.random.default_rng(5), 25)}
    other = replace(cell, centre_in_base_mm=np.array([820.0, -250.0, 380.0]))
    shots["B"] = draw_shots(other, np.random.default_rng(6), 25)
    length = float(np.linalg.norm(cell.centre_in_base_mm - other.centre_in_base_mm))
    parts = []
    for sigma_mm in (0.0025, 0.25):
        problem = problem_of(cell, shots, PillowError(), lengths=[LengthConstraint(0, 1, length, sigma_mm)])
        start = replace(start_of(problem, cell), centres_in_base_mm=np.array([cell.centre_in_base_mm, other.centre_in_base_mm]))
        solution = solve_clouds(problem, start, FIRST_NOISE)
        whole, part = symmetric_inverse(solution.reduced.hessian), artefact_covariance(solution)
        # a part and what is left of the whole are both covariances
        for matrix in (part, whole - part):
            scaled = matrix / np.sqrt(np.outer(np.diag(whole), np.diag(whole)))
            assert np.linalg.eigvalsh(scaled).min() > -1e-6
        row = problem.layout.radius_offset.start
        parts.append(part[row, row] / whole[row, row])
    assert 0 < parts[0] < parts[1] < 1
