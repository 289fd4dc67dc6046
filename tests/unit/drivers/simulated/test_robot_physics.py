"""The true robot against the nominal chain, perturbed as set, and against energy for gravity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.errors import SettingsError
from drivers.kinematics import mdh, se3
from drivers.models import load_robot_model
from drivers.simulated.draws import TABLE_1_ERRORS
from drivers.simulated.robot_physics import check_axes, draw_stop_noise, gravity_load, true_base_from_flange
from drivers.simulated.truth import GearHarmonic, RobotTruth
from tests.support.simulated import JOINTS_RAD, paper_model

ANY_JOINTS_RAD = np.random.default_rng(2).uniform(-1.2, 1.2, (40, 6))
every_model = pytest.mark.parametrize("name", ["irb1410_paper", "abb_irb1410", "ur5e"])


@every_model
def test_a_robot_without_errors_is_the_nominal_one(name: str) -> None:
    model = load_robot_model(name)
    true = true_base_from_flange(model, RobotTruth(), ANY_JOINTS_RAD, approach=np.ones(6), hours=5.0)
    np.testing.assert_allclose(true, mdh.base_from_flange(model, ANY_JOINTS_RAD), atol=1e-9)


@every_model
def test_mdh_errors_are_those_of_a_model_with_other_parameters(name: str) -> None:
    model = load_robot_model(name)
    other = replace(
        model,
        a_mm=model.a_mm + TABLE_1_ERRORS.a_error_mm,
        alpha_rad=model.alpha_rad + TABLE_1_ERRORS.alpha_error_rad,
        d_mm=model.d_mm + TABLE_1_ERRORS.d_error_mm,
        theta_offset_rad=model.theta_offset_rad + TABLE_1_ERRORS.theta_error_rad,
    )
    true = true_base_from_flange(model, TABLE_1_ERRORS, ANY_JOINTS_RAD)
    np.testing.assert_allclose(true, mdh.base_from_flange(other, ANY_JOINTS_RAD), atol=1e-9)
    distance = np.linalg.norm((true - mdh.base_from_flange(model, ANY_JOINTS_RAD))[:, :3, 3], axis=1)
    assert 0.2 < distance.mean() < 3.0


def test_link_twists_are_the_calibrators_own() -> None:
    model = paper_model()
    twists = np.random.default_rng(0).normal(0, 1e-3, (6, 6))
    truth = RobotTruth(link_twists=tuple((a, b, c, d, e, f) for a, b, c, d, e, f in twists.tolist()))
    np.testing.assert_allclose(
        true_base_from_flange(model, truth, ANY_JOINTS_RAD), mdh.base_from_flange(model, ANY_JOINTS_RAD, twists), atol=1e-9
    )


def test_a_tilt_turns_the_axis_about_the_common_normal() -> None:
    model, beta = paper_model(), 2e-3
    truth = RobotTruth(tilt_rad=(0.0, 0.0, beta, 0.0, 0.0, 0.0))
    nominal = mdh.chain(model, JOINTS_RAD)
    # the third axis, near-parallel to the second, leans by beta about link 2's y, at the end of its 600 mm: all behind it turns
    link2 = nominal[2] @ se3.from_rotation_translation(np.eye(3), [600.0, 0, 0])
    expected = link2 @ se3.exp([0, 0, 0, 0, beta, 0]) @ se3.inverse(link2) @ nominal[-1]
    np.testing.assert_allclose(true_base_from_flange(model, truth, JOINTS_RAD), expected, atol=1e-9)


@every_model
def test_gravity_load_is_the_slope_of_the_flanges_height(name: str) -> None:
    model = load_robot_model(name)
    theta_model = replace(model, coupling=np.eye(6), theta_offset_rad=np.zeros(6))
    lengths = np.hypot(model.a_mm, model.d_mm)
    reach = np.array([lengths[i + 1 :].sum() for i in range(6)])
    for q in ANY_JOINTS_RAD[:10]:
        theta, load = mdh.link_angles_rad(model, q), gravity_load(model, q)
        for i in range(6):
            step = 1e-5 * np.eye(6)[i]
            rise = np.subtract(*(mdh.base_from_flange(theta_model, theta + s * step)[2, 3] for s in (1, -1))) / 2e-5
            assert load[i] * reach[i] == pytest.approx(-rise, abs=1e-4)
    assert np.abs(gravity_load(model, ANY_JOINTS_RAD)).max() <= 1.0


def test_droop_lowers_the_stretched_arm_and_not_the_upright_one() -> None:
    model, droop = paper_model(), 1.5e-4
    truth = RobotTruth(droop_rad=(0.0, droop, 0.0, 0.0, 0.0, 0.0))
    stretched = np.array([0.0, -np.pi / 2, 0.0, 0.0, 0.0, 0.0])
    upper_arm = mdh.chain(model, stretched)[3, :3, 3] - mdh.chain(model, stretched)[2, :3, 3]
    assert abs(upper_arm[2]) < 1e-6  # horizontal
    sag = true_base_from_flange(model, truth, stretched)[2, 3] - mdh.base_from_flange(model, stretched)[2, 3]
    assert -droop * 1500 < sag < -droop * 300


def test_backlash_depends_on_the_direction_of_approach_alone() -> None:
    model, play = paper_model(), 1e-4
    truth = RobotTruth(backlash_rad=(play,) * 6)
    above = true_base_from_flange(model, truth, JOINTS_RAD, approach=-np.ones(6))
    below = true_base_from_flange(model, truth, JOINTS_RAD, approach=np.ones(6))
    # coming from below, the links lag half the play behind
    np.testing.assert_allclose(below, mdh.base_from_flange(model, JOINTS_RAD - play / 2), atol=1e-9)
    np.testing.assert_allclose(above, mdh.base_from_flange(model, JOINTS_RAD + play / 2), atol=1e-9)


def test_gear_harmonics_repeat_with_their_period() -> None:
    model = paper_model()
    truth = RobotTruth(gear_harmonics=(GearHarmonic(axis=1, amplitude_rad=1e-4, cycles_per_turn=12.0, phase_rad=0.3),))
    turn = np.array([0, 2 * np.pi / 12, 0, 0, 0, 0])
    for q in (JOINTS_RAD, JOINTS_RAD + turn, JOINTS_RAD - 2 * turn):
        shifted = q + np.array([0, 1e-4 * np.sin(12 * JOINTS_RAD[1] + 0.3), 0, 0, 0, 0])
        np.testing.assert_allclose(true_base_from_flange(model, truth, q), mdh.base_from_flange(model, shifted), atol=1e-9)


def test_drift_grows_with_the_hours() -> None:
    model = paper_model()
    truth = RobotTruth(drift_per_hour=(0.02, 0.0, -0.01, 0.0, 0.0, 0.0), axis_drift_rad_per_hour=(1e-5, 0, 0, 0, 0, 0))
    at = [true_base_from_flange(model, truth, JOINTS_RAD, hours=hours)[:3, 3] for hours in (0.0, 1.0, 2.0)]
    np.testing.assert_allclose(at[0], mdh.base_from_flange(model, JOINTS_RAD)[:3, 3], atol=1e-9)
    np.testing.assert_allclose(at[2] - at[0], 2 * (at[1] - at[0]), atol=1e-6)
    assert np.linalg.norm(at[1] - at[0]) > 0.01


def test_pose_noise_has_its_sigma_and_turns_about_the_flange() -> None:
    model, rng = paper_model(), np.random.default_rng(7)
    truth = RobotTruth(pose_noise_mm=0.01, pose_noise_rad=1e-4)
    nominal = mdh.base_from_flange(model, JOINTS_RAD)
    stops = np.array([true_base_from_flange(model, truth, JOINTS_RAD, noise=draw_stop_noise(model, truth, rng)) for _ in range(2000)])
    shifts = stops[:, :3, 3] - nominal[:3, 3]
    turns = se3.log_so3(stops[:, :3, :3] @ nominal[:3, :3].T)
    tolerance = 4 / np.sqrt(2 * shifts.size)
    assert shifts.std() == pytest.approx(0.01, rel=tolerance)
    assert turns.std() == pytest.approx(1e-4, rel=tolerance)


def test_axis_repeatability_moves_the_axes() -> None:
    model = paper_model()
    truth = RobotTruth(axis_repeatability_rad=(1e-4, 0, 0, 0, 0, 0))
    noise = draw_stop_noise(model, truth, np.random.default_rng(1))
    true = true_base_from_flange(model, truth, JOINTS_RAD, noise=noise)
    np.testing.assert_allclose(true, mdh.base_from_flange(model, JOINTS_RAD + noise.axis_rad), atol=1e-9)
    assert noise.axis_rad[0] != 0.0


@pytest.mark.parametrize("truth", [RobotTruth(a_error_mm=(0.1,) * 5), RobotTruth(gear_harmonics=(GearHarmonic(6, 1e-5, 1.0),))])
def test_a_truth_for_another_robot_is_refused(truth: RobotTruth) -> None:
    with pytest.raises(SettingsError, match="6 axes"):
        check_axes(paper_model(), truth)
