"""The three-state decision: its zones, and what makes a whole verdict."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from measure.decision import GUARD_FACTOR, Judgement, judge, overall

sizes = st.floats(0, 10)


@given(st.floats(-10, 10), sizes, sizes)
def test_zones_do_not_overlap_and_a_surer_test_never_reverses(value: float, limit: float, u: float) -> None:
    verdict = judge("q", value, limit, u).verdict
    assert verdict == judge("q", -value, limit, u).verdict
    if verdict != "not_proven":
        assert verdict == judge("q", value, limit, u / 2).verdict
        assert (verdict == "conform") == (abs(value) <= limit)


def test_the_guard_band_is_the_boundary() -> None:
    guard = GUARD_FACTOR * 0.02
    assert judge("q", 0.2 - guard - 1e-9, 0.2, 0.02).verdict == "conform"
    assert judge("q", 0.2 - guard + 1e-9, 0.2, 0.02).verdict == "not_proven"
    assert judge("q", 0.2 + guard - 1e-9, 0.2, 0.02).verdict == "not_proven"
    assert judge("q", -0.2 - guard - 1e-9, 0.2, 0.02).verdict == "reject"


GOOD = judge("good", 0.0, 1.0, 0.0)
UNSURE = judge("unsure", 1.0, 1.0, 0.1)
BAD = judge("bad", 2.0, 1.0, 0.1)


@pytest.mark.parametrize(
    ("judgements", "gaps", "verdict", "n_reasons"),
    [
        ([GOOD], [], "conform", 1),
        ([GOOD, UNSURE], [], "not_proven", 1),
        ([GOOD, UNSURE, BAD], [], "reject", 2),
        ([GOOD], ["no limits given"], "not_proven", 1),
        ([BAD], ["no limits given"], "reject", 2),
        ([], [], "not_proven", 0),
    ],
)
def test_the_worst_judgement_decides_and_gaps_forbid_conform(judgements: list[Judgement], gaps: list[str], verdict: str, n_reasons: int) -> None:
    found, reasons = overall(judgements, gaps)
    assert found == verdict
    assert len(reasons) == n_reasons


def test_reasons_carry_the_figures() -> None:
    assert BAD.reason.startswith("bad: 2.000 mm, limit 1.000 mm, exceeded")
    assert "guard band of 0.165 mm" in UNSURE.reason
