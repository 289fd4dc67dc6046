"""Timing for `make bench`: the best of several runs, told in one line each."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter


def best_of(n_runs: int, call: Callable[[], object]) -> float:
    """Shortest wall time of a call, s. Run it once before where the first call compiles or fills a cache."""
    times_s = []
    for _ in range(n_runs):
        start_s = perf_counter()
        call()
        times_s.append(perf_counter() - start_s)
    return min(times_s)


def tell(what: str, seconds: float, note: str = "") -> None:
    """One line of the benchmark's output."""
    print(f"\nbench  {what:<58} {seconds * 1e3:10.2f} ms  {note}", end="")
