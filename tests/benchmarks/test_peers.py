"""Our three methods beside figaroh's `map` and a residual on pybotics' chain: the same shots in one run (issue 3).

`make bench` prints the table of docs/benchmarks.md. The peers' environments (about 1.2 GB) are made at first use.
Held-out errors are pooled over a few seeds; times are the best of several runs on the same clean data set.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.support.peer_cells import DataSet, data_set, rms, score_mm
from tests.support.peers import peer_python, run_ours, run_peer, run_stepwise, solve_seconds

pytestmark = pytest.mark.bench

FIRST_SEED = 41_000
N_SEEDS = {"clean": 3, "pillow": 2, "outliers": 3, "volume": 8}
THRESHOLDS_MM = (0.2, 0.5, 1.5)
"""Of which "tuned" takes the one that is best on the held-out truth, data set by data set: better than any user can."""
TUNED = tuple(f"figaroh, cut at {threshold} mm" for threshold in THRESHOLDS_MM)
ROWS = ("stepwise", "centres", "clouds", "figaroh, default cut", *TUNED, "pybotics")

PYBOTICS_STEPS = 30
"""Where its cost stood within 1 % of the last of hundreds; it may never end by itself."""

Errors = dict[str, list[float]]


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Both peers installed before anything is timed; the table at the end."""
    for name in ("figaroh", "pybotics"):
        peer_python(name)
    yield tmp_path_factory.mktemp("peers")
    print("\n\npeers  held-out rms / max, mm     " + "".join(f"{name:>18}" for name in _KEPT), end="")
    for row in ROWS:
        print(f"\npeers  {row:<28}" + "".join(f"{both(errors[row]):>18}" for errors in _KEPT.values()), end="")


def both(errors: list[float]) -> str:
    return f"{rms(errors):.4f} / {np.abs(errors).max():.3f}"


_KEPT: dict[str, Errors] = {}


def errors_of(name: str, folder: Path) -> Errors:
    """Held-out errors of every solver on a data set, all seeds together."""
    if name not in _KEPT:
        errors: Errors = {row: [] for row in ROWS}
        for seed in range(FIRST_SEED, FIRST_SEED + N_SEEDS[name]):
            for row, found in solved(name, seed, folder).items():
                errors[row] += found
        _KEPT[name] = errors
    return _KEPT[name]


def solved(name: str, seed: int, folder: Path) -> dict[str, list[float]]:
    """Every solver on one data set; a line each is printed."""
    data = kept_data(name, seed)
    found = {"stepwise": run_stepwise(data), "centres": run_ours("centres", data), "clouds": run_ours("clouds", data)}
    figaroh = run_peer("figaroh", data, folder, outlier_thresholds_mm=[None, *THRESHOLDS_MM])
    found |= dict(zip(ROWS[3:7], figaroh, strict=True))
    found["pybotics"] = run_peer("pybotics", data, folder, max_nfev=PYBOTICS_STEPS)[0]
    scores = {row: score_mm(data, one) for row, one in found.items()}
    for row, one in found.items():
        error = scores[row]
        print(f"\npeers  {name} {seed} {row:<24} rms {rms(error):.4f} max {np.abs(error).max():.4f} mm {one.seconds:7.3f} s  {one.note}", end="")
    return {row: [float(e) for e in error] for row, error in scores.items()}


@cache
def kept_data(name: str, seed: int) -> DataSet:
    return data_set(name, seed)


def tuned_rms(errors: Errors) -> float:
    """figaroh with the cut that suits this data set best."""
    return min(rms(errors[row]) for row in TUNED)


def test_clean_data_end_in_a_tie_at_the_noise_floor(folder: Path) -> None:
    errors = errors_of("clean", folder)
    best_peer = min(rms(errors["figaroh, default cut"]), tuned_rms(errors), rms(errors["pybotics"]))
    assert rms(errors["clouds"]) <= 1.1 * best_peer
    assert rms(errors["centres"]) <= 1.1 * best_peer


def test_a_camera_error_is_beyond_the_peers(folder: Path) -> None:
    errors = errors_of("pillow", folder)
    best_peer = min(rms(errors["figaroh, default cut"]), tuned_rms(errors), rms(errors["pybotics"]))
    assert rms(errors["clouds"]) <= best_peer / 3
    assert rms(errors["centres"]) <= best_peer / 3


def test_outliers_need_no_tuning(folder: Path) -> None:
    errors = errors_of("outliers", folder)
    assert rms(errors["clouds"]) < tuned_rms(errors)
    assert rms(errors["centres"]) <= 1.05 * tuned_rms(errors)
    assert rms(errors["clouds"]) <= min(rms(errors["figaroh, default cut"]), rms(errors["pybotics"])) / 3


def test_lengths_in_the_volume_are_twice_as_good(folder: Path) -> None:
    """All lengths of all cells together: cells differ widely, and a camera that happens to be right leaves a tie."""
    errors = errors_of("volume", folder)
    best_peer = min(rms(errors["figaroh, default cut"]), tuned_rms(errors), rms(errors["pybotics"]))
    assert rms(errors["clouds"]) <= best_peer / 2
    assert rms(errors["clouds"]) <= rms(errors["stepwise"]) / 2


@pytest.fixture(scope="module")
def seconds(folder: Path) -> dict[str, float]:
    """First guess, solve and covariance of 100 shots; ours fits its centres too, the peers are given theirs."""
    data = kept_data("clean", FIRST_SEED)
    found = {method: solve_seconds(method, data) for method in ("centres", "clouds")}
    found["figaroh, residual of its guide"] = run_peer("figaroh", data, folder, repeats=3, log_map=True)[0].seconds
    found["figaroh, plain residual"] = run_peer("figaroh", data, folder, repeats=3)[0].seconds
    found["pybotics"] = run_peer("pybotics", data, folder, max_nfev=PYBOTICS_STEPS)[0].seconds
    for name, value in found.items():
        print(f"\npeers  solve of 100 clean shots: {name:<32} {value * 1e3:8.1f} ms  {value / found['centres']:6.1f} x centres", end="")
    return found


def test_centres_are_solved_faster(seconds: dict[str, float]) -> None:
    assert seconds["figaroh, plain residual"] >= 2 * seconds["centres"]
    assert seconds["pybotics"] >= 10 * seconds["centres"]


@pytest.mark.xfail(reason="issue 3 asks for 20 times; seen 4 to 8 against figaroh: docs/benchmarks.md says why", strict=False)
def test_centres_are_solved_twenty_times_faster(seconds: dict[str, float]) -> None:
    assert min(seconds["figaroh, plain residual"], seconds["pybotics"]) >= 20 * seconds["centres"]
