"""Line profiles: mistakes in the poses are named from arcs alone, and right arcs raise no alarm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibrate.observations import SphereShot
from calibrate.plausibility_arcs import check_arcs
from calibrate.problem import Problem
from calibrate.start_arcs import start_from_arcs
from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from tests.unit.calibrate.test_start import arcs

N_ARCS = 10


def shots_of(problem: Problem) -> list[SphereShot]:
    return [SphereShot("s", i, "S0", str(i), None, problem.base_from_flange[i], np.zeros((0, 3)), 40.0, None) for i in range(problem.n_shots)]


def fixed_for_moving(pose: FloatArray) -> FloatArray:
    angles = Rotation.from_matrix(pose[:, :3, :3]).as_euler("XYZ")
    return se3.from_rotation_translation(Rotation.from_euler("xyz", angles).as_matrix(), pose[:, :3, 3])


MISTAKES: dict[str, tuple[Callable[[FloatArray], FloatArray], str]] = {
    "metres": (lambda t: se3.from_rotation_translation(t[:, :3, :3], t[:, :3, 3] / 1000), "the poses are in metres"),
    "inverse": (se3.inverse, "flange_from_base, the inverse"),
    "angles": (fixed_for_moving, "but they are about x, y, z of the moving body"),
    "shift": (lambda t: np.roll(t, 1, axis=0), "shifted by one shot (scan i belongs to the pose of shot i+1)"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_the_poses_of_profiles_is_named(mistake: str) -> None:
    spoil, words = MISTAKES[mistake]
    problem, _ = arcs(N_ARCS, noise_mm=0.02, seed=21)
    wrong = replace(problem, base_from_flange=spoil(problem.base_from_flange))
    with pytest.raises(DataError) as error:
        check_arcs(wrong, shots_of(wrong), start_from_arcs(wrong, None).scale_mm)
    assert words in error.value.message
    assert "mm (rms)" in error.value.message
    assert error.value.remedy


def test_right_profiles_raise_no_alarm_even_when_tried() -> None:
    """Poses several mm off, as of a bad robot: nothing explains them five times better."""
    problem, _ = arcs(N_ARCS, noise_mm=0.02, seed=22)
    rng = np.random.default_rng(1)
    noise = se3.exp(rng.normal(size=(N_ARCS, 6)) * [4, 4, 4, 5e-3, 5e-3, 5e-3])
    bad = replace(problem, base_from_flange=problem.base_from_flange @ noise)
    rms_mm = start_from_arcs(bad, None).scale_mm
    assert rms_mm > 1.0
    check_arcs(bad, shots_of(bad), max(rms_mm, 3.1))


@pytest.mark.parametrize("seed", [23, 24])
def test_a_good_guess_gives_what_all_starts_give(seed: int) -> None:
    problem, cell = arcs(15, noise_mm=0.02, seed=seed)
    alone, guessed = (
        start_from_arcs(problem, None),
        start_from_arcs(problem, cell.flange_from_camera @ se3.exp(np.array([8, -5, 6, 0.04, 0.03, -0.05]))),
    )
    np.testing.assert_allclose(guessed.state.flange_from_camera, alone.state.flange_from_camera, atol=1e-5)
    np.testing.assert_allclose(guessed.state.centres_in_base_mm, alone.state.centres_in_base_mm, atol=1e-5)
