"""From folders to jobs: what is new, complete, changed or still to be left alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path

from measure.jobs.failures import TOO_LARGE, UNFINISHED
from measure.jobs.journal import Event, JobRecord, Journal
from measure.jobs.memory import estimated_mb
from measure.jobs.model import Failure, Job, Recipe
from measure.jobs.outputs import remove_dead_letter
from measure.jobs.parts import Contents, contents_of, input_digest, kind_of, look_at, part_name

Bury = Callable[[str, Failure], Event]
"""Writes the dead letter of a job, by its id, and gives the event that says so."""


class Finder:
    """Looks at every folder again and again, a little at a time, and queues the jobs it finds."""

    def __init__(
        self,
        journal: Journal,
        recipe: Recipe,
        list_parts: Callable[[], Iterable[Path]],
        out: Path,
        bury: Bury,
        *,
        settle_s: float,
        give_up_after_s: float,
        memory_mb: float,
        n_threads: int,
        retry_dead: bool = False,
    ) -> None:
        self._journal, self._recipe, self._list_parts, self._out, self._bury = journal, recipe, list_parts, out, bury
        self._recipe_digest = recipe.digest
        self._settle_s, self._give_up_after_s, self._memory_mb = settle_s, give_up_after_s, memory_mb
        self._n_threads = n_threads
        self._again = {r.id for r in journal.state.jobs.values() if r.state == "dead" and r.recipe == self._recipe_digest} if retry_dead else set()
        self._sweep: Iterator[None] | None = None
        self.jobs: dict[str, Job] = {}
        """Every job that this run queued, by its id."""
        self.found: list[str] = []
        """Ids that nobody has fetched yet, in the order of their finding."""
        self.skipped: set[str] = set()
        """Folders whose part an earlier run had done or given up."""
        self.n_sweeps = 0
        self.n_settling = 0
        """Folders that the last whole look found still changing."""
        self.n_held = 0
        """Folders that the last whole look found incomplete."""
        self.sweep_s = 0.0

    @property
    def is_sweeping(self) -> bool:
        """Whether a look at all folders has begun and not ended."""
        return self._sweep is not None

    def advance(self, budget_s: float) -> None:
        """Go on looking for some time, or to the end of the folders."""
        began = time.monotonic()
        if self._sweep is None:
            self._sweep, self.sweep_s = self._look_at_all(), 0.0
        for _ in self._sweep:
            if time.monotonic() - began > budget_s:
                break
        else:
            self._sweep = None
            self.n_sweeps += 1
        self.sweep_s += time.monotonic() - began

    def _look_at_all(self) -> Iterator[None]:
        n_settling, n_held, seen = 0, 0, set()
        for folder in self._list_parts():
            seen.add(str(folder))
            try:
                state = self._look(folder)
            except OSError as error:
                state = self._hold(folder, f"it cannot be read ({error.strerror or error})")
            n_settling += state == "settling"
            n_held += state == "held"
            yield
        self._bury_vanished(seen)
        self.n_settling, self.n_held = n_settling, n_held

    def _look(self, folder: Path) -> str:
        """Look at one folder: known, settling, held or found."""
        kind = kind_of(folder)
        if kind is None:
            return self._hold(folder, "there is no session.yaml and no list of poses in it")
        contents = contents_of(folder)
        earlier = self._earlier(folder)
        if earlier is not None and earlier.fingerprint == contents.fingerprint and self._needs_nothing(earlier):
            return "known"
        look = look_at(folder, kind, contents, self._settle_s)
        if look.state == "settling":
            return "settling"
        if look.state == "held" and time.time() - contents.changed_s < self._give_up_after_s:
            return self._hold(folder, look.reason)
        job = Job(
            part=part_name(folder),
            source=folder,
            kind=kind,
            input_digest=input_digest(folder, kind, self._recipe.cell_sha256),
            fingerprint=contents.fingerprint,
            recipe_digest=self._recipe_digest,
            memory_mb=estimated_mb(contents.scan_bytes, self._n_threads),
        )
        self._register(job, self._unfit(job, look.reason if look.state == "held" else None, contents))
        return "found"

    def _earlier(self, folder: Path) -> JobRecord | None:
        """The latest job of a folder, if it was of this recipe."""
        state = self._journal.state
        record = state.jobs.get(state.by_source.get(str(folder), ""))
        return record if record is not None and record.recipe == self._recipe_digest else None

    def _needs_nothing(self, record: JobRecord) -> bool:
        if record.id in self.jobs:
            return True
        if record.state not in ("done", "dead") or record.id in self._again:
            return False
        self.skipped.add(record.source)
        return True

    def _unfit(self, job: Job, lacking: str | None, contents: Contents) -> Failure | None:
        """Why a part is given up before it is tried."""
        if lacking is not None:
            since = datetime.fromtimestamp(contents.changed_s, UTC).isoformat(timespec="seconds")
            remedy = "Finish the capture, or put an empty file COMPLETE into the folder if this is all there will be."
            return Failure(UNFINISHED, f"{lacking}; unchanged since {since}", transient=False, remedy=remedy)
        if job.memory_mb > self._memory_mb:
            reason = f"may take {job.memory_mb:.0f} MB, {self._memory_mb:.0f} MB are allowed"
            return Failure(TOO_LARGE, reason, transient=False, remedy="Allow more with --memory and --retry-dead, or use a computer with more of it.")
        return None

    def _register(self, job: Job, unfit: Failure | None) -> None:
        """Queue a job, unless it is done or was given up with these very inputs."""
        state = self._journal.state
        known = state.jobs.get(job.id)
        events: list[Event] = self._superseded(job)
        is_new = known is None or known.state in ("dead", "superseded")
        if is_new:
            values = {"source": job.source, "part": job.part, "name": job.name, "fingerprint": job.fingerprint, "recipe": job.recipe_digest}
            events.append({"event": "found", "job": job.id, "input_digest": job.input_digest, "memory_mb": round(job.memory_mb), **values})
        elif known is not None and known.fingerprint != job.fingerprint:
            events.append({"event": "seen", "job": job.id, "fingerprint": job.fingerprint})
        self._journal.write(*events)
        self._again.discard(job.id)
        if known is not None and known.state == "done":
            self.skipped.add(str(job.source))
            return
        self.jobs[job.id] = job
        if unfit is not None:
            self._journal.write(self._bury(job.id, unfit))
        elif is_new or known is None or known.state == "waiting":
            self.found.append(job.id)

    def _superseded(self, job: Job) -> list[Event]:
        """Earlier jobs of the same folder that this one takes the place of: its inputs or the recipe have changed."""
        former = self._journal.state.jobs.get(self._journal.state.by_source.get(str(job.source), ""))
        if former is None or former.id == job.id or former.state not in ("waiting", "dead"):
            return []
        remove_dead_letter(self._out, former.name)
        self.jobs.pop(former.id, None)
        return [{"event": "superseded", "job": former.id, "by": job.id}]

    def _hold(self, folder: Path, reason: str) -> str:
        held = self._journal.state.held.get(str(folder))
        if held is None or held.reason != reason:
            self._journal.write({"event": "held", "source": folder, "reason": reason})
        return "held"

    def _bury_vanished(self, seen: set[str]) -> None:
        """Jobs of an earlier run whose folder is gone would wait for ever."""
        state = self._journal.state
        for source in [source for source in state.held if source not in seen and not Path(source).exists()]:
            self._journal.write({"event": "held", "source": source, "reason": None})
        for record in list(state.jobs.values()):
            if record.state == "waiting" and record.id not in self.jobs and record.source not in seen and not Path(record.source).exists():
                gone = Failure("folder gone", f"{record.source} is gone", transient=False, remedy="Put it back; it is then found again.")
                self._journal.write(self._bury(record.id, gone))
