"""The same jobs on a Dask cluster: orders of paths and digests go out, facts come back, results go to the shared disk.

Dask has no lock on its door: whoever reaches a scheduler runs programs there. Plain tcp addresses are therefore taken on
this computer only; another computer's scheduler is reached through a tunnel (docs/jobs.md).
"""

from __future__ import annotations

import importlib
import ipaddress
import logging
import queue
import time
import uuid
from collections.abc import Callable, Mapping
from typing import Protocol
from urllib.parse import urlsplit

from drivers.errors import FileError, SettingsError
from measure.jobs.failures import TIMED_OUT, WORKER_DIED, failure_of
from measure.jobs.model import Failure, Order, Outcome, Work


class _Future(Protocol):
    """What is used of `distributed.Future`."""

    def result(self, timeout: float) -> object: ...

    def cancel(self) -> None: ...

    def release(self) -> None: ...

    def add_done_callback(self, fn: Callable[[object], None]) -> None: ...


class _Client(Protocol):
    """What is used of `distributed.Client`."""

    status: str

    def scheduler_info(self, n_workers: int) -> Mapping[str, Mapping[str, object]]: ...

    def submit(self, func: Work, order: Order, *, pure: bool, key: str) -> _Future: ...

    def close(self, timeout: float) -> None: ...


_LOG = logging.getLogger(__name__)
_LOOK_S = 1.0
_LOST = ("KilledWorker", "CancelledError", "FutureCancelledError", "TimeoutError", "CommClosedError")


class DaskPool:
    """Workers of a Dask scheduler; start them with one thread each. Use `close` at the end."""

    def __init__(self, address: str, work: Work, *, timeout_s: float = 900.0, answer_s: float = 10.0) -> None:
        """Connect.

        Args:
            address: of the scheduler, as tcp://127.0.0.1:8786.
            work: what is done, a function of a module that the workers can import.
            timeout_s: after which a job has failed.
            answer_s: for how long the scheduler is waited for.

        Raises:
            SettingsError: no loopback address, or dask is not installed.
            FileError: nobody answers.
        """
        require_loopback(address)
        try:
            distributed = importlib.import_module("distributed")
        except ImportError as error:
            raise SettingsError("dask is not installed", where="--scheduler", remedy="pip install 'spherecal[dask]'") from error
        self._address, self._work, self._timeout_s = address, work, timeout_s
        self._ended: queue.Queue[str] = queue.Queue()
        self._flying: dict[str, tuple[_Future, float]] = {}
        self._n_workers, self._looked_s, self._missed = 0, -_LOOK_S, False
        try:
            self._client: _Client = distributed.Client(address, timeout=answer_s, set_as_default=False)
        except (OSError, TimeoutError) as error:
            remedy = f"Start one: dask scheduler --host 127.0.0.1, and workers: dask worker {address} --nworkers 2 --nthreads 1."
            raise FileError("no Dask scheduler answers", file=address, remedy=remedy) from error

    @property
    def n_free(self) -> int:
        """Workers of the cluster that none of our jobs is meant for."""
        if time.monotonic() - self._looked_s >= _LOOK_S:
            self._n_workers, self._looked_s = len(self._client.scheduler_info(n_workers=-1)["workers"]), time.monotonic()
            if not self._n_workers and not self._missed:
                _LOG.warning("the Dask scheduler at %s has no workers; jobs wait for them", self._address)
            self._missed = not self._n_workers
        return self._n_workers - len(self._flying)

    def submit(self, ticket: str, order: Order) -> None:
        """Send an order; which worker takes it is Dask's business."""
        # a key of its own for every attempt: results of an attempt that was given up must not pass for another's
        future = self._client.submit(self._work, order, pure=False, key=f"spherecal-{order.job.name}-{uuid.uuid4().hex}")
        self._flying[ticket] = (future, time.monotonic())
        future.add_done_callback(lambda _future: self._ended.put(ticket))

    def collect(self, timeout_s: float) -> list[tuple[str, Outcome]]:
        """Outcomes since the last call; a worker that died with a job is a failure of that attempt.

        Raises:
            FileError: the scheduler is gone; what was in flight is done again by the next run.
        """
        tickets = []
        try:
            tickets.append(self._ended.get(timeout=max(0.0, min(timeout_s, _LOOK_S))))
            while True:
                tickets.append(self._ended.get_nowait())
        except queue.Empty:
            pass
        if self._client.status not in ("running", "connecting"):
            raise FileError("the Dask scheduler is gone", file=self._address, remedy="Start it again, then the same command.")
        finished = [(ticket, self._outcome(*self._flying.pop(ticket))) for ticket in dict.fromkeys(tickets) if ticket in self._flying]
        late = [ticket for ticket, (_future, began_s) in self._flying.items() if time.monotonic() - began_s > self._timeout_s]
        return [*finished, *((ticket, self._given_up(*self._flying.pop(ticket))) for ticket in late)]

    def close(self) -> None:
        """Let go of the cluster; what is still in flight there is cancelled or ends unheard."""
        for future, _began_s in self._flying.values():
            future.cancel()
        self._flying.clear()
        self._client.close(timeout=2)

    def _outcome(self, future: _Future, began_s: float) -> Outcome:
        try:
            outcome = future.result(timeout=5)
        except Exception as error:
            # workers died with it, or the cluster lost it; else what a worker itself could not do, as to import the program
            failure = failure_of(error)
            lost = Failure(WORKER_DIED, failure.reason[:300], transient=True, remedy="Look at the workers' logs and their memory.")
            return _failed(began_s, lost if type(error).__name__ in _LOST else failure)
        finally:
            future.release()
        return outcome if isinstance(outcome, Outcome) else _failed(began_s, Failure("unexpected answer", repr(outcome)[:200], transient=False))

    def _given_up(self, future: _Future, began_s: float) -> Outcome:
        future.cancel()
        reason = f"gave no result within {self._timeout_s:g} s"
        return _failed(began_s, Failure(TIMED_OUT, reason, transient=True, remedy="Allow more with --timeout."))


def require_loopback(address: str) -> None:
    """Refuse schedulers that others could reach too.

    Raises:
        SettingsError: the address is not tcp:// on this computer.
    """
    parts = urlsplit(address)
    host = parts.hostname or ""
    try:
        local = host == "localhost" or ipaddress.ip_address(host).is_loopback
        local = local and parts.scheme == "tcp" and parts.port is not None
    except ValueError:
        local = False
    if not local:
        raise SettingsError(
            f"{address!r} is no scheduler on this computer",
            where="--scheduler",
            remedy="Dask lets everybody in who reaches it: use tcp://127.0.0.1:PORT, through an SSH tunnel for another computer.",
        )


def _failed(began_s: float, failure: Failure) -> Outcome:
    return Outcome(time.monotonic() - began_s, "dask", failure=failure)
