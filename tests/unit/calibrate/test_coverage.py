"""Intervals hold what they say: 95 % of unseen lengths lie within twice their standard uncertainty."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.support.unseen import random_unseen_lengths

N_SEEDS, N_LENGTHS = 3, 16


def test_intervals_of_unseen_lengths_cover(tmp_path: Path) -> None:
    """The solver's own model; 200 seeds are in tests/qualify."""
    lengths = [one for s in range(N_SEEDS) for one in random_unseen_lengths(s, tmp_path / str(s), n_shots=34, n_points=60, n_lengths=N_LENGTHS)]
    assert len(lengths) == N_SEEDS * N_LENGTHS
    covered = np.mean([abs(one.error_mm) <= 1.96 * one.sigma_mm for one in lengths])
    assert 0.85 <= covered <= 1.0, covered
    # nor so wide that anything would be covered
    assert 0.3 < np.sqrt(np.mean([(one.error_mm / one.sigma_mm) ** 2 for one in lengths])) < 1.5
    assert np.median([one.sigma_mm for one in lengths]) < 0.12
