"""journal.jsonl: everything that happened to every job, a line an event, on disk before anything follows from it.

Append-only. Each line is fsynced; one that a kill cut off is taken out at the next start. The state is whatever the lines
say, so replaying them after a kill gives the state at the kill.
"""

from __future__ import annotations

import fcntl
import logging
import os
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

from drivers.errors import FileError, SettingsError
from drivers.files.checks import parse_json_object
from drivers.files.disk import decode_text, read_bytes, sync_folder
from measure.console import json_text
from measure.history.store import now_utc

_LOG = logging.getLogger(__name__)
JOURNAL = "journal.jsonl"
JobState = Literal["waiting", "running", "done", "dead", "superseded"]
Event = Mapping[str, object]


@dataclass(frozen=True, slots=True)
class JobRecord:
    """What is known of one job."""

    id: str
    name: str
    part: str
    source: str
    fingerprint: str
    recipe: str
    found_utc: str
    state: JobState = "waiting"
    attempts: int = 0
    """That ended in a failure of their own."""
    interrupted: int = 0
    """How often the runner died while it was at work."""
    changed_utc: str = ""
    seconds: float | None = None
    reason: str | None = None
    category: str | None = None
    facts: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class HeldPart:
    """A folder that is left alone because it is not complete."""

    source: str
    reason: str
    since_utc: str


class State:
    """Jobs and held parts, as the events so far make them."""

    def __init__(self) -> None:
        self.jobs: dict[str, JobRecord] = {}
        self.by_source: dict[str, str] = {}
        """The latest job of every folder."""
        self.held: dict[str, HeldPart] = {}
        self.n_runs = 0
        self.retries: Counter[str] = Counter()
        """Attempts that failed and were made again, by category."""

    def apply(self, event: Event) -> None:
        """Follow one event; kinds that this version does not know change nothing."""
        kind, time_utc = str(event.get("event")), str(event.get("time_utc"))
        if kind == "run":
            self.n_runs += 1
        elif kind == "held":
            self._hold(str(event["source"]), None if event.get("reason") is None else str(event["reason"]), time_utc)
        elif kind == "found":
            self._find(event, time_utc)
        elif (record := self.jobs.get(str(event.get("job")))) is not None:
            self.jobs[record.id] = _after(record, kind, event, time_utc)
            self.retries.update([str(event.get("category"))] if kind == "failed" else [])

    def _hold(self, source: str, reason: str | None, time_utc: str) -> None:
        if reason is None:
            self.held.pop(source, None)
            return
        since = self.held[source].since_utc if source in self.held else time_utc
        self.held[source] = HeldPart(source, reason, since)

    def _find(self, event: Event, time_utc: str) -> None:
        part, source, fingerprint, recipe, name = (str(event[key]) for key in ("part", "source", "fingerprint", "recipe", "name"))
        record = JobRecord(str(event["job"]), name, part, source, fingerprint, recipe, found_utc=time_utc, changed_utc=time_utc)
        self.held.pop(record.source, None)
        self.jobs[record.id] = record
        self.by_source[record.source] = record.id


def _after(record: JobRecord, kind: str, event: Event, time_utc: str) -> JobRecord:
    """A job's record after an event of its own."""
    changed = replace(record, changed_utc=time_utc)
    why = replace(changed, reason=_text(event, "reason"), category=_text(event, "category"))
    seconds, facts = event.get("seconds"), event.get("facts")
    after = {
        "started": replace(changed, state="running"),
        "interrupted": replace(changed, state="waiting", interrupted=record.interrupted + 1),
        "failed": replace(why, state="waiting", attempts=record.attempts + 1),
        "dead": replace(why, state="dead"),
        "superseded": replace(changed, state="superseded"),
        "seen": replace(record, fingerprint=str(event.get("fingerprint"))),
        "done": replace(
            why,
            state="done",
            seconds=float(seconds) if isinstance(seconds, int | float) else None,
            facts=facts if isinstance(facts, Mapping) else {},
        ),
    }
    return after.get(kind, record)


def _text(event: Event, key: str) -> str | None:
    return None if event.get(key) is None else str(event[key])


def read_state(out: Path) -> State:
    """The state of a folder of results, also while a runner is at work.

    Raises:
        FileError: there is no journal, or a line of it is broken.
    """
    state = State()
    for event in _events(out / JOURNAL):
        state.apply(event)
    return state


def is_running(out: Path) -> bool:
    """Whether a runner holds the journal."""
    with FileIO(out / JOURNAL, "rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _events(path: Path) -> list[Event]:
    """Every whole line; a last one without its end is still being written, or was cut off by a kill."""
    lines = read_bytes(path).split(b"\n")[:-1]
    return [parse_json_object(decode_text(line, file=path), file=path, where=f"line {i}") for i, line in enumerate(lines, start=1)]


class Journal:
    """The one writer of a journal, and the state that its events made; use as a context."""

    def __init__(self, out: Path) -> None:
        """Open or begin the journal of a folder that exists.

        Raises:
            SettingsError: another runner is at work there.
            FileError: it cannot be written, or a line other than the last is broken.
        """
        self._path = out / JOURNAL
        self._stream = _open_locked(self._path)
        try:
            _cut_off_half_line(self._stream, self._path)
            sync_folder(out)
            self.state = read_state(out)
        except BaseException:
            self._stream.close()
            raise

    def write(self, *events: Event) -> None:
        """Put events on disk, then let the state follow them.

        Raises:
            FileError: the disk is full or gone; nothing of them counts then.
        """
        if not events:
            return
        stamped = [{"time_utc": now_utc(), **event} for event in events]
        data = "".join(json_text(event) + "\n" for event in stamped).encode()
        end = self._stream.seek(0, os.SEEK_END)
        try:
            if self._stream.write(data) != len(data):
                raise OSError(28, "No space left on device")
            os.fsync(self._stream.fileno())
        except OSError as error:
            self._stream.truncate(end)
            remedy = "Make room and run the same command again: it goes on where it stopped."
            raise FileError(f"cannot be written ({error.strerror or error})", file=self._path, remedy=remedy) from error
        for event in stamped:
            self.state.apply(event)

    def close(self) -> None:
        """Let go of the journal; safe to call twice."""
        self._stream.close()

    def __enter__(self) -> Self:
        """The journal itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close."""
        self.close()


def _open_locked(path: Path) -> FileIO:
    try:
        stream = FileIO(path, "ab+")
    except OSError as error:
        raise FileError(f"cannot be opened ({error.strerror})", file=path, remedy="Choose another folder with -o.") from error
    # `jobs status` asks for the lock for a moment: a runner that begins then looks again
    for last in (False, False, False, True):
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
        except BlockingIOError as error:
            if last:
                stream.close()
                remedy = "End it first, or name another folder with -o."
                raise SettingsError("another runner is at work with this folder", file=path.parent, remedy=remedy) from error
            time.sleep(0.05)
    return stream


def _cut_off_half_line(stream: FileIO, path: Path) -> None:
    data = read_bytes(path)
    whole = data.rfind(b"\n") + 1
    if whole < len(data):
        _LOG.warning("%s: the last line was cut off by a kill and is taken out", path)
        stream.truncate(whole)
        os.fsync(stream.fileno())
