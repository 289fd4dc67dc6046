"""Runners and workers killed at any moment: every good part once, every bad one told, nothing lost, no partial file."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from drivers.files.ply import read_ply
from drivers.files.session import read_session
from measure.jobs.dask_pool import DaskPool
from measure.jobs.failures import WORKER_DIED
from tests.support.job_works import moody_at_work
from tests.support.jobs import Parts, make_parts, run_jobs, truncate_scan
from tests.support.source import ROOT

PATIENCE_S = 1200.0


@contextmanager
def started(*command: str) -> Iterator[subprocess.Popen[str]]:
    """A program of ours in a process group of its own, ended with all its children at the end."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen(
        [sys.executable, *command], cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as child:
        try:
            yield child
        finally:
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)


def events(out: Path) -> list[dict[str, object]]:
    """The whole lines of a journal, also while it is written."""
    with suppress(FileNotFoundError):
        return [json.loads(line) for line in (out / "journal.jsonl").read_bytes().split(b"\n")[:-1]]
    return []


def n_over(out: Path) -> int:
    return sum(event["event"] in ("done", "dead") for event in events(out))


def wait_until_over(out: Path, n: int, child: subprocess.Popen[str]) -> None:
    end = time.monotonic() + PATIENCE_S
    while n_over(out) < n:
        assert child.poll() is None, child.communicate()
        assert time.monotonic() < end, f"{n_over(out)} of {n} jobs"
        time.sleep(0.01)


def kill_runner(out: Path, n: int, command: Sequence[str]) -> None:
    """Start a runner and end it, and it alone, with SIGKILL when `n` jobs are over."""
    with started(*command) as child:
        wait_until_over(out, n, child)
        child.kill()
        child.wait()
        # its workers see that it is gone and end by themselves; some may be in the middle of a part
        time.sleep(0.05)


def last_run(out: Path, command: Sequence[str], kill_worker_at: int) -> dict[str, object]:
    """A run to the end in which a worker is killed; its summary."""
    with started(*command) as child:
        wait_until_over(out, kill_worker_at, child)
        kill_a_worker(out)
        text, err = child.communicate(timeout=PATIENCE_S)
    assert child.returncode in (0, 3), err
    summary: dict[str, object] = json.loads(text)
    return summary


def kill_a_worker(out: Path) -> None:
    """The process that ended the latest job, or one before it if that has been let go."""
    for event in reversed(events(out)):
        if event["event"] == "done" and event.get("worker"):
            with suppress(ProcessLookupError):
                os.kill(int(str(event["worker"]).rpartition(":")[2]), signal.SIGKILL)
                return
    pytest.fail("no worker was found to be killed")


def check(parts: Parts, out: Path, summary: dict[str, object]) -> None:
    """Against what was put in: each good part has one result of its own inputs, each bad one a reason, and nothing else lies about."""
    results = {path.name.rpartition("-")[0]: path for path in (out / "results").iterdir()}
    assert sorted(results) == sorted(parts.good)
    assert len(list((out / "results").iterdir())) == len(parts.good)
    letters = [json.loads(path.read_text(encoding="utf-8")) for path in (out / "dead_letters").iterdir()]
    assert sorted(letter["part"] for letter in letters) == sorted(parts.spoiled)
    told = summary["dead_letters"]
    assert isinstance(told, list)
    assert sorted(letter["part"] for letter in told) == sorted(parts.spoiled)
    for part, folder in results.items():
        text = (folder / "result.json").read_text(encoding="utf-8")
        assert json.loads(text)
        assert read_session(parts.folder / part).digest in text
    story = events(out)
    jobs = {str(event["job"]): str(event["part"]) for event in story if event["event"] == "found"}
    assert sorted(jobs[str(event["job"])] for event in story if event["event"] == "done") == sorted(parts.good)
    assert sorted(jobs[str(event["job"])] for event in story if event["event"] == "dead") == sorted(parts.spoiled)
    assert summary["waiting"] == []
    assert [path for path in out.rglob("*") if path.name.endswith(".tmp")] == []
    assert list((out / "work").iterdir()) == []


def test_two_kills_of_the_runner_and_one_of_a_worker(tmp_path: Path) -> None:
    made = make_parts(tmp_path, 24, 0, seed=11)
    spoiled = {made.good[i]: "truncated scan" for i in (3, 9, 17)}
    for name in spoiled:
        truncate_scan(made.folder / name)
    parts = Parts(made.folder, made.calibration, tuple(name for name in made.good if name not in spoiled), spoiled)
    command, out = ("-m", "tests.support.jobs_once", str(parts.folder), str(tmp_path / "out")), tmp_path / "out"
    kill_runner(out, 5, command)
    kill_runner(out, 12, command)
    check(parts, out, last_run(out, command, 16))
    assert sum(event["event"] == "run" for event in events(out)) == 3


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def dask_cluster(folder: Path, n_workers: int) -> Iterator[str]:
    """A scheduler and worker processes on the loopback, each worker replaced by its nanny when it dies."""
    address = f"tcp://127.0.0.1:{free_port()}"
    quiet = ["--host", "127.0.0.1", "--no-dashboard"]
    workers = ["--nworkers", str(n_workers), "--nthreads", "1", "--local-directory", str(folder / "dask")]
    logs = [(folder / name).open("w", encoding="utf-8") for name in ("scheduler.log", "workers.log")]
    commands = [["scheduler", *quiet, "--port", address.rpartition(":")[2]], ["worker", address, *quiet, *workers]]
    children = [
        subprocess.Popen([sys.executable, "-m", "dask", *command], cwd=ROOT, stdout=log, stderr=log, start_new_session=True)
        for command, log in zip(commands, logs, strict=True)
    ]
    try:
        yield address
    finally:
        for child, log in zip(reversed(children), reversed(logs), strict=True):
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()
            log.close()


@pytest.mark.qualify
@pytest.mark.parametrize("n_parts", [1000])
@pytest.mark.parametrize("where", ["pool", "dask"])
def test_a_thousand_jobs_with_kills(tmp_path: Path, n_parts: int, where: str) -> None:
    seed = int.from_bytes(os.urandom(4))
    print("seed", seed)
    parts = make_parts(tmp_path, n_parts, n_parts // 20, seed)
    out = tmp_path / "out"
    run = ["-m", "measure.cli", "jobs", "run", str(parts.folder), "--calibration", str(parts.calibration), "-o", str(out), "--once", "--json"]
    run += ["--settle", "0.1", "--workers", "2"]
    began = time.monotonic()
    if where == "pool":
        go_through(parts, out, run)
    else:
        with dask_cluster(tmp_path, 2) as address:
            go_through(parts, out, [*run, "--scheduler", address])
    kinds = [event["event"] for event in events(out)]
    seconds = time.monotonic() - began
    print(f"{n_parts} jobs by {where} in {seconds:.0f} s, {kinds.count('interrupted')} interrupted, {kinds.count('failed')} failed attempts")


@pytest.mark.qualify
def test_a_job_that_kills_every_dask_worker_is_given_up_and_the_others_done(tmp_path: Path) -> None:
    made = make_parts(tmp_path, 4, 0, seed=12)
    (made.folder / made.good[1]).rename(made.folder / "dies-1")
    good = tuple(sorted({*made.good} - {made.good[1]}))
    parts = Parts(made.folder, made.calibration, good, {"dies-1": "kills its worker"})
    with dask_cluster(tmp_path, 2) as address:
        pool = DaskPool(address, moody_at_work, timeout_s=300.0)
        try:
            summary = run_jobs(parts, tmp_path / "out", pool, retries=0)
        finally:
            pool.close()
    assert (summary.done, summary.failed) == (3, 1)
    assert [letter["category"] for letter in summary.dead_letters] == [WORKER_DIED]
    assert "KilledWorker" in str(summary.dead_letters[0]["reason"])
    assert {path.name.rpartition("-")[0] for path in (tmp_path / "out" / "results").iterdir()} == set(good)
    assert list((tmp_path / "out" / "work").iterdir()) == []


def go_through(parts: Parts, out: Path, run: Sequence[str]) -> None:
    n = len(parts.good) + len(parts.spoiled)
    kill_runner(out, n // 4, run)
    kill_runner(out, n // 2, run)
    summary = last_run(out, run, 3 * n // 4)
    check(parts, out, summary)
    for part in np.random.default_rng(0).choice(parts.good, min(20, len(parts.good)), replace=False):
        cloud = read_ply(next((out / "results").glob(f"{part}-*")) / "cloud.ply")
        assert f"session {read_session(parts.folder / part).digest}" in cloud.comments
    shutil.rmtree(out / "results")  # the disk of a thousand results is not kept by pytest
