"""The runner: finds parts, gives jobs to workers, writes down what became of them, and survives being killed.

Exactly once in effect: an attempt works in a folder of its own and its result appears by one rename that replaces
nothing; the journal says `done` afterwards. A kill between the two leaves a result that the next start takes over, any
other kill an attempt that is made again from the same inputs.
"""

from __future__ import annotations

import heapq
import logging
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from drivers.errors import FileError
from measure.history.store import now_utc
from measure.jobs.failures import failure_of
from measure.jobs.finder import Finder
from measure.jobs.journal import Event, JobRecord, Journal
from measure.jobs.memory import budget_mb
from measure.jobs.model import DEAD_LETTER_FORMAT, Failure, Files, Order, Outcome, Recipe
from measure.jobs.outputs import clear_abandoned, prepare, read_result, remove_dead_letter, result_folder, write_dead_letter
from measure.jobs.page import write_page
from measure.jobs.pool import Executor
from measure.jobs.work import facts_of_result

_LOG = logging.getLogger(__name__)
_LOOK_S = 0.25
_PAGE_S = 30.0
_LONGEST_BACK_OFF_S = 300.0
Recorder = Callable[[Path], None]
"""Told the folder of every new result, for the history; more than once after a kill."""


@dataclass(frozen=True, slots=True)
class RunSettings:
    """How a runner goes about its work."""

    once: bool = False
    """End when there is nothing left to do; parts that are not complete are told and left."""
    finite: bool = False
    """End when every part has been measured or given up; parts that are not complete are waited for."""
    retries: int = 3
    """Further attempts after a failure that may pass."""
    back_off_s: float = 2.0
    """Before the first of them; doubled each time."""
    settle_s: float = 5.0
    """For how long nothing in a folder must have changed."""
    poll_s: float = 2.0
    """Between two looks at all folders; longer where a look takes long."""
    give_up_after_s: float = 24 * 3600.0
    """After which a part that never completes is a dead letter."""
    memory_mb: float | None = None
    """For all jobs in flight together; a share of what is free if None."""
    n_threads: int = 1
    """Of each job."""
    history: str | None = None
    """Place of the cell's history."""
    retry_dead: bool = False
    """Try again what earlier runs gave up."""


@dataclass(slots=True)
class Summary:
    """What a run came to."""

    done: int = 0
    """Parts measured by this run."""
    failed: int = 0
    """Parts given up by this run."""
    skipped: int = 0
    """Parts that an earlier run had measured or given up."""
    retried: int = 0
    """Attempts that failed and were made again."""
    rejected: int = 0
    """Of the parts measured: with the verdict reject."""
    marked: int = 0
    """Of the parts measured: whose result carries a warning."""
    dead_letters: list[dict[str, object]] = field(default_factory=list)
    waiting: list[dict[str, object]] = field(default_factory=list)
    """Parts that are not complete, and jobs that were left when the run was stopped."""
    interrupted: bool = False
    seconds: float = 0.0

    def to_json_dict(self) -> dict[str, object]:
        """The object that `--json` prints."""
        return {name: getattr(self, name) for name in self.__slots__}


class Runner:
    """One run with one recipe; `stop` may be called from a signal handler."""

    def __init__(
        self,
        out: Path,
        recipe: Recipe,
        files: Files,
        list_parts: Callable[[], Iterable[Path]],
        executor: Executor,
        settings: RunSettings,
        *,
        recorder: Recorder | None = None,
    ) -> None:
        self._out, self._recipe, self._files, self._executor, self._settings = out, recipe, files, executor, settings
        self._list_parts, self._recorder = list_parts, recorder
        self._memory_mb = budget_mb() if settings.memory_mb is None else settings.memory_mb
        self._ready: deque[str] = deque()
        self._later: list[tuple[float, str]] = []
        self._flying: dict[str, float] = {}
        """Jobs in flight, and the memory that each may take."""
        self._stops = 0
        self._next_look_s = self._next_page_s = 0.0
        self._failed_before_look = 0
        self._summary = Summary()
        self._on_event: Callable[[Summary, int], None] | None = None

    def stop(self) -> None:
        """Begin no further job and end when those in flight have; called again, end at once."""
        self._stops += 1

    def run(self, on_event: Callable[[Summary, int], None] | None = None) -> Summary:
        """Work until there is nothing left (`once`), or until `stop`.

        Args:
            on_event: told, whenever a job ends, the summary so far and how many jobs are known to be left.

        Raises:
            SettingsError: another runner is at work with this folder.
            FileError: the journal cannot be written or is broken; the same command goes on later.
        """
        began = time.monotonic()
        self._on_event = on_event
        prepare(self._out)
        with Journal(self._out) as self._journal:
            self._recover()
            settings = self._settings
            self._finder = Finder(
                self._journal,
                self._recipe,
                self._list_parts,
                self._out,
                self._bury,
                settle_s=settings.settle_s,
                give_up_after_s=settings.give_up_after_s,
                memory_mb=self._memory_mb,
                n_threads=settings.n_threads,
                retry_dead=settings.retry_dead,
            )
            while not self._is_over():
                self._look()
                self._admit()
                self._end_all(self._executor.collect(self._patience_s()))
                self._draw_page()
            clear_abandoned(self._out)
            self._summary.seconds = time.monotonic() - began
            self._close_summary()
            self._journal.write({"event": "run_ended", "done": self._summary.done, "failed": self._summary.failed})
            self._draw_page(now=True)
        return self._summary

    def _recover(self) -> None:
        """Take over what an earlier run left: results it could not tell of any more, attempts that were cut off."""
        clear_abandoned(self._out)
        events: list[Event] = [{"event": "run", "recipe": self._recipe.digest, "calibration": self._recipe.calibration_id}]
        for record in list(self._journal.state.jobs.values()):
            if record.state == "running":
                text = read_result(result_folder(self._out, record.name))
                if text is not None:
                    self._record(record)
                done: Event = {"event": "done", "job": record.id, "seconds": None, "facts": None if text is None else facts_of_result(text)}
                events.append({"event": "interrupted", "job": record.id} if text is None else done)
        self._journal.write(*events)
        for record in self._journal.state.jobs.values():
            if record.state != "dead":  # killed between `done` and this
                remove_dead_letter(self._out, record.name)

    def _look(self) -> None:
        """Look for parts: a little at a time while workers are busy, and not again too soon."""
        finder = self._finder
        if not finder.is_sweeping and time.monotonic() < self._next_look_s:
            return
        if not finder.is_sweeping:
            self._failed_before_look = self._summary.failed
        if len(self._ready) < 4 * (len(self._flying) + 1) and not self._stops:
            finder.advance(_LOOK_S)
            for job_id in finder.found:
                n_interrupted = self._journal.state.jobs[job_id].interrupted
                # what was in flight when a runner died may be what killed it: it goes to the end of the queue
                self._put_off(job_id, n_interrupted) if n_interrupted else self._ready.append(job_id)
            finder.found.clear()
        if not finder.is_sweeping:
            poll_s = min(self._settings.poll_s, self._settings.settle_s) if finder.n_settling else self._settings.poll_s
            self._next_look_s = time.monotonic() + max(poll_s, 10 * finder.sweep_s)

    def _put_off(self, job_id: str, n_times: int) -> float:
        wait_s = min(_LONGEST_BACK_OFF_S, self._settings.back_off_s * 2.0 ** (n_times - 1))
        heapq.heappush(self._later, (time.monotonic() + wait_s, job_id))
        return wait_s

    def _admit(self) -> None:
        """Give jobs to idle workers, the longest waiting first, as far as memory goes."""
        while self._later and self._later[0][0] <= time.monotonic():
            self._ready.append(heapq.heappop(self._later)[1])
        orders: list[Order] = []
        n_free = 0 if self._stops else self._executor.n_free
        while self._ready and len(orders) < n_free:
            job = self._finder.jobs.get(self._ready[0])
            if job is None or self._journal.state.jobs[job.id].state != "waiting":
                self._ready.popleft()  # its inputs changed meanwhile
                continue
            # the first in the queue is not overtaken by smaller ones, or it would wait for ever
            if self._flying and sum(self._flying.values()) + job.memory_mb > self._memory_mb:
                break
            self._ready.popleft()
            self._flying[job.id] = job.memory_mb
            attempt, settings = self._journal.state.jobs[job.id].attempts + 1, self._settings
            orders.append(Order(job, self._recipe, self._files, self._out.absolute(), attempt, settings.n_threads, settings.history))
        self._journal.write(*({"event": "started", "job": order.job.id, "attempt": order.attempt} for order in orders))
        for order in orders:
            self._executor.submit(order.job.id, order)

    def _end_all(self, ended: list[tuple[str, Outcome]]) -> None:
        """Write down what became of jobs, then tell."""
        events = [self._event_of(job_id, outcome) for job_id, outcome in ended]
        self._journal.write(*events)
        for job_id, outcome in ended:
            if outcome.failure is not None:  # a worker that died cleared nothing away
                clear_abandoned(self._out, self._journal.state.jobs[job_id].name)
        for (job_id, outcome), event in zip(ended, events, strict=True):
            self._flying.pop(job_id, None)
            if event["event"] == "done":
                self._count_done(self._journal.state.jobs[job_id], outcome)
        if ended and self._on_event is not None:
            self._on_event(self._summary, len(self._ready) + len(self._later) + len(self._flying))

    def _event_of(self, job_id: str, outcome: Outcome) -> Event:
        """The event that an outcome makes; a failed job that may succeed is put off."""
        failure, record = outcome.failure, self._journal.state.jobs[job_id]
        if failure is None:
            self._record(record)
            return {"event": "done", "job": job_id, "seconds": outcome.seconds, "worker": outcome.worker, "facts": outcome.facts}
        if failure.transient and record.attempts < self._settings.retries:
            self._summary.retried += 1
            wait_s = self._put_off(job_id, record.attempts + 1)
            return {"event": "failed", "job": job_id, "category": failure.category, "reason": failure.reason, "retry_after_s": wait_s}
        return self._bury(job_id, failure)

    def _bury(self, job_id: str, failure: Failure) -> Event:
        """Write a dead letter; the event that goes with it."""
        record = self._journal.state.jobs[job_id]
        letter: dict[str, object] = {
            "format": DEAD_LETTER_FORMAT,
            "part": record.part,
            "job": record.id,
            "source": record.source,
            "calibration": self._recipe.calibration_id,
            "category": failure.category,
            "reason": failure.reason,
            "remedy": failure.remedy,
            "attempts": record.attempts + (record.state == "running"),
            "transient": failure.transient,
            "trace": failure.trace,
            "time_utc": now_utc(),
        }
        write_dead_letter(self._out, record.name, letter)
        self._summary.failed += 1
        return {"event": "dead", "job": job_id, "category": failure.category, "reason": failure.reason}

    def _count_done(self, record: JobRecord, outcome: Outcome) -> None:
        self._summary.done += 1
        self._summary.rejected += outcome.facts.get("verdict") == "reject"
        self._summary.marked += bool(outcome.facts.get("marks"))
        remove_dead_letter(self._out, record.name)

    def _record(self, record: JobRecord) -> None:
        """Hand a result to the history, before the journal calls it done: after a kill in between it is handed over again."""
        if self._recorder is not None:
            try:
                self._recorder(result_folder(self._out, record.name))
            except Exception as error:  # the result stands; the history can be filled from it later
                _LOG.warning("%s is not in the history: %s", record.name, failure_of(error).reason)

    def _patience_s(self) -> float:
        """For how long there is nothing to do but to wait for workers."""
        if self._finder.is_sweeping and len(self._ready) < 4 * (len(self._flying) + 1):
            return 0.0
        moments = [self._next_look_s, time.monotonic() + 1.0, *(due_s for due_s, _ in self._later[:1])]
        return max(0.0, min(moments) - time.monotonic())

    def _is_over(self) -> bool:
        if self._stops:
            self._summary.interrupted = True
            return not self._flying or self._stops > 1
        if self._flying or self._ready or self._later or self._finder.is_sweeping or not self._finder.n_sweeps:
            return False
        if self._summary.failed != self._failed_before_look:
            self._next_look_s = 0.0  # a part that changed while it was measured is found anew by another look
            return False
        is_settled = not self._finder.n_settling
        return is_settled and (self._settings.once or (self._settings.finite and not self._finder.n_held))

    def _draw_page(self, *, now: bool = False) -> None:
        if now or time.monotonic() >= self._next_page_s:
            with suppress(FileError):  # a full disk ends the run where results are written, not here
                write_page(self._out, self._journal.state, is_running=not now)
            self._next_page_s = time.monotonic() + _PAGE_S

    def _close_summary(self) -> None:
        """What stands in the end, earlier runs included."""
        state, summary = self._journal.state, self._summary
        mine = [record for record in state.jobs.values() if record.recipe == self._recipe.digest]
        summary.skipped = len(self._finder.skipped)
        summary.dead_letters = [
            {"job": r.id, "part": r.part, "source": r.source, "category": r.category, "reason": r.reason} for r in mine if r.state == "dead"
        ]
        summary.waiting = [{"source": held.source, "reason": held.reason} for held in state.held.values()]
        summary.waiting += [{"source": r.source, "reason": "its turn did not come"} for r in mine if r.state in ("waiting", "running")]
