"""Repeats of one part (a "type 1" study): scatter and bias against a share of the tolerance.

    Cg  = share T / (spread s),    Cgk = (share T / 2 - |mean - reference|) / (spread s / 2),

T the tolerance, s the standard deviation. Companies differ in share and spread (20 % and 6 are wide-spread, 4 is used as well):
both are settings and printed beside the figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.errors import DataError
from measure.gauge.table import Measured, by_feature, values_mm

CAPABLE = 1.33
_LEAST = 10
_USUAL = 30


@dataclass(frozen=True, slots=True)
class RepeatSettings:
    """What a gauge may take of a tolerance."""

    share: float = 0.2
    spread: float = 6.0
    """Standard deviations that are the gauge's whole spread."""
    limit: float = CAPABLE


@dataclass(frozen=True, slots=True)
class Repeats:
    """One feature."""

    feature: str
    n: int
    mean_mm: float
    standard_deviation_mm: float
    standard_deviation_interval_mm: tuple[float, float]
    """95 %."""
    bias_mm: float | None
    """Mean minus reference, where there is one (`reference_mm`)."""
    bias_is_significant: bool | None
    """By Student's t at 95 %."""
    tolerance_mm: float | None
    cg: float | None
    cgk: float | None
    least_tolerance_mm: float
    """The smallest that Cg would pass at the limit."""
    capable: bool | None
    """None without tolerance."""
    note: str = ""


def repeatability(rows: Sequence[Measured], settings: RepeatSettings | None = None) -> list[Repeats]:
    """Judge every feature by its repeats.

    Raises:
        DataError: fewer than 10 values of a feature, or of several parts.
    """
    settings = settings or RepeatSettings()
    return [_one(feature, members, settings) for feature, members in by_feature(rows).items()]


def _one(feature: str, rows: Sequence[Measured], settings: RepeatSettings) -> Repeats:
    from scipy import stats

    if len(rows) < _LEAST:
        raise DataError(f"{feature}: {len(rows)} repeats are too few", remedy=f"Measure the same part at least {_LEAST} times, better {_USUAL}.")
    if len({row.part for row in rows}) > 1:
        raise DataError(f"{feature}: repeats of several parts", remedy="Repeats are of one part; several parts make an R&R study.")
    values, n = values_mm(rows), len(rows)
    mean, s = float(values.mean()), float(values.std(ddof=1))
    low, high = (s * float(np.sqrt((n - 1) / stats.chi2.ppf(p, n - 1))) for p in (0.975, 0.025))
    references = {row.reference_mm for row in rows}
    reference = references.pop() if len(references) == 1 else None
    bias = None if reference is None else mean - reference
    significant = None if bias is None else bool(abs(bias) > stats.t.ppf(0.975, n - 1) * s / np.sqrt(n))
    tolerance = rows[0].tolerance_mm
    cg = None if tolerance is None else _ratio(settings.share * tolerance, settings.spread * s)
    cgk = None if tolerance is None or bias is None else _ratio(settings.share * tolerance / 2 - abs(bias), settings.spread * s / 2)
    figures = [figure for figure in (cg, cgk) if figure is not None]
    return Repeats(
        feature=feature,
        n=n,
        mean_mm=mean,
        standard_deviation_mm=s,
        standard_deviation_interval_mm=(low, high),
        bias_mm=bias,
        bias_is_significant=significant,
        tolerance_mm=tolerance,
        cg=cg,
        cgk=cgk,
        least_tolerance_mm=settings.limit * settings.spread * s / settings.share,
        capable=all(figure >= settings.limit for figure in figures) if figures else None,
        note="" if n >= _USUAL else f"{n} repeats where {_USUAL} are usual",
    )


def _ratio(over: float, under: float) -> float:
    return float(np.inf) if under == 0 else over / under
