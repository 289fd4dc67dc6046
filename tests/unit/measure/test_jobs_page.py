"""The throughput page: its figures against counting by hand, and nothing on it that a part's name could inject."""

from __future__ import annotations

import datetime
import re
from pathlib import Path

import pytest

from measure.jobs.journal import State
from measure.jobs.page import duration_text, durations_chart, hours_chart, render, throughput

NOW = datetime.datetime(2026, 11, 22, 12, 0, tzinfo=datetime.UTC)
NASTY = '<script>alert("p")</script>'


def at(minutes_ago: float) -> str:
    return (NOW - datetime.timedelta(minutes=minutes_ago)).isoformat()


def told() -> State:
    """Three parts done (10, 50 and 130 minutes ago), two dead, one waiting since 95 minutes, one at work, one held."""
    state = State()

    def tell(job: str, kind: str, minutes_ago: float, **more: object) -> None:
        state.apply({"event": kind, "job": job, "time_utc": at(minutes_ago), **more})

    for i, name in enumerate(["a", "b", "c", "d", "e", NASTY, "g"]):
        tell(str(i), "found", 200 if i != 5 else 95, part=name, source=f"/{name}", fingerprint="f", recipe="r", name=name)
    tell("5", "failed", 90, category="worker died", reason="killed")
    for job, minutes_ago, seconds in (("0", 10, 1.0), ("1", 50, 3.0), ("2", 130, 2.0)):
        tell(
            job, "done", minutes_ago, seconds=seconds, facts={"marks": ["overdue"] if job == "2" else [], "verdict": "reject" if job == "1" else None}
        )
    for job in ("3", "4"):
        tell(job, "dead", 5, category="x.ply: is cut off", reason=f"no {NASTY}")
    tell("6", "started", 1)
    state.apply({"event": "held", "source": "/h", "reason": "still copied", "time_utc": at(20)})
    return state


def test_figures_are_those_counted_by_hand() -> None:
    found = throughput(told(), NOW)
    assert (found.n_done, found.n_dead, found.n_waiting, found.n_running, found.n_held) == (3, 2, 1, 1, 1)
    assert (found.n_marked, found.n_rejected, found.last_hour, found.best_hour) == (1, 1, 2, 2)
    assert (found.median_s, found.slow_s, found.longest_s) == (2.0, 3.0, 3.0)
    assert (found.oldest_waiting_s, found.oldest_waiting) == (95 * 60.0, NASTY)
    assert found.failures == (("x.ply: is cut off", 2),)
    assert found.retries == (("worker died", 1),)


def test_an_empty_folder_of_results_has_a_page() -> None:
    found = throughput(State(), NOW)
    assert (found.median_s, found.oldest_waiting_s, found.best_hour) == (None, None, 0)
    assert "0 parts measured" in render(State(), is_running=False, now=NOW, folder=Path("out"))


def test_charts_hold_every_job_once() -> None:
    chart = hours_chart(list(told().jobs.values()), NOW)
    assert [bar.title for bar in chart.bars] == ["2 parts, 0 to 1 h ago", "1 parts, 2 to 3 h ago"]
    assert [bar.height for bar in chart.bars] == [160.0, 80.0]
    assert chart.bars[0].x > chart.bars[1].x
    spread = durations_chart([0.1] * 90 + [0.2] * 8 + [50.0, 1000.0])
    assert sum(int(bar.title.split()[0]) for bar in spread.bars) == 100
    assert all(bar.x >= 0 and bar.x + bar.width <= 640 and bar.height <= 160 for bar in spread.bars)
    durations_chart([0.0, 0.0])


def test_the_page_is_escaped_and_refers_to_nothing_outside() -> None:
    text = render(told(), is_running=True, now=NOW, folder=Path("out"))
    assert NASTY not in text
    assert "&lt;script&gt;" in text
    assert not re.search(r"(src|href)=|https?://", text)
    assert 'http-equiv="refresh"' in text
    assert 'http-equiv="refresh"' not in render(told(), is_running=False, now=NOW, folder=Path("out"))


@pytest.mark.parametrize(
    ("seconds", "text"), [(None, "-"), (0.123, "0.12 s"), (59.6, "60 s"), (180, "3 min"), (7200, "2.0 h"), (5 * 86400, "5 days")]
)
def test_spans_for_a_person(seconds: float | None, text: str) -> None:
    assert duration_text(seconds) == text
