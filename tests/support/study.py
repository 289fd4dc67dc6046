"""The smallest study that still has every table and figure."""

from __future__ import annotations

from functools import cache

from calibrate.study import Study, StudySettings, run_study

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


@cache
def tiny_study() -> Study:
    """Computed once for all tests of a process: they only look at it."""
    return run_study(TINY)
