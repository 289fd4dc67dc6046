"""Workers that die, hang or raise cost one attempt of one job, and every ticket comes back exactly once."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from drivers.errors import SettingsError
from measure.jobs.dask_pool import require_loopback
from measure.jobs.failures import TIMED_OUT, WORKER_DIED
from measure.jobs.model import Files, Job, Order, Outcome, Recipe
from measure.jobs.outputs import clear_abandoned, prepare
from measure.jobs.pool import LocalPool
from tests.support.job_works import dying_at_work, moody


def order(part: str, out: Path) -> Order:
    return Order(Job(part, Path("/parts") / part, "session", "0" * 64, "f" * 64, "r" * 64, 1.0), Recipe("c" * 64), Files(Path("/c.yaml")), out, 1)


def done_by(pool: LocalPool, parts: list[str], out: Path) -> list[tuple[str, Outcome]]:
    """Every outcome, in the order of its coming, submitted as workers become free."""
    waiting = list(parts)
    ended: list[tuple[str, Outcome]] = []
    while len(ended) < len(parts):
        while waiting and pool.n_free:
            part = waiting.pop(0)
            pool.submit(part, order(part, out))
        ended += pool.collect(1.0)
    return ended


def test_dead_hanging_and_raising_workers_are_replaced(tmp_path: Path) -> None:
    pool = LocalPool(2, moody, timeout_s=1.0)
    parts = ["fine-1", "dies-1", "hangs_once-1", "raises-1", "fine-2"]
    try:
        ended = done_by(pool, parts, tmp_path)
        again = done_by(pool, ["hangs_once-1"], tmp_path)
    finally:
        pool.close()
    failures = {ticket: None if outcome.failure is None else (outcome.failure.category, outcome.failure.transient) for ticket, outcome in ended}
    assert sorted(ticket for ticket, _ in ended) == sorted(parts)
    assert failures == {
        "fine-1": None,
        "fine-2": None,
        "dies-1": (WORKER_DIED, True),
        "hangs_once-1": (TIMED_OUT, True),
        "raises-1": ("unexpected error", False),
    }
    assert [(ticket, outcome.failure) for ticket, outcome in again] == [("hangs_once-1", None)]
    assert "SIGKILL" in next(str(outcome.failure) for ticket, outcome in ended if ticket == "dies-1")


def test_what_a_dead_worker_left_is_cleared_while_the_run_goes_on(tmp_path: Path) -> None:
    prepare(tmp_path)
    pool = LocalPool(1, dying_at_work)
    try:
        ended = done_by(pool, ["p"], tmp_path)
    finally:
        pool.close()
    assert [outcome.failure is not None for _, outcome in ended] == [True]
    assert len(list((tmp_path / "work").iterdir())) == 1
    assert clear_abandoned(tmp_path, "another") == 0
    assert clear_abandoned(tmp_path, order("p", tmp_path).job.name) == 1


def break_down() -> None:
    raise RuntimeError("a broken installation")


def test_workers_that_never_start_end_the_run(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    pool = LocalPool(1, moody, on_start=break_down)
    with pytest.raises(RuntimeError, match="before they are ready"):
        done_by(pool, ["fine"], tmp_path)
    pool.close()
    assert "a broken installation" in capfd.readouterr().err


def test_orders_are_small_enough_to_travel(tmp_path: Path) -> None:
    assert len(pickle.dumps(order("p" * 80, tmp_path))) < 2000


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:8786", "tcp://localhost:1", "tcp://[::1]:8786"])
def test_schedulers_of_this_computer_are_taken(address: str) -> None:
    require_loopback(address)


@pytest.mark.parametrize("address", ["tcp://192.168.0.7:8786", "tcp://0.0.0.0:8786", "tcp://127.0.0.1", "127.0.0.1:8786", "tcp://x:y", ""])
def test_other_schedulers_are_not(address: str) -> None:
    with pytest.raises(SettingsError, match="no scheduler on this computer"):
        require_loopback(address)
