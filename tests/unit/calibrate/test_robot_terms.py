"""Deflection terms: gravity's torque is the slope of a height, and a coefficient is an angle of one axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate.robot_terms import RobotTerm, arm_terms, candidate_groups, deflection_rad, load_basis
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


def test_linkage_terms_close_the_four_bars() -> None:
    """Cranks and rods that differ: what the driven axis turns by, against the closed four-bar linkage to first order."""
    model = abb_robot()
    tangent, secant = RobotTerm("tangent", 2, 1), RobotTerm("secant", 2, 1)
    q = np.zeros((9, 6))
    q[:, 1], q[:, 2] = 0.2, 0.2 + np.linspace(-1.0, 1.0, 9)
    load = load_basis((tangent, secant), model, q)[:, 2]
    crank, rod = 200.0, 600.0
    for longer_crank, longer_rod in ((0.01, 0.0), (0.0, 0.01), (0.02, -0.01)):
        turned = [driven_angle(crank + longer_crank, rod + longer_rod, rod, crank, angle) - angle for angle in np.pi / 2 + q[:, 2] - q[:, 1]]
        expected = load @ [longer_crank, -longer_rod] / crank
        np.testing.assert_allclose(turned, expected, rtol=5e-4, atol=2e-9)


def driven_angle(crank: float, rod: float, base: float, other_crank: float, angle: float) -> float:
    """Angle of the driven crank of a four-bar linkage, near that of the driving one."""
    tip = crank * np.exp(1j * angle) - base
    distance, direction = abs(tip), np.angle(tip)
    inner = np.arccos((distance**2 + other_crank**2 - rod**2) / (2 * distance * other_crank))
    found = np.array([direction + inner, direction - inner])
    away = np.angle(np.exp(1j * (found - angle)))
    return float(angle + away[np.abs(away).argmin()])


@robots
def test_linkages_are_looked_for_on_coupled_axes_only(model: RobotModel) -> None:
    named = [name for name in candidate_groups(model) if name.startswith("linkage")]
    assert named == (["linkage of axis 3"] if model.name == "abb_irb1410" else [])
    assert all(term.estimated for terms in candidate_groups(model).values() for term in terms)


def test_a_gear_turns_what_its_motor_drives() -> None:
    """On the parallelogram the second motor moves two link angles."""
    model, q = abb_robot(), joints()
    load = load_basis((RobotTerm("sine", 1, 3),), model, q)[:, :, 0]
    np.testing.assert_allclose(load, np.sin(3 * q[:, 1:2]) * model.coupling[:, 1])
    assert (np.abs(load).max(axis=0) > 0).sum() == 2
