"""Whether intervals and verdicts tell the truth, over cells whose errors are not the solver's models; seeds are printed."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.honesty import HonestCell, honest_cell, judged

FIRST_SEED = 30_000
LIMITS_MM = (0.05, 0.4)
"""Limits on length are drawn between these: from what no cell of this kind can promise to what every one can."""


def drawn_limit_mm(seed: int) -> float:
    return float(np.exp(np.random.default_rng([seed, 777]).uniform(*np.log(LIMITS_MM))))


def cells(n: int, artefact: str = "bar3", *, n_shots: int = 120, first_seed: int = FIRST_SEED) -> list[HonestCell]:
    found = []
    for seed in range(first_seed, first_seed + n):
        found.append(honest_cell(seed, artefact, limit_mm=drawn_limit_mm(seed), n_shots=n_shots))
        last = found[-1]
        print(f"seed {seed} {last.camera_error} {last.verdict}: limit {last.limit_mm:.3f}, largest {last.largest_mm:.3f}, ratio {last.ratio:.2f}")
    return found


@pytest.mark.qualify
def test_200_cells_are_honest() -> None:
    found = judged(cells(200))
    print(found.line)
    assert 0.90 <= found.covered <= 0.98
    assert found.ratio_median <= 1.15
    assert found.ratio_95 <= 1.5
    assert found.false_pass <= 0.02
    assert found.pass_when_good >= 0.8


def test_one_sphere_without_a_length_never_passes_on_length() -> None:
    """Whatever the limit: the scale rests on the sphere's diameter and on depth."""
    found = honest_cell(FIRST_SEED + 999, "one", limit_mm=5.0, n_shots=40)
    assert found.verdict == "marginal"
    # nor is what it says of its lengths a boast
    assert found.ratio < 2.0


@pytest.mark.qualify
def test_one_sphere_without_a_length_never_passes_on_length_in_many_cells() -> None:
    found = cells(30, "one", n_shots=60, first_seed=FIRST_SEED + 1000)
    assert all(cell.verdict != "pass" for cell in found)


def test_a_cell_much_better_than_its_limit_passes_and_one_asked_too_much_does_not() -> None:
    assert honest_cell(FIRST_SEED + 2000, limit_mm=0.4, n_shots=90).verdict == "pass"
    assert honest_cell(FIRST_SEED + 2000, limit_mm=0.02, n_shots=90).verdict == "marginal"
