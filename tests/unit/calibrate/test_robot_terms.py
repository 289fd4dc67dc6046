"""Deflection terms: gravity's torque is the slope of a height, and a coefficient is an angle of one axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate.robot_terms import arm_terms, deflection_rad, load_basis
from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from tests.support.synthetic import abb_robot, paper_robot

robots = pytest.mark.parametrize("model", [paper_robot(), abb_robot()], ids=lambda m: m.name)


def joints(n: int = 7) -> FloatArray:
    return np.asarray(np.random.default_rng(1).uniform(-1.5, 1.5, (n, 6)))


@robots
def test_compliance_goes_with_the_slope_of_the_masss_height(model: RobotModel) -> None:
    """The torque of a weight about an axis is how fast the axis lifts it."""
    q, terms = joints(), arm_terms(model)
    load = load_basis(terms, model, q)
    compliant = [(k, term) for k, term in enumerate(terms) if term.kind == "compliance"]
    assert len(compliant) >= 5
    for k, term in compliant:
        slope = np.zeros(len(q))
        for sign in (1.0, -1.0):
            turned = replace(model, theta_offset_rad=model.theta_offset_rad + sign * 1e-5 * np.eye(6)[term.axis])
            slope += sign * mdh.chain(turned, q)[:, term.order, 2, 3] / 2e-5
        reach = np.hypot(model.a_mm, model.d_mm)[term.axis + 1 : term.order].sum()
        expected = -slope / reach if reach > 0 else 0 * slope
        np.testing.assert_allclose(load[:, term.axis, k], expected, atol=1e-6, err_msg=term.name)
        assert np.abs(load[:, term.axis, k]).max() <= 1 + 1e-9
        assert not np.delete(load[:, :, k], term.axis, axis=1).any()


@robots
def test_transmission_errors_are_harmonics_of_the_axis_angle(model: RobotModel) -> None:
    q, terms = joints(), arm_terms(model)
    load = load_basis(terms, model, q)
    again = load_basis(terms, model, q + 2 * np.pi)
    for k, term in enumerate(terms):
        if term.kind != "compliance":
            np.testing.assert_allclose(again[:, :, k], load[:, :, k], atol=1e-9)
            pair = next(j for j, other in enumerate(terms) if other.axis == term.axis and other.kind not in {"compliance", term.kind})
            np.testing.assert_allclose(load[:, term.axis, k] ** 2 + load[:, term.axis, pair] ** 2, 1.0)


@robots
def test_the_deflection_is_linear_and_none_where_nothing_yields(model: RobotModel) -> None:
    q, terms = joints(), arm_terms(model)
    rng = np.random.default_rng(2)
    a, b = rng.normal(0, 1e-4, len(terms)), rng.normal(0, 1e-4, len(terms))
    parts = [deflection_rad(terms, x, model, q) for x in (a, b, 2 * a - b)]
    assert all(part is not None and part.shape == q.shape for part in parts)
    first, second, both = (np.asarray(part) for part in parts)
    np.testing.assert_allclose(both, 2 * first - second, atol=1e-15)
    assert deflection_rad(terms, np.zeros(len(terms)), model, q) is None
    assert deflection_rad((), np.zeros(0), model, q) is None
    assert len({term.name for term in terms}) == len(terms)
