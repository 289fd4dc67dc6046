"""Worker processes of our own, one pipe each: the death of one costs one attempt of one job.

concurrent.futures gives up every job in flight when one worker dies, and cannot end one that hangs; hence this. Workers
are spawned, not forked (threads of numba and BLAS do not survive a fork), replaced after some jobs (libraries leak), and
end by themselves when the runner is killed.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Protocol

from measure.jobs.failures import TIMED_OUT, WORKER_DIED, failure_of
from measure.jobs.model import Failure, Order, Outcome, Work

RECYCLE_AFTER = 200
_END_WAIT_S = 5.0
_READY = "ready"
OnStart = Callable[[], None]


class Executor(Protocol):
    """Something that does jobs elsewhere; `LocalPool` and `measure.jobs.dask_pool.DaskPool` are some."""

    @property
    def n_free(self) -> int:
        """How many jobs may be submitted now."""
        ...

    def submit(self, ticket: str, order: Order) -> None:
        """Begin a job; `collect` gives its outcome under the ticket."""
        ...

    def collect(self, timeout_s: float) -> list[tuple[str, Outcome]]:
        """What has ended, waiting up to `timeout_s` for the first; every ticket comes back exactly once."""
        ...

    def close(self) -> None:
        """Let go of the workers; jobs still in flight may or may not come to their end."""
        ...


@dataclass(slots=True)
class _Worker:
    process: SpawnProcess
    pipe: Connection
    ready: bool = False
    ticket: str | None = None
    began_s: float = 0.0
    n_jobs: int = 0


class LocalPool:
    """Processes on this computer; use `close` at the end."""

    def __init__(self, n_workers: int, work: Work, *, on_start: OnStart | None = None, timeout_s: float = 900.0) -> None:
        """Start the first worker; the others follow when its first job has ended, so that only one compiles what all use.

        Args:
            n_workers: processes.
            work: what they do.
            on_start: done once by each before its first job.
            timeout_s: after which a worker is killed and its job has failed.
        """
        self._context = multiprocessing.get_context("spawn")
        self._n_workers, self._work, self._on_start, self._timeout_s = n_workers, work, on_start, timeout_s
        self._warm = False
        self._n_stillborn = 0
        self._finished: list[tuple[str, Outcome]] = []
        self._workers: list[_Worker] = [self._spawned()]

    @property
    def n_free(self) -> int:
        """Workers that are ready and idle."""
        return sum(worker.ready and worker.ticket is None for worker in self._workers)

    def submit(self, ticket: str, order: Order) -> None:
        """Give a job to an idle worker.

        Raises:
            ValueError: none is idle: `n_free` was not asked.
        """
        worker = next((worker for worker in self._workers if worker.ready and worker.ticket is None), None)
        if worker is None:
            msg = "no worker is idle"
            raise ValueError(msg)
        worker.ticket, worker.began_s = ticket, time.monotonic()
        try:
            worker.pipe.send(order)
        except OSError:
            self._bury(worker)

    def collect(self, timeout_s: float) -> list[tuple[str, Outcome]]:
        """Outcomes since the last call; replaces workers that died, hang or have done enough.

        Raises:
            RuntimeError: workers die before they are ready: the installation is broken.
        """
        if not self._finished:
            watched: list[Connection | int] = [*(w.pipe for w in self._workers), *(w.process.sentinel for w in self._workers)]
            found = set(wait(watched, max(0.0, min(timeout_s, self._until_next_timeout()))))
            for worker in list(self._workers):
                self._hear(worker, worker.pipe in found, worker.process.sentinel in found)
        while self._warm and len(self._workers) < self._n_workers:
            self._workers.append(self._spawned())
        if not self._workers:
            self._workers.append(self._spawned())
        finished, self._finished = self._finished, []
        return finished

    def close(self) -> None:
        """End the workers; those at work are killed, which leaves nothing half done."""
        for worker in self._workers:
            if worker.ticket is not None:
                worker.process.kill()
            worker.pipe.close()
        for worker in self._workers:
            worker.process.join(_END_WAIT_S)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()
        self._workers.clear()

    def _hear(self, worker: _Worker, has_said: bool, has_ended: bool) -> None:
        if has_said:
            try:
                message = worker.pipe.recv()
            except (EOFError, OSError):
                self._bury(worker)
                return
            if message == _READY:
                worker.ready = True
                self._n_stillborn = 0
            else:
                self._give(worker, message)
        elif has_ended:
            self._bury(worker)
        elif worker.ticket is not None and time.monotonic() - worker.began_s > self._timeout_s:
            worker.process.kill()
            reason = f"gave no result within {self._timeout_s:g} s and was ended"
            self._bury(worker, Failure(TIMED_OUT, reason, transient=True, remedy="Allow more with --timeout; look at the part."))

    def _give(self, worker: _Worker, outcome: Outcome) -> None:
        """Hand over an outcome; a worker that has done enough is let go."""
        if worker.ticket is not None:
            self._finished.append((worker.ticket, outcome))
        worker.ticket = None
        worker.n_jobs += 1
        self._warm = True
        if worker.n_jobs >= RECYCLE_AFTER:
            self._workers.remove(worker)
            worker.pipe.close()
            worker.process.join(_END_WAIT_S)

    def _bury(self, worker: _Worker, failure: Failure | None = None) -> None:
        """Take a dead worker out; its job, if any, has failed."""
        self._workers.remove(worker)
        worker.process.join(_END_WAIT_S)
        worker.pipe.close()
        if worker.ticket is not None:
            self._warm = True
            ended = _how_it_ended(worker.process.exitcode)
            why = failure or Failure(WORKER_DIED, ended, transient=True, remedy="Fewer --workers, if memory ran out.")
            seconds = time.monotonic() - worker.began_s
            self._finished.append((worker.ticket, Outcome(seconds, f"process {worker.process.pid}", failure=why)))
        elif not worker.ready:
            self._n_stillborn += 1
            if self._n_stillborn > self._n_workers:
                msg = f"workers end before they are ready ({_how_it_ended(worker.process.exitcode)})"
                raise RuntimeError(msg)

    def _until_next_timeout(self) -> float:
        busy = [worker.began_s + self._timeout_s - time.monotonic() for worker in self._workers if worker.ticket is not None]
        return max(0.0, min(busy, default=self._timeout_s)) + 0.01

    def _spawned(self) -> _Worker:
        ours, theirs = self._context.Pipe()
        # each of several processes that share the cores: more threads would only wait for each other
        threads = max(1, (os.cpu_count() or 1) // self._n_workers)
        process = self._context.Process(target=_serve, args=(theirs, self._work, self._on_start, threads), daemon=True)
        process.start()
        theirs.close()
        return _Worker(process, ours)


def _how_it_ended(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        return f"its worker process was ended by {signal.Signals(-exit_code).name}"
    return f"its worker process ended with exit code {exit_code}"


def _serve(pipe: Connection, work: Work, on_start: OnStart | None, threads: int) -> None:
    """Body of a worker: load the program, then job after job until the pipe closes."""
    # Ctrl-C at the runner's terminal reaches the whole group; the runner decides when its workers end
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.environ.setdefault("NUMBA_NUM_THREADS", str(threads))
    if on_start is not None:
        on_start()
    with suppress(EOFError, OSError):  # the runner closed the pipe: it wants no more
        pipe.send(_READY)
        while True:
            pipe.send(_done(work, pipe.recv()))


def _done(work: Work, order: Order) -> Outcome:
    began = time.monotonic()
    try:
        return work(order)
    except Exception as error:  # work should tell, not raise; a worker outlives it all the same
        return Outcome(time.monotonic() - began, f"process {os.getpid()}", failure=failure_of(error))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
