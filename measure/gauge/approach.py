"""Direction of approach and drift: what the same feature reads from the other side, and as the machine warms up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.errors import DataError
from drivers.kinematics.se3 import FloatArray
from measure.gauge.table import Measured, by_feature, values_mm

_LEAST = 3
_LEAST_DRIFT = 6
_STEPS = 60


@dataclass(frozen=True, slots=True)
class Reversal:
    """One feature approached from two sides."""

    feature: str
    directions: tuple[str, str]
    n: tuple[int, int]
    difference_mm: float
    """Mean from the second side minus mean from the first: the reversal (hysteresis)."""
    expanded_uncertainty_mm: float
    """95 %, by Welch's t."""

    @property
    def is_significant(self) -> bool:
        """Whether the two sides differ by more than chance."""
        return abs(self.difference_mm) > self.expanded_uncertainty_mm


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """One feature over a run from cold to warm."""

    feature: str
    n: int
    slope_mm_per_hour: float
    slope_expanded_uncertainty_mm_per_hour: float
    """95 %."""
    span_mm: float
    """Of the smoothed course: what a part measured at any time may be off by."""
    time_constant_minutes: float | None
    """Of an exponential approach to the warm state, where that fits better than a line; None otherwise."""
    warm_mm: float | None
    """The warm state that it approaches."""
    minutes: FloatArray
    """(n,)"""
    value_mm: FloatArray
    """(n,)"""

    def settled_after_minutes(self, limit_mm: float) -> float | None:
        """When what is still to come is below a limit; None where nothing says that it settles."""
        if self.time_constant_minutes is None or self.warm_mm is None:
            return None
        away = abs(self._amplitude_mm())
        return 0.0 if away <= limit_mm else float(self.time_constant_minutes * np.log(away / limit_mm))

    def _amplitude_mm(self) -> float:
        """What an exponential course is from its end at the start."""
        shape = np.exp(-self.minutes / (self.time_constant_minutes or 1.0))
        away = self.value_mm - (self.warm_mm or 0.0)
        return float(shape @ away / (shape @ shape))


def reversals(rows: Sequence[Measured]) -> list[Reversal]:
    """Compare the two directions of approach of every feature.

    Raises:
        DataError: a feature without exactly two directions, or fewer than three values of one.
    """
    return [_reversal(feature, members) for feature, members in by_feature(rows).items()]


def _reversal(feature: str, rows: Sequence[Measured]) -> Reversal:
    from scipy import stats

    sides = sorted({row.direction for row in rows})
    if len(sides) != 2 or not all(sides):
        raise DataError(f"{feature}: directions of approach are {sides}", remedy="Name exactly two in the column direction, as + and -.")
    first, second = (values_mm([row for row in rows if row.direction == side]) for side in sides)
    if min(len(first), len(second)) < _LEAST:
        raise DataError(f"{feature}: {len(first)} and {len(second)} values are too few", remedy=f"Measure at least {_LEAST} times from each side.")
    shares = np.array([first.var(ddof=1) / len(first), second.var(ddof=1) / len(second)])
    u = float(np.sqrt(shares.sum()))
    freedom = shares.sum() ** 2 / (shares**2 / (np.array([len(first), len(second)]) - 1)).sum() if u > 0 else 1.0
    expanded = float(stats.t.ppf(0.975, freedom)) * u
    return Reversal(feature, (sides[0], sides[1]), (len(first), len(second)), float(second.mean() - first.mean()), expanded)


def drifts(rows: Sequence[Measured]) -> list[Drift]:
    """The course of every feature over `minutes`.

    Raises:
        DataError: minutes missing, or fewer than six values of a feature.
    """
    return [_drift(feature, members) for feature, members in by_feature(rows).items()]


def _drift(feature: str, rows: Sequence[Measured]) -> Drift:
    from scipy import stats

    if any(row.minutes is None for row in rows) or len(rows) < _LEAST_DRIFT:
        raise DataError(f"{feature}: a drift run wants minutes in every row, and {_LEAST_DRIFT} values at least", remedy="Fill the column minutes.")
    minutes = np.array([row.minutes for row in rows], dtype=np.float64)
    order = np.argsort(minutes, kind="stable")
    minutes, value = minutes[order], values_mm(rows)[order]
    if np.ptp(minutes) == 0:
        raise DataError(f"{feature}: all values at the same minute", remedy="Fill the column minutes.")
    line = stats.linregress(minutes / 60.0, value)
    width = float(stats.t.ppf(0.975, len(rows) - 2) * line.stderr)
    tau, warm, course = _exponential(minutes, value)
    straight = line.intercept + line.slope * minutes / 60.0
    # one more unknown must earn itself (Akaike)
    gain = len(rows) * np.log(max(((value - straight) ** 2).sum(), 1e-300) / max(((value - course) ** 2).sum(), 1e-300))
    bends = gain > 4.0 and tau < np.ptp(minutes)
    span = float(np.ptp(course if bends else straight))
    return Drift(feature, len(rows), float(line.slope), width, span, tau if bends else None, warm if bends else None, minutes, value)


def _exponential(minutes: FloatArray, value: FloatArray) -> tuple[float, float, FloatArray]:
    """Time constant, warm state and course (n,) of the best `warm + a exp(-t / tau)`: a and warm are linear, tau is searched."""
    best: tuple[float, float, float, FloatArray] | None = None
    for tau in np.geomspace(np.ptp(minutes) / 50.0, 3.0 * np.ptp(minutes), _STEPS):
        design = np.column_stack([np.ones_like(minutes), np.exp(-minutes / tau)])
        found, *_ = np.linalg.lstsq(design, value, rcond=None)
        course = design @ found
        cost = float(((value - course) ** 2).sum())
        if best is None or cost < best[0]:
            best = (cost, float(tau), float(found[0]), course)
    if best is None:  # a search of no steps
        raise ValueError("no time constant was tried")
    return best[1], best[2], best[3]
