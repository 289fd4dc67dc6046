"""Conform, reject, or not proven: a figure against its limit when the figure itself is uncertain.

The zones of ISO 14253-1: a value conforms when it keeps the limit by a guard band g, is rejected when it exceeds the
limit by g, and proves nothing in between; g = 1.65 u (95 %, one-sided). u is the uncertainty *of the test*, never what the
calibration says of itself: that one is what is being judged. The limits of a cell choose between two u
(docs/decisions/0010-verification-figures.md): reference and repeat, where the limit is one on the *system's* error, which
few views show only so well; or the reference alone, where the limit is one on the *values of this test*, scatter included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Verdict = Literal["conform", "not_proven", "reject"]

GUARD_FACTOR = 1.65

_ZONES = (
    f"conform: |value| <= limit - {GUARD_FACTOR} u; reject: |value| > limit + {GUARD_FACTOR} u; not proven between (zones of ISO 14253-1, 95 %); u: "
)
RULE = f"{_ZONES}standard uncertainty of the test (artefact and repeatability)"
RULE_OF_VALUES = f"{_ZONES}standard uncertainty of the test values (artefact alone: the limits are on what this test shows, scatter included)"


def rule_of(guard: str | None) -> str:
    """The rule in words for what the limits choose as guard; the usual one for None."""
    return RULE_OF_VALUES if guard == "reference" else RULE


@dataclass(frozen=True, slots=True)
class Judgement:
    """One figure judged."""

    quantity: str
    """In words, for people: "length A-B"."""
    value_mm: float
    limit_mm: float
    standard_uncertainty_mm: float
    verdict: Verdict

    @property
    def reason(self) -> str:
        """Why this judgement is not `conform`, or that it is."""
        value, limit, guard = abs(self.value_mm), self.limit_mm, GUARD_FACTOR * self.standard_uncertainty_mm
        figures = f"{self.quantity}: {value:.3f} mm, limit {limit:.3f} mm"
        match self.verdict:
            case "conform":
                return f"{figures}, kept with {limit - value:.3f} mm to spare"
            case "reject":
                return f"{figures}, exceeded by more than the test's uncertainty (guard band {guard:.3f} mm)"
            case "not_proven":
                return f"{figures}, within the guard band of {guard:.3f} mm: the test cannot tell"


def judge(quantity: str, value_mm: float, limit_mm: float, standard_uncertainty_mm: float) -> Judgement:
    """A figure (signed or not) against a limit on its size, all in mm."""
    guard = GUARD_FACTOR * standard_uncertainty_mm
    verdict: Verdict = "not_proven"
    if abs(value_mm) <= limit_mm - guard:
        verdict = "conform"
    elif abs(value_mm) > limit_mm + guard:
        verdict = "reject"
    return Judgement(quantity, value_mm, limit_mm, standard_uncertainty_mm, verdict)


def overall(judgements: Sequence[Judgement], gaps: Sequence[str]) -> tuple[Verdict, tuple[str, ...]]:
    """The verdict over all judgements and its reasons; `gaps` says what could not be judged and so is not proven."""
    reasons = [j.reason for j in judgements if j.verdict != "conform"]
    if any(j.verdict == "reject" for j in judgements):
        return "reject", (*reasons, *gaps)
    if reasons or gaps or not judgements:
        return "not_proven", (*reasons, *gaps)
    tightest = max(judgements, key=lambda j: abs(j.value_mm) / j.limit_mm)
    return "conform", (f"all {len(judgements)} judged figures keep their limits; the tightest is {tightest.reason}",)
