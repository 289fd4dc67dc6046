"""The whole-cloud solver where its models hold, and in a crowded scene where the camera's does not; fresh seeds are printed.

A reduced seed of the crowded scene is part of the ordinary suite (tests/unit/calibrate/test_crowded.py).
"""

from __future__ import annotations

import secrets
from pathlib import Path

import numpy as np
import pytest

from tests.support.bound import recover
from tests.support.crowded import solve_crowded, write_crowded_session
from tests.support.from_nothing import recover_from_nothing

pytestmark = pytest.mark.qualify

N_PILLOWS, N_CROWDED = 20, 10


def fresh_seeds(n: int) -> list[int]:
    """Seeds that nobody has seen."""
    return [secrets.randbelow(2**31) for _ in range(n)]


def test_the_pillow_is_solved_to_its_bound() -> None:
    """Issue 3: held-out centre rms, 100 shots x 1000 points, a guess 2 mm and 7 mrad off: median at most 1.1 of the bound."""
    found = {seed: recover(seed) for seed in fresh_seeds(N_PILLOWS)}
    for seed, one in found.items():
        print(f"\nqualify pillow seed={seed}: {one.held_out_rms_mm:.4f} mm, bound {one.bound_mm:.4f} mm, ratio {one.ratio:.2f}", end="")
    median = float(np.median([one.ratio for one in found.values()]))
    print(f"\nqualify pillow: median ratio {median:.3f}", end="")
    assert median <= 1.1


def test_the_coupled_robot_needs_no_first_guess(tmp_path: Path) -> None:
    """The same on the IRB 1410 with its parallelogram, from a session that says nothing of the hand-eye transform: 1.2."""
    found = {seed: recover_from_nothing(tmp_path / str(seed), seed, coupled=True) for seed in fresh_seeds(N_PILLOWS)}
    for seed, one in found.items():
        print(f"\nqualify from nothing seed={seed}: {one.held_out_rms_mm:.4f} mm, bound {one.bound_mm:.4f} mm, ratio {one.ratio:.2f}", end="")
    median = float(np.median([one.ratio for one in found.values()]))
    print(f"\nqualify from nothing: median ratio {median:.3f}", end="")
    assert median <= 1.2


def test_a_camera_that_is_no_pillow_in_a_crowded_scene(tmp_path: Path) -> None:
    """Issue 3: at most 0.6 of what the pillow leaves, all four spoiled shots of 90 rejected and at most two others."""
    ratios = []
    for seed in fresh_seeds(N_CROWDED):
        found = solve_crowded(write_crowded_session(tmp_path / str(seed), seed), ("auto", "pillow"), seed)
        ratios.append(found.rms_mm["auto"] / found.rms_mm["pillow"])
        told = f"seed={seed}: auto {found.rms_mm['auto']:.4f} mm, pillow {found.rms_mm['pillow']:.4f} mm, ratio {ratios[-1]:.2f}"
        print(f"\nqualify crowded {told}, missed {found.missed}, lost {found.lost}", end="")
        assert not found.missed, told
        assert found.lost <= 2, told
    print(f"\nqualify crowded: median ratio {np.median(ratios):.3f}, largest {max(ratios):.2f}", end="")
    assert np.median(ratios) <= 0.6
