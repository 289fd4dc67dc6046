"""`spherecal study`: the paper's simulation run again, its tables and figures computed with its solver and with ours."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calibrate.study_accuracy import (
    CENTRE_METHODS,
    descent_figure,
    draw_trial,
    figure_6,
    figure_10,
    fit_all,
    gauge_table,
    order_table,
    sign_table,
    table_3,
)
from calibrate.study_cell import StudyNoise, paper_cell
from calibrate.study_clouds import clouds_table, diameter_figure, fit_variants, stitching, table_5
from calibrate.study_compare import comparison
from calibrate.study_data import StudyFigure, StudyTable
from calibrate.study_printed import printed_tables
from calibrate.study_sweeps import camera_sweep, noise_sweep

Progress = Callable[[int, int], None]
"""Called with (done, total)."""


@dataclass(frozen=True, slots=True)
class StudySettings:
    """How much to compute."""

    seed: int = 2023
    repeats: int = 5
    """Draws of the simulation that Table 3's medians are taken over."""
    cloud_repeats: int = 3
    sweep_repeats: int = 3
    n_points: int = 1000
    """Of a cloud."""
    max_sweeps: int = 1000
    """The paper's L."""
    noise_levels: tuple[float, ...] = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0)
    camera_factors: tuple[float, ...] = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
    n_shuffles: int = 4


QUICK = StudySettings(
    repeats=1,
    cloud_repeats=1,
    sweep_repeats=1,
    n_points=300,
    max_sweeps=100,
    noise_levels=(0.0, 1.0, 3.0),
    camera_factors=(0.0, 0.5, 1.0),
    n_shuffles=1,
)
"""Half a minute: the same tables and figures, coarser."""


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """All that was computed."""

    settings: StudySettings
    tables: tuple[StudyTable, ...]
    figures: tuple[StudyFigure, ...]
    seconds: float

    def table(self, name: str) -> StudyTable:
        """The table of that name."""
        return next(table for table in self.tables if table.name == name)

    def figure(self, name: str) -> StudyFigure:
        """The figure of that name."""
        return next(figure for figure in self.figures if figure.name == name)


def run_study(settings: StudySettings | None = None, *, progress: Progress | None = None) -> Study:
    """Compute everything. The same settings give the same figures, times aside."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        return _run(settings or StudySettings(), progress or _nobody)


def _run(settings: StudySettings, progress: Progress) -> Study:
    began = time.perf_counter()
    s, cell, noise = settings, paper_cell(), StudyNoise()
    steps = _Steps(progress, s.repeats + s.cloud_repeats + s.sweep_repeats * (len(s.noise_levels) + len(s.camera_factors)) + 5)
    seeds = np.random.SeedSequence(s.seed).spawn(5)
    trials = []
    for seed in seeds[0].spawn(s.repeats):
        trial = draw_trial(cell, np.random.default_rng(seed), noise=noise)
        trials.append((trial, fit_all(trial, CENTRE_METHODS, s.max_sweeps)))
        steps.done()
    first, fitted = trials[0]
    tables, figures = [table_3(trials), sign_table(first), gauge_table(first, s.max_sweeps)], [figure_6(first, fitted)]
    steps.done()
    tables.append(order_table(first, np.random.default_rng(seeds[1]), s.max_sweeps, s.n_shuffles))
    steps.done()
    figures.append(descent_figure(first, fitted["joint"], s.max_sweeps))
    steps.done()
    sweep_seeds = seeds[2].spawn(s.sweep_repeats)
    for table, figure in (
        noise_sweep(cell, sweep_seeds, s.noise_levels, s.max_sweeps, steps.done),
        camera_sweep(cell, sweep_seeds, s.camera_factors, s.max_sweeps, steps.done),
    ):
        tables.append(table)
        figures.append(figure)
    clouds = []
    for seed in seeds[3].spawn(s.cloud_repeats):
        trial = draw_trial(cell, np.random.default_rng(seed), noise=noise, n_points=s.n_points)
        clouds.append((trial, fit_variants(trial, s.max_sweeps)))
        steps.done()
    rng = np.random.default_rng(seeds[4])
    tables += [clouds_table(clouds), table_5(clouds, rng, noise, s.n_points)]
    steps.done()
    stitched, sections = stitching(clouds, rng, noise, s.n_points)
    tables.append(stitched)
    figures += [diameter_figure("figure5", cell, None, s.n_points), figure_10(first, fitted)]
    figures += [diameter_figure("figure11", cell, clouds[0][1], s.n_points), *sections]
    steps.done()
    named = {table.name: table for table in tables}
    tables.insert(0, comparison(named["table3"], named["table5"], named["stitching"]))
    tables += printed_tables(figures, tables, first.exact_tests.true_centre_in_camera_mm)
    return Study(s, tuple(tables), tuple(figures), time.perf_counter() - began)


class _Steps:
    """Counts finished steps for whoever watches."""

    def __init__(self, progress: Progress, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def done(self) -> None:
        """One more."""
        self._done += 1
        self._progress(self._done, self._total)


def _nobody(_done: int, _total: int) -> None:
    """Progress that nobody watches."""
