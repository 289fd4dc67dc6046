"""Figs 7 and 8: noise level without a camera error, and camera error without noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from calibrate.study_accuracy import CENTRE_METHODS, Trial, draw_trial, fit_all
from calibrate.study_cell import NO_NOISE, StudyCell, StudyNoise
from calibrate.study_data import Cell, Curve, Panel, StudyFigure, StudyTable, medians, spread_of
from calibrate.study_methods import LABELS, centres_seen
from drivers.kinematics.se3 import FloatArray

Told = Callable[[], None]
"""Called after every step of long work."""
_SMALLEST_MM = 1e-6
"""Below it a logarithmic axis shows rounding."""


def noise_sweep(
    cell: StudyCell, seeds: Sequence[np.random.SeedSequence], levels: Sequence[float], max_sweeps: int, told: Told
) -> tuple[StudyTable, StudyFigure]:
    """Fig 7: the paper's noise times a level, no camera error."""

    def trial(level: float, rng: np.random.Generator) -> tuple[float, Trial]:
        return level, draw_trial(cell.with_camera_error(0.0), rng, noise=StudyNoise().times(level))

    return _sweep("figure7", "noise_level", "noise level", seeds, levels, trial, max_sweeps, told)


def camera_sweep(
    cell: StudyCell, seeds: Sequence[np.random.SeedSequence], factors: Sequence[float], max_sweeps: int, told: Told
) -> tuple[StudyTable, StudyFigure]:
    """Fig 8: the paper's k times a factor, no noise; over the mean camera error at the sphere."""

    def trial(factor: float, rng: np.random.Generator) -> tuple[float, Trial]:
        drawn = draw_trial(cell.with_camera_error(factor), rng, noise=NO_NOISE)
        size = np.abs(drawn.cell.camera_error_mm(drawn.training.true_centre_in_camera_mm)).mean()
        return float(size), drawn

    return _sweep("figure8", "mean_camera_error_mm", "mean camera error, mm", seeds, factors, trial, max_sweeps, told)


def _sweep(
    name: str,
    column: str,
    x_label: str,
    seeds: Sequence[np.random.SeedSequence],
    values: Sequence[float],
    trial: Callable[[float, np.random.Generator], tuple[float, Trial]],
    max_sweeps: int,
    told: Told,
) -> tuple[StudyTable, StudyFigure]:
    rows: list[tuple[Cell, ...]] = []
    for value in values:
        repeats: list[tuple[Cell, ...]] = []
        for seed in seeds:
            # the same poses and, up to its size, the same noise at every value
            x, drawn = trial(value, np.random.default_rng(seed))
            fitted = fit_all(drawn, CENTRE_METHODS, max_sweeps)
            found = [spread_of(centres_seen(fitted[m], drawn.cell, drawn.exact_tests, "given"), drawn.cell.centre_in_base_mm) for m in CENTRE_METHODS]
            repeats.append((x, *(s.e_mean_mm for s in found), *(s.rms_about_mean_mm for s in found)))
            told()
        rows.append(medians(repeats))
    keys = [m.replace(" ", "_") for m in CENTRE_METHODS]
    table = StudyTable(name, (column, *(f"e_mean_{k}_mm" for k in keys), *(f"rms_about_mean_{k}_mm" for k in keys)), tuple(rows))
    return table, _figure(name, x_label, table)


def _figure(name: str, x_label: str, table: StudyTable) -> StudyFigure:
    values = np.array(table.rows, dtype=np.float64)
    n = len(CENTRE_METHODS)

    def curves(first: int) -> tuple[Curve, ...]:
        return tuple(Curve(LABELS[m], values[:, 0], _visible(values[:, first + i])) for i, m in enumerate(CENTRE_METHODS))

    return StudyFigure(
        name,
        (
            Panel("as the paper draws it", x_label, "e_mean, mm", curves(1), log_y=True),
            Panel("without the datum", x_label, "centre rms about the mean, mm", curves(1 + n), log_y=True),
        ),
    )


def _visible(values: FloatArray) -> FloatArray:
    return np.maximum(values, _SMALLEST_MM)
