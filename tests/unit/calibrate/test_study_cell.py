"""The paper's simulation: poses by the law that is stated, noise and camera error of the stated size."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.study_cell import NO_NOISE, PAPER_K, StudyNoise, caps, draw_shots, fitted_centres, paper_cell, shots_at, with_guess_signs
from drivers.kinematics import mdh, se3

CELL = paper_cell()


def test_noise_free_shots_see_the_sphere_where_it_is() -> None:
    shots = draw_shots(CELL.with_camera_error(0.0), np.random.default_rng(0), 40)
    in_base = se3.apply(mdh.base_from_flange(CELL.true, shots.joints_rad) @ CELL.flange_from_camera, shots.centre_in_camera_mm)
    np.testing.assert_allclose(in_base, np.broadcast_to(CELL.centre_in_base_mm, (40, 3)), atol=1e-9)


def test_poses_keep_the_stated_law_and_the_robots_limits() -> None:
    shots = draw_shots(CELL, np.random.default_rng(1), 300)
    assert mdh.within_limits(CELL.nominal, shots.joints_rad).all()
    base_from_camera = mdh.base_from_flange(CELL.nominal, shots.joints_rad) @ CELL.flange_from_camera
    in_camera = se3.apply(se3.inverse(base_from_camera), CELL.centre_in_base_mm)
    z = in_camera[:, 2]
    assert 249.999 < z.min() < 260
    assert 390 < z.max() < 400.001
    for axis, most in ((0, 22.0), (1, 13.0)):
        angle = np.degrees(np.arctan2(in_camera[:, axis], z))
        assert 0.9 * most < np.abs(angle).max() < most + 1e-6
    tilt = np.degrees(np.arccos(-base_from_camera[:, 2, 2]))
    assert 36 < tilt.max() < 40.001
    assert np.median(tilt) == pytest.approx(20, abs=4)


def test_camera_error_is_eq_5_as_an_error_on_z() -> None:
    point = np.array([[10.0, 20.0, 300.0]])
    r2 = 50.0**2 + 200.0**2
    expected = -200.0 * (PAPER_K[0] * r2 + PAPER_K[1] * r2**2 + PAPER_K[2] * r2**3)
    np.testing.assert_allclose(CELL.measured(point) - point, [[0, 0, expected]], rtol=1e-12, atol=1e-12)
    shots = draw_shots(CELL, np.random.default_rng(2), 200)
    assert 0.4 < np.abs(CELL.camera_error_mm(shots.true_centre_in_camera_mm)).max() < 1.6


def test_noise_moves_the_centre_by_what_its_elements_say() -> None:
    """1e-4 on every element of the rotation is 1e-4 times the distance from the flange, in each axis."""
    joints = np.tile(draw_shots(CELL, np.random.default_rng(3), 1).joints_rad, (4000, 1))
    rng = np.random.default_rng(4)
    noisy = shots_at(CELL, rng, joints, noise=StudyNoise())
    exact = shots_at(CELL, rng, joints[:1], noise=NO_NOISE)
    lever = float(np.linalg.norm(se3.apply(CELL.flange_from_camera, exact.true_centre_in_camera_mm)))
    deviation = noisy.centre_in_camera_mm - exact.centre_in_camera_mm
    # the camera's error bends depth noise by up to a tenth
    assert deviation.std(axis=0) == pytest.approx(np.full(3, np.sqrt((1e-4 * lever) ** 2 + 2 * 0.01**2)), rel=0.12)
    assert StudyNoise().times(2.0) == StudyNoise(2e-4, 0.02, 0.16)


def test_caps_lie_on_their_sphere_and_face_the_camera() -> None:
    centres = np.array([[30.0, -20.0, 300.0], [-80.0, 10.0, 380.0]])
    points = caps(centres, 19.05, 500, np.random.default_rng(5))
    away = points - centres[:, None]
    np.testing.assert_allclose(np.linalg.norm(away, axis=-1), 19.05, atol=1e-12)
    towards = -centres / np.linalg.norm(centres, axis=1, keepdims=True)
    cosine = np.einsum("mni,mi->mn", away / 19.05, towards)
    assert cosine.min() > 0.5 - 1e-9
    assert cosine.mean() == pytest.approx(0.75, abs=0.02)


def test_fits_of_clouds_find_the_centre_and_a_depth_error_bends_the_free_ones() -> None:
    exact = draw_shots(CELL.with_camera_error(0.0), np.random.default_rng(6), 5, n_points=200)
    for free in (True, False):
        centres, radii = fitted_centres(exact, CELL.radius_mm, free_radius=free)
        np.testing.assert_allclose(centres, exact.true_centre_in_camera_mm, atol=1e-6)
        np.testing.assert_allclose(radii, CELL.radius_mm, atol=1e-6)
    bent = draw_shots(CELL, np.random.default_rng(6), 5, n_points=200)
    _, radii = fitted_centres(bent, CELL.radius_mm, free_radius=True)
    assert np.abs(radii - CELL.radius_mm).max() > 0.002


def test_every_sign_of_the_first_guess_is_the_printed_matrix() -> None:
    for signs in ((1, 1, 1), (-1, 1, -1)):
        guess = with_guess_signs(CELL, signs).flange_from_camera_guess
        assert se3.is_rigid(guess)
        printed = [[0.0051, 1.0, 0.0035], [1.0, 0.0051, 0.0034], [0.0034, 0.0035, 1.0]]
        np.testing.assert_allclose(np.abs(guess[:3, :3]), printed, atol=7e-5)
        np.testing.assert_allclose(guess[:3, 3], [59.5445, 61.3253, 86.2298])
