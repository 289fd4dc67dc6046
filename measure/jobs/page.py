"""The throughput page: parts per hour, durations, failures by reason, what waits longest; one file without references."""

from __future__ import annotations

import datetime
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.files.disk import write_text_atomic
from measure.jobs.journal import HeldPart, JobRecord, State

if TYPE_CHECKING:
    from jinja2 import Template

PAGE = "throughput.html"
_HOURS = 48
_BINS = 24
_MOST_ROWS = 25
_HOUR_S = 3600.0


@dataclass(frozen=True, slots=True)
class Throughput:
    """The figures of a folder of results."""

    n_done: int
    n_dead: int
    n_waiting: int
    """Complete and not begun, or to be tried again."""
    n_running: int
    n_held: int
    n_marked: int
    n_rejected: int
    last_hour: int
    """Parts done within the last hour."""
    best_hour: int
    median_s: float | None
    slow_s: float | None
    """95 of 100 jobs took no longer."""
    longest_s: float | None
    oldest_waiting_s: float | None
    """Since the part was found complete."""
    oldest_waiting: str | None
    failures: tuple[tuple[str, int], ...]
    """Dead letters by category, the most frequent first."""
    retries: tuple[tuple[str, int], ...]
    """Attempts that were made again, by category."""

    def to_json_dict(self) -> dict[str, object]:
        """The object that `jobs status --json` prints, but for the lists."""
        pairs = {"failures": dict(self.failures), "retries": dict(self.retries)}
        return {name: getattr(self, name) for name in self.__slots__ if name not in pairs} | pairs


@dataclass(frozen=True, slots=True)
class Bar:
    """One bar of a chart, in the chart's own units."""

    x: float
    width: float
    height: float
    title: str


@dataclass(frozen=True, slots=True)
class Chart:
    """Bars over an axis; 640 x 160."""

    bars: tuple[Bar, ...]
    labels: tuple[tuple[float, str, str], ...]
    """(x, text, SVG's text-anchor) under the axis."""
    top: str
    """What the highest bar stands for."""


def throughput(state: State, now: datetime.datetime) -> Throughput:
    """Count what a journal tells."""
    jobs = list(state.jobs.values())
    done = [job for job in jobs if job.state == "done"]
    dead = [job for job in jobs if job.state == "dead"]
    waiting = [job for job in jobs if job.state == "waiting"]
    seconds = sorted(job.seconds for job in done if job.seconds is not None)
    oldest = min(waiting, key=lambda job: job.found_utc, default=None)
    by_hour = Counter(math.floor(_age_s(job.changed_utc, now) / _HOUR_S) for job in done)
    return Throughput(
        n_done=len(done),
        n_dead=len(dead),
        n_waiting=len(waiting),
        n_running=sum(job.state == "running" for job in jobs),
        n_held=len(state.held),
        n_marked=sum(bool(job.facts.get("marks")) for job in done),
        n_rejected=sum(job.facts.get("verdict") == "reject" for job in done),
        last_hour=by_hour[0],
        best_hour=max(by_hour.values(), default=0),
        median_s=_quantile(seconds, 0.5),
        slow_s=_quantile(seconds, 0.95),
        longest_s=_quantile(seconds, 1.0),
        oldest_waiting_s=None if oldest is None else _age_s(oldest.found_utc, now),
        oldest_waiting=None if oldest is None else oldest.part,
        failures=tuple(Counter(job.category or "other" for job in dead).most_common()),
        retries=tuple(state.retries.most_common()),
    )


def write_page(out: Path, state: State, *, is_running: bool, now: datetime.datetime | None = None) -> Path:
    """Write throughput.html into a folder of results, whole or not at all.

    Raises:
        FileError: the folder is not writable.
    """
    path = out / PAGE
    write_text_atomic(path, render(state, is_running=is_running, now=now or datetime.datetime.now(datetime.UTC), folder=out))
    return path


def render(state: State, *, is_running: bool, now: datetime.datetime, folder: Path) -> str:
    """The HTML text; every text on it is escaped."""
    figures = throughput(state, now)
    jobs = list(state.jobs.values())
    return _template().render(
        figures=figures,
        folder=str(folder),
        is_running=is_running,
        tone="bad" if figures.n_dead else "unsure" if figures.n_marked or figures.n_held else "good",
        hours=hours_chart(jobs, now),
        durations=durations_chart(sorted(job.seconds for job in jobs if job.state == "done" and job.seconds is not None)),
        dead=_latest([job for job in jobs if job.state == "dead"]),
        marked=_latest([job for job in jobs if job.state == "done" and job.facts.get("marks")]),
        waiting=sorted((job for job in jobs if job.state == "waiting"), key=lambda job: job.found_utc)[:_MOST_ROWS],
        held=_held(state),
        ages={job.id: _age_s(job.found_utc, now) for job in jobs if job.state == "waiting"},
        held_ages={part.source: _age_s(part.since_utc, now) for part in state.held.values()},
        now=now.isoformat(timespec="seconds").replace("+00:00", "Z"),
    )


@lru_cache(maxsize=1)
def _template() -> Template:
    """The page's template, compiled once a process: a runner draws the page again and again."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(loader=PackageLoader("measure"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"duration": duration_text, "moment": lambda time_utc: time_utc[:16].replace("T", " ")}
    return environment.get_template("jobs.html.j2")


def hours_chart(jobs: Sequence[JobRecord], now: datetime.datetime) -> Chart:
    """Parts done in each of the last 48 hours, the present hour to the right."""
    ages = [math.floor(_age_s(job.changed_utc, now) / _HOUR_S) for job in jobs if job.state == "done"]
    counts = Counter(age for age in ages if 0 <= age < _HOURS)
    most, step = max(counts.values(), default=1), 640.0 / _HOURS
    bars = tuple(
        Bar((_HOURS - 1 - age) * step + 1, step - 2, 160.0 * n / most, f"{n} parts, {age} to {age + 1} h ago") for age, n in sorted(counts.items())
    )
    labels = ((0.0, "48 h ago", "start"), (320.0, "24 h ago", "middle"), (640.0, "now", "end"))
    return Chart(bars, labels, f"{most} parts per hour")


def durations_chart(seconds: Sequence[float]) -> Chart:
    """How many jobs took how long; what is beyond twice the 95th of 100 counts in the last bar."""
    slow = _quantile(seconds, 0.95)
    longest = max(2.0 * slow, 1e-3) if slow is not None else 1.0
    counts = Counter(min(int(_BINS * value / longest), _BINS - 1) for value in seconds)
    most, step = max(counts.values(), default=1), 640.0 / _BINS
    bars = tuple(
        Bar(i * step + 1, step - 2, 160.0 * n / most, f"{n} jobs, {duration_text(i * longest / _BINS)} to {duration_text((i + 1) * longest / _BINS)}")
        for i, n in sorted(counts.items())
    )
    labels = ((0.0, "0", "start"), (320.0, duration_text(longest / 2), "middle"), (640.0, f"{duration_text(longest)} or more", "end"))
    return Chart(bars, labels, f"{most} jobs")


def duration_text(seconds: float | None) -> str:
    """A time span for a person: 0.42 s, 12 s, 3 min, 5.2 h, 4 days."""
    if seconds is None:
        return "-"
    for limit, unit_s, unit, digits in ((10.0, 1.0, "s", 2), (120.0, 1.0, "s", 0), (7200.0, 60.0, "min", 0), (172800.0, 3600.0, "h", 1)):
        if seconds < limit:
            return f"{seconds / unit_s:.{digits}f} {unit}"
    return f"{seconds / 86400.0:.0f} days"


def _latest(jobs: Sequence[JobRecord]) -> list[JobRecord]:
    return sorted(jobs, key=lambda job: job.changed_utc, reverse=True)[:_MOST_ROWS]


def _held(state: State) -> list[HeldPart]:
    return sorted(state.held.values(), key=lambda part: part.since_utc)[:_MOST_ROWS]


def _age_s(time_utc: str, now: datetime.datetime) -> float:
    return max(0.0, (now - datetime.datetime.fromisoformat(time_utc)).total_seconds())


def _quantile(ordered: Sequence[float], share: float) -> float | None:
    """The smallest value that this share of all does not exceed."""
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)] if ordered else None
