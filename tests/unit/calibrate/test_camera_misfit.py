"""A camera error model that is asked for against the data: told, and its uncertainty wide enough; one that fits is left alone."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.camera_error import NoCameraError
from calibrate.camera_misfit import misfit_of
from calibrate.solve import CalibrationSettings, solve_observations
from drivers.simulated.draws import Sizes
from tests.support.honesty import honest_cell
from tests.support.solving import one_thread
from tests.support.volume import random_shots, volume_cell

SEED, N_SHOTS, BENT = 52011, 60, Sizes(stereo=2.0)


def test_unseen_lengths_stay_within_what_is_said_of_them() -> None:
    """A camera with bent depth and stretched sides, and a model that holds that there is no such thing."""
    cell = honest_cell(SEED, n_shots=N_SHOTS, camera_error="none", sizes=BENT)
    assert cell.verdict != "pass"
    assert cell.ratio < 1.5


def test_a_model_that_fits_is_left_alone_and_the_other_told() -> None:
    volume = volume_cell(SEED, sizes=BENT)
    shots = random_shots(volume, volume.spheres, N_SHOTS // len(volume.spheres), np.random.default_rng([SEED, 1]))
    with one_thread():
        solved = [solve_observations(shots, volume.cell, volume.model, CalibrationSettings(name))[0] for name in ("field", "none")]
        field, none = solved[0].misfit, solved[1].misfit
        others = [NoCameraError(), solved[0].solution.problem.camera_error]
        assert misfit_of(solved[0].solution, others) is None
    assert field is None
    assert none is not None
    assert none.better_rms_mm < 0.95 * none.rms_mm
    # two places that are off by the systematic part, in opposite directions
    assert none.covariance_factor(0.002) == pytest.approx(1 + 2 * (none.rms_mm**2 - none.better_rms_mm**2) / 0.002)
