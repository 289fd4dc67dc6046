"""The MDH chain against Craig's formula written out, its analytic Jacobians against finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.kinematics import mdh, se3
from drivers.kinematics.jacobian import joint_jacobian, link_twist_jacobian
from drivers.kinematics.mdh import LinearLimit, RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model, shipped_models

every_model = pytest.mark.parametrize("name", shipped_models())


def random_model(seed: int, n: int = 6) -> RobotModel:
    rng = np.random.default_rng(seed)
    return RobotModel(
        name="random",
        a_mm=rng.uniform(-500, 500, n),
        alpha_rad=rng.uniform(-3, 3, n),
        d_mm=rng.uniform(-500, 500, n),
        theta_offset_rad=rng.uniform(-3, 3, n),
        coupling=np.eye(n) + np.tril(rng.uniform(-0.5, 0.5, (n, n)), -1),
        joint_limits_rad=np.tile([-np.inf, np.inf], (n, 1)),
    )


def craig(model: RobotModel, q: FloatArray) -> FloatArray:
    """J. J. Craig, Introduction to Robotics, equation 3.6, axis by axis in plain floats."""
    result = np.eye(4)
    for i in range(model.n_joints):
        theta = sum(model.coupling[i, j] * q[j] for j in range(model.n_joints)) + model.theta_offset_rad[i]
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(model.alpha_rad[i]), np.sin(model.alpha_rad[i])
        step = [[c, -s, 0, model.a_mm[i]], [s * ca, c * ca, -sa, -sa * model.d_mm[i]], [s * sa, c * sa, ca, ca * model.d_mm[i]], [0, 0, 0, 1]]
        result = result @ np.array(step)
    return result


def joints(model: RobotModel, *batch: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(-3, 3, (*batch, model.n_joints))


def twists(n: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).normal(size=(n, 6)) * [1, 1, 1, 5e-3, 5e-3, 5e-3]


@pytest.mark.parametrize("n", [1, 2, 6, 7])
def test_forward_kinematics_is_craigs_formula(n: int) -> None:
    model = random_model(n, n)
    q = joints(model, 5, 4)
    expected = [[craig(model, q[i, j]) for j in range(4)] for i in range(5)]
    np.testing.assert_allclose(mdh.base_from_flange(model, q), expected, atol=1e-9)


@every_model
def test_each_step_is_two_screws(name: str) -> None:
    """RotX TransX then RotZ TransZ, from the exponential map instead of the matrix elements."""
    model = load_robot_model(name)
    q = joints(model)
    theta = mdh.link_angles_rad(model, q)
    for i, step in enumerate(mdh.link_transforms(model, q)):
        about_x = se3.exp([model.a_mm[i], 0, 0, model.alpha_rad[i], 0, 0])
        about_z = se3.exp([0, 0, model.d_mm[i], 0, 0, theta[i]])
        np.testing.assert_allclose(step, about_x @ about_z, atol=1e-10)


def test_chain_starts_at_the_base_and_ends_at_the_flange_with_twists_on_the_right() -> None:
    model = random_model(1)
    q, xi = joints(model, 3), twists(6)
    frames = mdh.chain(model, q, xi)
    np.testing.assert_array_equal(frames[:, 0], se3.identity(3))
    expected = np.eye(4)
    for i in range(6):
        expected = expected @ mdh.link_transforms(model, q)[1, i] @ se3.exp(xi[i])
        np.testing.assert_allclose(frames[1, i + 1], expected, atol=1e-9)
    np.testing.assert_allclose(mdh.base_from_flange(model, q, xi), frames[:, -1])
    np.testing.assert_allclose(mdh.base_from_flange(model, q, np.zeros((6, 6))), mdh.base_from_flange(model, q), atol=1e-10)


def test_link_angles_and_axis_angles_are_inverse_maps() -> None:
    model = random_model(2)
    q = joints(model, 10)
    np.testing.assert_allclose(mdh.joints_from_link_angles_rad(model, mdh.link_angles_rad(model, q)), q, atol=1e-12)


@pytest.mark.parametrize("twisted", [False, True])
def test_joint_jacobian_is_the_finite_difference(twisted: bool) -> None:
    model = random_model(3)
    q, xi, step = joints(model, 4), twists(6) if twisted else None, 1e-6
    here = se3.inverse(mdh.base_from_flange(model, q, xi))
    for j, e in enumerate(np.eye(6) * step):
        forward, back = (se3.log(mdh.base_from_flange(model, q + sign * e, xi) @ here) for sign in (1, -1))
        np.testing.assert_allclose(joint_jacobian(model, q, xi)[..., j], (forward - back) / (2 * step), atol=1e-5)


def test_link_twist_jacobian_is_the_finite_difference() -> None:
    model = random_model(4)
    q, xi, step = joints(model, 4), twists(6), 1e-6
    here, columns = se3.inverse(mdh.base_from_flange(model, q, xi)), link_twist_jacobian(model, q, xi)
    for i in range(6):
        for j, e in enumerate(np.eye(6) * step):
            sides = []
            for sign in (1, -1):
                moved = xi.copy()
                moved[i] = se3.log(se3.exp(sign * e) @ se3.exp(xi[i]))
                sides.append(se3.log(mdh.base_from_flange(model, q, moved) @ here))
            np.testing.assert_allclose(columns[:, i, :, j], (sides[0] - sides[1]) / (2 * step), atol=1e-5)


def test_joint_jacobian_without_coupling_is_the_third_rotation_of_the_twist_jacobian() -> None:
    """Turning axis i and twisting link i about its own z are one motion."""
    model = replace(random_model(5), coupling=np.eye(6))
    q = joints(model, 3)
    turning = mdh.chain(model, q)[:, 1:]
    by_z = se3.adjoint(turning)[..., 5]
    np.testing.assert_allclose(joint_jacobian(model, q), np.swapaxes(by_z, -1, -2), atol=1e-9)


def test_limits_hold_axes_linear_rows_and_the_margin() -> None:
    limits = np.array([[-1.0, 1.0], [-2.0, np.inf]])
    row = LinearLimit(np.array([1.0, -1.0]), -0.5, 0.5)
    model = replace(random_model(6, 2), joint_limits_rad=limits, linear_limits=(row,))
    q = np.array([[0.0, 0.0], [0.99, 0.9], [1.01, 1.0], [0.0, 0.6], [-0.9, -1.5], [0.2, -0.25]])
    np.testing.assert_array_equal(mdh.within_limits(model, q), [True, True, False, False, False, True])
    np.testing.assert_array_equal(mdh.within_limits(model, q, 0.1), [True, False, False, False, False, False])
    assert mdh.within_limits(model, q.reshape(2, 3, 2)).shape == (2, 3)
