"""Method 4: its columns against finite differences, and recovery of a robot whose errors are its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibrate.stepwise_dh import dh_columns, moved, solve_linearised_dh
from calibrate.study_cell import StudyNoise, draw_shots, paper_cell
from drivers.kinematics import mdh, se3

CELL = paper_cell()


def test_columns_are_derivatives() -> None:
    shots = draw_shots(CELL, np.random.default_rng(0), 8)
    model, hand_eye = CELL.true, CELL.flange_from_camera_guess
    _, columns = dh_columns(model, shots.joints_rad, hand_eye, shots.centre_in_camera_mm)
    step = 1e-5
    for k in range(30):
        ends = []
        for sign in (1, -1):
            other, turned = moved(model, hand_eye, sign * step * np.eye(30)[k])
            ends.append(se3.apply(mdh.base_from_flange(other, shots.joints_rad) @ turned, shots.centre_in_camera_mm))
        np.testing.assert_allclose(columns[:, :, k], (ends[0] - ends[1]) / (2 * step), rtol=1e-6, atol=2e-4)


def test_d_h_errors_are_explained_away_in_a_few_iterations() -> None:
    """Table 1's errors are D-H errors: without noise and camera error nothing is left, on other shots too."""
    cell, rng = CELL.with_camera_error(0.0), np.random.default_rng(1)
    training, tests = draw_shots(cell, rng, 60), draw_shots(cell, rng, 30)
    found = solve_linearised_dh(cell.nominal, training.joints_rad, training.centre_in_camera_mm, cell.flange_from_camera_guess)
    assert found.objective_mm2 < 1e-10
    assert found.iterations < 12
    in_base = se3.apply(mdh.base_from_flange(found.model, tests.joints_rad) @ found.flange_from_camera, tests.centre_in_camera_mm)
    assert np.ptp(in_base, axis=0).max() < 1e-4


def test_noise_alone_is_not_amplified() -> None:
    cell, rng = replace(CELL, true=CELL.nominal).with_camera_error(0.0), np.random.default_rng(2)
    training, tests = draw_shots(cell, rng, 100, noise=StudyNoise()), draw_shots(cell, rng, 50)
    found = solve_linearised_dh(cell.nominal, training.joints_rad, training.centre_in_camera_mm, cell.flange_from_camera_guess)
    in_base = se3.apply(mdh.base_from_flange(found.model, tests.joints_rad) @ found.flange_from_camera, tests.centre_in_camera_mm)
    assert np.sqrt(((in_base - in_base.mean(axis=0)) ** 2).sum(axis=1).mean()) < 0.06
