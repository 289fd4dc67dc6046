"""Gauge R&R, crossed: parts x operators x trials by analysis of variance (two factors with interaction, all random).

Mean squares give variances: trials within a cell the repeatability, operators and their interaction with parts the
reproducibility. An interaction that is not significant (p above 0.25) is pooled with the repeatability. For a robot an
"operator" is whatever may change between runs: set-up, program, robot, day.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.errors import DataError
from drivers.kinematics.se3 import FloatArray
from measure.gauge.table import Measured, by_feature

_POOL_ABOVE_P = 0.25
_SPREAD = 6.0
_GOOD, _CONDITIONAL = 0.10, 0.30
_CATEGORIES = 1.41


@dataclass(frozen=True, slots=True)
class Reproducibility:
    """One feature; standard deviations in mm."""

    feature: str
    n_parts: int
    n_operators: int
    n_trials: int
    repeatability_mm: float
    operators_mm: float
    interaction_mm: float
    """Zero where it was pooled."""
    parts_mm: float
    interaction_p: float
    pooled: bool
    tolerance_mm: float | None

    @property
    def reproducibility_mm(self) -> float:
        """Operators and their interaction with parts."""
        return float(np.hypot(self.operators_mm, self.interaction_mm))

    @property
    def gauge_mm(self) -> float:
        """Repeatability and reproducibility together."""
        return float(np.hypot(self.repeatability_mm, self.reproducibility_mm))

    @property
    def total_mm(self) -> float:
        """The gauge and the parts."""
        return float(np.hypot(self.gauge_mm, self.parts_mm))

    @property
    def share_of_variation(self) -> float:
        """Of the study's total standard deviation."""
        return self.gauge_mm / self.total_mm if self.total_mm > 0 else 0.0

    @property
    def share_of_tolerance(self) -> float | None:
        """Six standard deviations of the gauge over the tolerance."""
        return None if self.tolerance_mm is None else _SPREAD * self.gauge_mm / self.tolerance_mm

    @property
    def n_categories(self) -> int | None:
        """Classes of parts that the gauge tells apart; None for a gauge without any scatter."""
        return None if self.gauge_mm == 0 else int(_CATEGORIES * self.parts_mm / self.gauge_mm)

    @property
    def judgement(self) -> str:
        """By the share of the tolerance, else of the variation: up to 10 % good, up to 30 % conditional."""
        share = self.share_of_variation if self.share_of_tolerance is None else self.share_of_tolerance
        return "good" if share <= _GOOD else "conditional" if share <= _CONDITIONAL else "not capable"


def reproducibility(rows: Sequence[Measured]) -> list[Reproducibility]:
    """Judge every feature.

    Raises:
        DataError: the same number of trials is wanted of every part with every operator, and two of each at least.
    """
    return [_one(feature, members) for feature, members in by_feature(rows).items()]


def _one(feature: str, rows: Sequence[Measured]) -> Reproducibility:
    from scipy import stats

    y = _cube(feature, rows)
    p, o, r = y.shape
    grand, cell = y.mean(), y.mean(axis=2)
    part, operator = cell.mean(axis=1), cell.mean(axis=0)
    inside = cell - part[:, None] - operator[None, :] + grand
    squares = {
        "parts": o * r * float(((part - grand) ** 2).sum()),
        "operators": p * r * float(((operator - grand) ** 2).sum()),
        "interaction": r * float((inside**2).sum()),
        "error": float(((y - cell[:, :, None]) ** 2).sum()),
    }
    freedom = {"parts": p - 1, "operators": o - 1, "interaction": (p - 1) * (o - 1), "error": p * o * (r - 1)}
    mean = {name: squares[name] / freedom[name] for name in squares}
    ratio = mean["interaction"] / mean["error"] if mean["error"] > 0 else np.inf
    p_value = float(stats.f.sf(ratio, freedom["interaction"], freedom["error"]))
    pooled = p_value > _POOL_ABOVE_P
    if pooled:
        both = freedom["interaction"] + freedom["error"]
        within = (squares["interaction"] + squares["error"]) / both
        against, interaction = within, 0.0
    else:
        within, against = mean["error"], mean["interaction"]
        interaction = max(0.0, (mean["interaction"] - mean["error"]) / r)
    return Reproducibility(
        feature=feature,
        n_parts=p,
        n_operators=o,
        n_trials=r,
        repeatability_mm=float(np.sqrt(within)),
        operators_mm=float(np.sqrt(max(0.0, (mean["operators"] - against) / (p * r)))),
        interaction_mm=float(np.sqrt(interaction)),
        parts_mm=float(np.sqrt(max(0.0, (mean["parts"] - against) / (o * r)))),
        interaction_p=p_value,
        pooled=pooled,
        tolerance_mm=rows[0].tolerance_mm,
    )


def _cube(feature: str, rows: Sequence[Measured]) -> FloatArray:
    """(parts, operators, trials) values."""
    cells: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        cells.setdefault((row.part, row.operator), []).append(row.value_mm)
    parts, operators = sorted({part for part, _ in cells}), sorted({operator for _, operator in cells})
    counts = {len(cells.get((part, operator), [])) for part in parts for operator in operators}
    if min(len(parts), len(operators)) < 2 or len(counts) != 1 or min(counts) < 2:
        missing = next((f"part {p}, operator {o}" for p in parts for o in operators if len(cells.get((p, o), [])) != max(counts)), "")
        found = f"{len(parts)} parts, {len(operators)} operators, {min(counts)} to {max(counts)} trials"
        raise DataError(
            f"{feature}: {found}{f' ({missing})' if missing else ''}",
            remedy="An R&R study wants every part measured as often with every operator: 10 parts, 3 operators and 3 trials are usual.",
        )
    return np.array([[cells[part, operator] for operator in operators] for part in parts])
