"""Issue 6: a check of eight shots with the sphere stand fixed, over many cells; seeds and figures are printed."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from calibrate.drift_causes import HAND_EYE, SPHERE, named
from tests.support.drifting import CAUSES, after_two, check_shots, checked_cell, told_of

N_CELLS, FIRST_SEED = 100, 62_000
TWO = (HAND_EYE, "axis 3")
N_QUIET = 4
"""Checks of an unchanged cell."""


@pytest.mark.qualify
def test_changes_are_detected_and_named() -> None:
    told: dict[str | None, list[tuple[str, ...]]] = {cause: [] for cause in (None, *CAUSES, "axis 1", "axis 6", SPHERE)}
    n_two = {"one cause": 0, "two causes": 0}
    for seed in range(FIRST_SEED, FIRST_SEED + N_CELLS):
        checked = checked_cell(seed)
        for i, (cause, names) in enumerate(told.items()):
            shots = check_shots(checked, cause, np.random.default_rng([seed, i, 3]))
            diagnosis, together = told_of(checked, shots)
            names.append(named(diagnosis, 6))
            n_two["one cause"] += together is not None
        # rare things want more draws than cells
        told[None] += [named(told_of(checked, check_shots(checked, None, np.random.default_rng([seed, k, 5])))[0], 6) for k in range(N_QUIET - 1)]
        _, together = told_of(checked, after_two(checked, TWO, np.random.default_rng([seed, 4])))
        n_two["two causes"] += together is not None and {*together.pairs[0].causes} == {*TWO}
        print(f"\nqualify quick check seed={seed}: " + "; ".join(f"{cause}: {names[-1]}" for cause, names in told.items()), end="", flush=True)
    for cause, names in told.items():
        detected = np.mean([bool(name) for name in names])
        right = np.mean([name == (cause,) for name in names])
        print(
            f"\nqualify quick check {cause}: detected {100 * detected:.0f} %, named alone {100 * right:.0f} %, {Counter(names).most_common(4)}",
            end="",
        )
    print(f"\nqualify quick check told as two: {n_two['one cause']} single changes, {n_two['two causes']} of {N_CELLS} of {TWO}", end="")
    assert n_two["one cause"] <= 0.02 * len(told) * N_CELLS
    assert n_two["two causes"] >= 0.85 * N_CELLS
    assert sum(bool(name) for name in told[None]) < 0.03 * N_QUIET * N_CELLS
    for cause in CAUSES:
        assert sum(bool(name) for name in told[cause]) >= 0.95 * N_CELLS, cause
        assert sum(name == (cause,) for name in told[cause]) >= 0.85 * N_CELLS, cause
    # never guessed: with axis 1 goes the sphere, with the last axis the hand-eye
    every = [name for names in told.values() for name in names]
    assert all(SPHERE in name for name in every if "axis 1" in name)
    assert all(HAND_EYE in name for name in every if "axis 6" in name)
