"""External points in the normal equations: derivatives, sums against dense algebra, and what must not matter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibrate.external import ExternalRows, external_rows, joined
from calibrate.external_points import ExternalPoints, ExternalShot, external_points
from calibrate.external_solve import folds_of, robot_problem
from calibrate.normal import Linearised, NoiseModel, linearise, reduce
from calibrate.problem import Priors, Problem, State, linearise_geometry
from calibrate.robot_terms import arm_terms
from calibrate.start import initial_state
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from tests.support.tracker import tracked_robot

NOISE = NoiseModel(point_mm=0.05, pose_mm=0.02, pose_rad=1e-4, external_mm=0.015)
TARGETS = {"high": (45.0, -30.0, 120.0), "low": (-20.0, 60.0, 80.0)}


def made(n_stops: int = 6) -> tuple[Problem, State]:
    """Two frames, two targets seen at every stop, and a state in which nothing is zero."""
    robot, rng = tracked_robot(1, targets=TARGETS), np.random.default_rng(2)
    shots = [
        ExternalShot("s", 2 * i + k, f"tracker {i % 2}", target, q, robot.see(rng, q, target))
        for i, q in enumerate(robot.poses(rng, n_stops))
        for k, target in enumerate(TARGETS)
    ]
    problem = robot_problem(external_points(shots, robot.model, arm_terms(robot.model)), robot.model, Priors(), np.eye(4))
    state = replace(
        initial_state(problem, np.eye(4), np.zeros((0, 3))),
        link_twists=rng.normal(size=(6, 6)) * [0.5, 0.5, 0.5, 2e-3, 2e-3, 2e-3],
        terms_rad=rng.normal(0, 1e-4, len(problem.terms)),
        base_from_reference=se3.exp(rng.normal(size=(2, 6)) * [900, 900, 900, 1, 1, 1]),
        target_in_flange_mm=rng.normal(0, 80, (2, 3)),
        pose_noise=rng.normal(size=(problem.n_scans, 6)) * [0.02, 0.02, 0.02, 1e-4, 1e-4, 1e-4],
    )
    return problem, state


def rows_of(problem: Problem, state: State) -> ExternalRows:
    rows = external_rows(problem, state)
    assert rows is not None
    return rows


def points_of(problem: Problem) -> ExternalPoints:
    assert problem.external is not None
    return problem.external


def sums_of(problem: Problem, state: State) -> Linearised:
    nothing = np.zeros((0, 5, 5))
    return joined(linearise(problem, state, linearise_geometry(problem, state), nothing, np.zeros(0)), rows_of(problem, state), NOISE)


def test_columns_are_the_derivatives() -> None:
    problem, state = made()
    layout, columns = problem.layout, rows_of(problem, state).columns
    no_noise = np.zeros_like(state.pose_noise)
    h_mm, h_rad = 1e-2, 1e-5
    steps = np.full(layout.size, h_mm)
    for block in (layout.links, layout.hand_eye, layout.references):
        for start in range(block.start, block.stop, 6):
            steps[start + 3 : start + 6] = h_rad
    steps[layout.terms] = h_rad
    for p, h in enumerate(steps):
        step = h * np.eye(layout.size)[p]
        ends = [rows_of(problem, state.moved(layout, sign * step, no_noise)).residual_mm for sign in (1.0, -1.0)]
        # the pose noise turns with the lever, which the columns leave out: 0.1 mrad of it
        np.testing.assert_allclose(columns[..., p], (ends[0] - ends[1]) / (2 * h), atol=0.2 if h == h_rad else 1e-3, err_msg=str(p))
    felt = np.abs(columns).max(axis=(0, 1)) > 0.1
    assert felt[layout.references].all()
    assert felt[layout.targets].all()
    assert not felt[layout.hand_eye].any()


def test_noise_columns_are_the_derivatives() -> None:
    problem, state = made()
    rows = rows_of(problem, state)
    for axis in range(6):
        twist = np.eye(6)[axis] * (1e-2 if axis < 3 else 1e-5)
        moved = replace(state, pose_noise=state.pose_noise + twist)
        difference = (rows_of(problem, moved).residual_mm - rows.residual_mm) / twist[axis]
        np.testing.assert_allclose(rows.noise_columns[..., axis], difference, atol=1e-6)


def test_elimination_weighs_as_the_full_covariance_does() -> None:
    problem, state = made()
    state = replace(state, pose_noise=np.zeros_like(state.pose_noise))
    rows, points = rows_of(problem, state), points_of(problem)
    reduced = reduce(sums_of(problem, state), NOISE.pose_precision)
    e = points.n_shots
    covariance = np.zeros((e, 3, e, 3))
    for i in range(e):
        for j in range(e):
            if points.stop[i] == points.stop[j]:
                covariance[i, :, j] = rows.noise_columns[i] / NOISE.pose_precision @ rows.noise_columns[j].T
        covariance[i, :, i] += NOISE.external_mm**2 * np.eye(3)
    weight = np.linalg.inv(covariance.reshape(3 * e, 3 * e))
    flat, residual = rows.columns.reshape(3 * e, -1), rows.residual_mm.ravel()
    spheres = linearise(problem, state, linearise_geometry(problem, state), np.zeros((0, 5, 5)), np.zeros(0))
    hessian, gradient = spheres.hessian + flat.T @ weight @ flat, spheres.gradient + flat.T @ weight @ residual
    scale = np.sqrt(np.diagonal(hessian))
    np.testing.assert_allclose(reduced.hessian / np.outer(scale, scale), hessian / np.outer(scale, scale), atol=1e-7)
    np.testing.assert_allclose(reduced.gradient / scale, gradient / scale, rtol=1e-6, atol=1e-6)


def test_a_point_that_is_not_believed_adds_nothing() -> None:
    problem, state = made()
    points = points_of(problem)
    doubted = replace(points, weight=np.where(np.arange(points.n_shots) < 2, 0.0, 1.0))
    less = points.subset(np.arange(2, points.n_shots))
    found = []
    for some in (doubted, less):
        part = replace(problem, external=some)
        at = replace(state, pose_noise=np.zeros((part.n_scans, 6)))
        found.append(reduce(sums_of(part, at), NOISE.pose_precision))
    np.testing.assert_allclose(found[0].hessian, found[1].hessian, rtol=1e-7, atol=1e-3)
    np.testing.assert_allclose(found[0].gradient, found[1].gradient, rtol=1e-7, atol=1e-6)


def test_a_moved_base_changes_no_residual() -> None:
    """Gauge: frames and base go together, so a rigid motion of both is felt by no point."""
    problem, state = made()
    points, rng = points_of(problem), np.random.default_rng(7)
    shift = se3.exp(rng.normal(size=6) * [200, 200, 200, 1, 1, 1])
    rows = rows_of(problem, state)
    told = replace(points, points_in_reference_mm=se3.apply(shift, points.points_in_reference_mm))
    elsewhere = replace(state, base_from_reference=state.base_from_reference @ se3.inverse(shift))
    np.testing.assert_allclose(rows_of(replace(problem, external=told), elsewhere).residual_mm, rows.residual_mm, atol=1e-9)


def test_targets_of_one_stop_share_its_noise() -> None:
    points = points_of(made()[0])
    assert points.stop.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    part = points.subset(np.array([0, 5, 4, 11]))
    assert part.stop.tolist() == [0, 1, 1, 2]
    assert part.references == points.references
    assert [shot.index for shot in part.shots] == [0, 5, 4, 11]


def test_folds_keep_a_stop_together_and_forget_the_order() -> None:
    points = points_of(made(40)[0])
    fold = folds_of(points, 10)
    assert np.bincount(fold).tolist() == [8] * 10
    assert (fold[::2] == fold[1::2]).all()
    order = np.random.default_rng(3).permutation(points.n_shots)
    np.testing.assert_array_equal(folds_of(points.subset(order), 10), fold[order])


def test_a_step_in_frames_and_targets_is_taken_back() -> None:
    problem, state = made()
    step: FloatArray = 1e-3 * np.random.default_rng(6).normal(size=problem.layout.size)
    there = state.moved(problem.layout, step, np.zeros_like(state.pose_noise))
    again = there.moved(problem.layout, -step, np.zeros_like(state.pose_noise))
    for name in ("base_from_reference", "target_in_flange_mm"):
        assert np.abs(getattr(there, name) - getattr(state, name)).max() > 1e-4
        np.testing.assert_allclose(getattr(again, name), getattr(state, name), atol=1e-9)
