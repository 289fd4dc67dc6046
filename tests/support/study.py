"""The smallest study that still has every table and figure."""

from __future__ import annotations

import pytest

from calibrate.study import Study, StudySettings, run_study
from tests.support.once import once_a_run

TINY = StudySettings(
    seed=5,
    repeats=1,
    cloud_repeats=1,
    sweep_repeats=1,
    n_points=100,
    max_sweeps=40,
    noise_levels=(1.0,),
    camera_factors=(1.0,),
    n_shuffles=1,
)


def tiny_study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """Computed once for all tests of a run: they only look at it."""
    return once_a_run(tmp_path_factory, "tiny_study", lambda _folder: run_study(TINY))
