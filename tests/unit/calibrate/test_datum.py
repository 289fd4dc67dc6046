"""The stated base: the best fit of the calibrated to the nominal robot, whatever base the solver ended in."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from calibrate.datum import ARM_MM, CORNERS_MM, MAX_REFERENCES, References, controller_datum, datum_jacobian, nominal_robot_datum
from calibrate.datum_poses import datum_joints, datum_references, work_volume_joints
from calibrate.robot_terms import arm_terms
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from tests.support.synthetic import abb_robot, paper_robot
from tests.support.volume import volume_cell

robots = pytest.mark.parametrize("model", [paper_robot(), abb_robot()], ids=lambda m: m.name)


def twists(seed: int, size: float = 1.0) -> FloatArray:
    return np.asarray(size * np.random.default_rng(seed).normal(size=(6, 6)) * [1, 1, 1, 2e-3, 2e-3, 2e-3])


def joints(seed: int, n: int = 25) -> FloatArray:
    return np.asarray(np.random.default_rng(seed).uniform(-1.2, 1.2, (n, 6)))


def carried(model: RobotModel, q: FloatArray, link_twists: FloatArray | None = None) -> FloatArray:
    """(4 k, 3) flange origin and points at arm's length along its axes, at every pose."""
    return se3.apply(mdh.base_from_flange(model, q, link_twists)[:, None], CORNERS_MM).reshape(-1, 3)


@robots
def test_a_perfect_robot_is_its_own_datum(model: RobotModel) -> None:
    np.testing.assert_allclose(nominal_robot_datum(model, np.zeros((6, 6)), References(joints(0))).base_from_solver, np.eye(4), atol=1e-9)


@robots
@pytest.mark.parametrize("seed", range(3))
def test_the_datum_is_a_minimum(model: RobotModel, seed: int) -> None:
    datum = nominal_robot_datum(model, twists(seed), References(joints(seed)))
    q = datum.references.joints_rad
    solved, nominal = mdh.base_from_flange(model, q, twists(seed)), carried(model, q)

    def misfit(x: FloatArray) -> FloatArray:
        moved = se3.exp(x[:6]) @ solved @ se3.exp(x[6:])
        return np.asarray((se3.apply(moved[:, None], CORNERS_MM).reshape(-1, 3) - nominal).ravel())

    oracle = least_squares(misfit, np.zeros(12), x_scale=[1, 1, 1, 1e-3, 1e-3, 1e-3] * 2, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert se3.is_rigid(datum.base_from_solver)
    np.testing.assert_allclose(datum.base_from_solver, se3.exp(oracle.x[:6]), atol=1e-4)


@robots
def test_what_link_n_and_the_hand_eye_share_moves_no_base(model: RobotModel) -> None:
    """The last link and the hand-eye transform are one displacement; however it is divided, the base stays."""
    xi, q = twists(11), joints(11)
    shifted = xi.copy()
    shifted[5] = se3.log(se3.exp(xi[5]) @ se3.exp([3.0, -2.0, 1.0, 4e-3, 1e-3, -2e-3]))
    first, second = nominal_robot_datum(model, xi, References(q)), nominal_robot_datum(model, shifted, References(q))
    np.testing.assert_allclose(second.base_from_solver, first.base_from_solver, atol=5e-3)


@robots
@given(st.floats(-50, 50), st.floats(-0.5, 0.5))
def test_a_shift_of_the_solvers_base_changes_no_stated_pose(model: RobotModel, slide_mm: float, turn_rad: float) -> None:
    """A slide along and a turn about axis 1 is what link 1 can do to the whole base without any shot noticing."""
    xi, q = twists(4), joints(4)
    shifted = xi.copy()
    shifted[0] = se3.log(se3.exp([0, 0, slide_mm, 0, 0, turn_rad]) @ se3.exp(xi[0]))
    first, second = nominal_robot_datum(model, xi, References(q)), nominal_robot_datum(model, shifted, References(q))
    elsewhere = joints(5)
    stated = first.base_from_solver @ mdh.base_from_flange(model, elsewhere, xi)
    np.testing.assert_allclose(second.base_from_solver @ mdh.base_from_flange(model, elsewhere, shifted), stated, atol=1e-8)


@robots
@pytest.mark.parametrize("n", [5, 60, 171])
def test_the_order_of_the_poses_changes_nothing(model: RobotModel, n: int) -> None:
    q = joints(6, n)
    first = nominal_robot_datum(model, twists(6), References(q))
    second = nominal_robot_datum(model, twists(6), References(np.random.default_rng(7).permutation(q)))
    np.testing.assert_array_equal(first.base_from_solver, second.base_from_solver)
    np.testing.assert_array_equal(first.references.joints_rad, second.references.joints_rad)
    assert len(first.references.joints_rad) <= n


@robots
def test_the_references_of_a_datum_give_it_again(model: RobotModel) -> None:
    datum = nominal_robot_datum(model, twists(8), References(joints(8, 150)))
    again = nominal_robot_datum(model, twists(8), References(datum.references.joints_rad))
    np.testing.assert_array_equal(again.base_from_solver, datum.base_from_solver)


@robots
@pytest.mark.parametrize("size", [0.0, 1.0])
def test_datum_jacobian_is_the_derivative(model: RobotModel, size: float) -> None:
    xi, q = twists(9, size), joints(9)
    datum = nominal_robot_datum(model, xi, References(q))
    jacobian = datum_jacobian(datum, model, xi)
    for p in range(36):
        h = 1e-2 if p % 6 < 3 else 1e-5
        step = h * np.eye(36)[p].reshape(6, 6)
        forward, back = (nominal_robot_datum(model, xi + s * step, References(q)).base_from_solver for s in (1, -1))
        # the stated base moves by the left twist of the solver's base that comes before it
        moved = se3.log(se3.inverse(datum.base_from_solver) @ forward) - se3.log(se3.inverse(datum.base_from_solver) @ back)
        # first order in the misfit of the fit itself: some tenths of a mm on a metre
        np.testing.assert_allclose(moved[:3] / (2 * h), jacobian[:3, p], atol=(1e-5 if size == 0 else 5e-3) * (1 if p % 6 < 3 else 1000))
        np.testing.assert_allclose(moved[3:] / (2 * h), jacobian[3:, p], atol=(1e-8 if size == 0 else 5e-6) * (1 if p % 6 < 3 else 1000))
    assert np.abs(jacobian).max() > 0.1


def test_a_controllers_base_is_taken_as_it_is() -> None:
    datum = controller_datum()
    np.testing.assert_array_equal(datum.base_from_solver, np.eye(4))
    np.testing.assert_array_equal(datum_jacobian(datum, None, np.zeros((0, 6))), np.zeros((6, 0)))


@robots
def test_the_datum_follows_what_the_arm_yields_by(model: RobotModel) -> None:
    xi, q, terms = twists(12, 0.0), joints(12), arm_terms(model)
    still = np.zeros(len(terms))
    jacobian = datum_jacobian(nominal_robot_datum(model, xi, References(q), terms, still), model, xi, terms, still)
    assert jacobian.shape == (6, 36 + len(terms))
    for k in range(len(terms)):
        step = 1e-5 * np.eye(len(terms))[k]
        forward, back = (nominal_robot_datum(model, xi, References(q), terms, sign * step).base_from_solver for sign in (1, -1))
        moved = (se3.log(forward) - se3.log(back)) / 2e-5
        np.testing.assert_allclose(jacobian[:3, 36 + k], moved[:3], atol=0.05)
        np.testing.assert_allclose(jacobian[3:, 36 + k], moved[3:], atol=5e-5)


@robots
def test_the_work_volume_decides_the_reference_poses_and_nothing_else(model: RobotModel) -> None:
    box = np.array([[640.0, -330.0, 130.0], [1120.0, 330.0, 560.0]])
    found = work_volume_joints(model, box)
    assert found.shape == (MAX_REFERENCES, 6)
    assert mdh.within_limits(model, found).all()
    flange = mdh.base_from_flange(model, found)
    ahead = flange[:, :3, 3] + ARM_MM * flange[:, :3, 2]
    assert (np.linalg.norm(ahead - np.clip(ahead, box[0], box[1]), axis=1) < 30.0).all()
    # spread through the box, not along one edge of it
    assert (np.ptp(ahead, axis=0) > 0.8 * np.ptp(box, axis=0)).all()
    np.testing.assert_array_equal(datum_joints(model, box, joints(1)), datum_joints(model, box, joints(2)))
    np.testing.assert_array_equal(datum_joints(model, None, joints(1)), joints(1))


def test_the_cell_decides_where_robots_are_compared_and_no_solve() -> None:
    volume = volume_cell(5)
    guess = np.array(volume.cell.flange_from_camera)
    first, second = (
        datum_references(volume.cell, volume.model, se3.exp(np.full(6, 1e-3 * k)) @ guess, np.full((6, 3), float(k)), joints(k)) for k in (1, 2)
    )
    np.testing.assert_array_equal(first.joints_rad, second.joints_rad)
    np.testing.assert_array_equal(first.points_in_flange_mm, second.points_in_flange_mm)
    assert mdh.within_limits(volume.model, first.joints_rad).all()
    assert len(first.joints_rad) == MAX_REFERENCES
    # every view has some of the work volume before it
    seen = se3.apply(mdh.base_from_flange(volume.model, first.joints_rad)[:, None], first.points_in_flange_mm)
    box = volume.cell.work_volume_box_mm
    assert box is not None
    assert ((seen.min(axis=1) < box[1] + 100) & (seen.max(axis=1) > box[0] - 100)).all()
    assert (np.ptp(seen.mean(axis=1), axis=0) > 0.7 * np.ptp(box, axis=0)).all()


def test_without_a_camera_to_look_through_the_robot_alone_decides() -> None:
    cell = volume_cell(5).cell
    blind = cell.model_copy(update={"camera": cell.camera.model_copy(update={"working_range_mm": None})})
    used, model = joints(3), abb_robot()
    assert cell.work_volume_box_mm is not None
    found = datum_references(blind, model, np.eye(4), np.zeros((1, 3)), used)
    np.testing.assert_array_equal(found.joints_rad, work_volume_joints(model, cell.work_volume_box_mm))
    np.testing.assert_array_equal(found.points_in_flange_mm, CORNERS_MM)
    nowhere = blind.model_copy(update={"work_volume_mm": None})
    np.testing.assert_array_equal(datum_references(nowhere, model, np.eye(4), np.zeros((1, 3)), used).joints_rad, used)
