"""pass, marginal and fail: one fault at a time, the gravest told first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acquire.cell import Limits
from calibrate.identifiability import Identifiability
from calibrate.verdict import Evidence, judge

LIMITS = Limits(centre_rms_mm=0.2, length_error_mm=0.2, diameter_error_mm=0.1, form_mm=0.3)
GOOD = Evidence(
    limits=LIMITS,
    cross_validated_rms_mm=0.08,
    length_expanded_uncertainty_mm=0.05,
    n_shots=60,
    used=59,
    has_joints=True,
    has_certified_length=True,
    line_profile=False,
    covariance_scale=1.2,
)
WHOLE = Identifiability(rank=27, n_parameters=45, expected_rank=27, condition=80.0, gap=1e5, singular_values=np.ones(45))
OPEN = replace(WHOLE, rank=23)

FAILS = {
    "open directions": (GOOD, OPEN, "rank 23"),
    "half of the shots": (replace(GOOD, used=30), WHOLE, "30 of 60 shots were rejected"),
    "held back": (replace(GOOD, held=True), WHOLE, "held near the first guess"),
    "missed limit": (replace(GOOD, cross_validated_rms_mm=0.21), WHOLE, "the limit is 0.2 mm"),
}
DOUBTS = {
    "no limits": (replace(GOOD, limits=None), "no limits"),
    "pose only": (replace(GOOD, has_joints=False), "uncalibrated"),
    "no length": (replace(GOOD, has_certified_length=False), "no certified length"),
    "unsure length": (replace(GOOD, length_expanded_uncertainty_mm=0.3), "U = 0.300 mm"),
    "wrong diameter": (replace(GOOD, radius_offset_mm=-0.9), "0.90 mm smaller in radius"),
    "some rejected": (replace(GOOD, used=50), "10 of 60"),
    "more than noise": (replace(GOOD, covariance_scale=9.0), "3.0 times"),
}


def test_nothing_against_it_is_a_pass_without_reasons() -> None:
    assert judge(GOOD, WHOLE) == ("pass", ())


@pytest.mark.parametrize("name", FAILS)
def test_a_grave_fault_fails_whatever_else_is_good(name: str) -> None:
    evidence, identifiability, words = FAILS[name]
    verdict, reasons = judge(evidence, identifiability)
    assert verdict == "fail"
    assert words in reasons[0]


@pytest.mark.parametrize("name", DOUBTS)
def test_a_doubt_is_marginal_with_its_reason(name: str) -> None:
    evidence, words = DOUBTS[name]
    verdict, reasons = judge(evidence, WHOLE)
    assert verdict == "marginal"
    assert len(reasons) == 1
    assert words in reasons[0]


def test_all_reasons_are_told_and_the_grave_ones_first() -> None:
    everything = replace(GOOD, limits=None, has_certified_length=False, used=10)
    verdict, reasons = judge(everything, OPEN)
    assert verdict == "fail"
    assert len(reasons) >= 4
    assert "rank" in reasons[0]


@pytest.mark.parametrize(("point_noise_mm", "expected"), [(0.495, "marginal"), (0.1, "fail")])
def test_noise_of_points_is_not_held_against_profiles_and_what_is_left_is(point_noise_mm: float, expected: str) -> None:
    profile = replace(GOOD, line_profile=True, cross_validated_rms_mm=0.5, has_joints=False, length_expanded_uncertainty_mm=None)
    verdict, reasons = judge(replace(profile, point_noise_mm=point_noise_mm), replace(WHOLE, rank=6, expected_rank=6))
    assert verdict == expected
    assert any("held-out profiles lie off their sphere" in reason for reason in reasons) == (expected == "fail")
