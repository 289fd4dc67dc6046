"""Volume lengths beside the way of the paper's peers: an analytic solve on fixed-radius centres with the radius held.

What was measured (seeds 51000 to 51009 and 52000 to 52007, 120 random shots, a 500 mm bar in three orientations; rms of
28 unseen lengths of every cell, all cells together): whole clouds and centres with `auto` 0.023 and 0.024 mm; the analytic
solve without the bar's lengths, which the peers do not know, 0.19 to 0.25; with them 0.061 (no camera error), 0.054
(pillow, the paper's), 0.027 (our affine field), 0.026 (our cubic field). So the gain is in the certified lengths and in a
camera model that held-out shots choose. Given both, the analytic solve is nearly as good on this truth: its camera error
hardly bends a cap, and all of them stand at what the poses' noise and the arm's other errors leave (`predict` says 0.022).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from calibrate.observations import Observations
from calibrate.solve import CalibrationSettings, solve_observations
from drivers.kinematics.se3 import FloatArray
from tests.support.analytic import solve_analytic_on
from tests.support.solving import one_thread
from tests.support.volume import UNSEEN, VolumeCell, measured_centres, random_shots, unseen_lengths, volume_cell

FIRST_SEED = 52000
MODELS = ("none", "affine", "pillow", "field")


def rms(values: FloatArray | Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def seen(seed: int, n_shots: int, n_views: int) -> tuple[VolumeCell, Observations, Observations]:
    """A cell, its shots, and noise-free views of the unseen places."""
    volume, rng = volume_cell(seed, "bar3"), np.random.default_rng([seed, 77])
    shots = random_shots(volume, volume.spheres, n_shots // len(volume.spheres), rng, n_points=300)
    return volume, shots, random_shots(volume, list(UNSEEN), n_views, rng, n_points=300, noise=False)


def ours_mm(volume: VolumeCell, shots: Observations, test: Observations, settings: CalibrationSettings) -> float:
    with one_thread():
        solved, _ = solve_observations(shots, volume.cell, volume.model, settings)
    return rms(unseen_lengths(measured_centres(solved, test)))


def theirs_mm(volume: VolumeCell, shots: Observations, test: Observations, camera_error: str, *, lengths: bool) -> float:
    with one_thread():
        found = solve_analytic_on(volume, shots, camera_error, lengths=lengths)
    return rms(unseen_lengths(found.centres_in_base_mm(test)))


@pytest.mark.qualify
def test_unseen_lengths_are_at_least_twice_as_good_as_the_peers_way() -> None:
    found: dict[tuple[str, str], list[float]] = {}
    for seed in range(FIRST_SEED, FIRST_SEED + 8):
        volume, shots, test = seen(seed, 120, 20)
        for method in ("clouds", "centres"):
            found.setdefault((method, "auto"), []).append(ours_mm(volume, shots, test, CalibrationSettings(method=method)))
        for model in MODELS:
            for name, lengths in (("analytic", True), ("analytic without lengths", False)):
                found.setdefault((name, model), []).append(theirs_mm(volume, shots, test, model, lengths=lengths))
        print(f"\nqualify volume seed={seed}: " + ", ".join(f"{' '.join(key)} {values[-1]:.4f}" for key, values in found.items()), end="")
    pooled = {key: rms(values) for key, values in found.items()}
    print("\nqualify volume rms of all: " + ", ".join(f"{' '.join(key)} {value:.4f}" for key, value in pooled.items()), end="")
    for method in ("clouds", "centres"):
        ours = pooled[method, "auto"]
        assert all(pooled["analytic without lengths", model] >= 4.0 * ours for model in MODELS)
        # the camera models that the peers and the paper have
        assert pooled["analytic", "none"] >= 2.0 * ours
        assert pooled["analytic", "pillow"] >= 2.0 * ours
        # handed our camera models and our lengths the old way is not far behind, but not ahead either
        assert pooled["analytic", "affine"] >= ours
        assert pooled["analytic", "field"] >= ours


def test_unseen_lengths_are_better_than_without_certified_lengths() -> None:
    """The same in small."""
    pooled: dict[str, list[float]] = {"centres": [], "analytic": []}
    for seed in (1,):
        volume, shots, test = seen(seed, 42, 6)
        pooled["centres"].append(ours_mm(volume, shots, test, CalibrationSettings(camera_error="affine", method="centres")))
        pooled["analytic"].append(theirs_mm(volume, shots, test, "pillow", lengths=False))
    assert rms(pooled["analytic"]) > 2.0 * rms(pooled["centres"]), pooled
