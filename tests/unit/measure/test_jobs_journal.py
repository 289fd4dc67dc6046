"""The journal survives a kill at any byte, has one writer, and says the same when it is read again."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.errors import FileError, SettingsError
from measure.jobs.journal import JOURNAL, Event, Journal, State, is_running, read_state


def story(n_jobs: int) -> list[Event]:
    """Everything that can happen to a job."""
    events: list[Event] = [{"event": "run"}, {"event": "held", "source": "/h", "reason": "being written"}]
    ends: list[list[Event]] = [
        [{"event": "done", "seconds": 1.5, "facts": {"marks": ["old"]}}],
        [{"event": "failed", "reason": "r", "category": "disk"}, {"event": "started"}, {"event": "done", "seconds": None, "facts": None}],
        [{"event": "dead", "reason": "no points", "category": "data"}, {"event": "superseded"}],
        [{"event": "interrupted"}, {"event": "from a later version"}],
    ]
    for i in range(n_jobs):
        found = {"event": "found", "part": f"p{i}", "source": f"/p{i}", "fingerprint": "f", "recipe": "r", "name": f"p{i}-{i}"}
        events += [{**event, "job": str(i)} for event in (found, {"event": "started"}, *ends[i % len(ends)])]
    return events


def same(first: State, second: State) -> bool:
    return (first.jobs, first.held, first.by_source, first.retries, first.n_runs) == (
        second.jobs,
        second.held,
        second.by_source,
        second.retries,
        second.n_runs,
    )


def test_reading_again_gives_the_same_state(tmp_path: Path) -> None:
    with Journal(tmp_path) as journal:
        journal.write(*story(8))
        assert same(journal.state, read_state(tmp_path))
        states = [record.state for record in journal.state.jobs.values()]
    assert states == ["done", "done", "superseded", "waiting"] * 2
    record = read_state(tmp_path).jobs["0"]
    assert (record.seconds, record.facts, record.name) == (1.5, {"marks": ["old"]}, "p0-0")
    assert read_state(tmp_path).jobs["1"].attempts == 1
    assert read_state(tmp_path).jobs["3"].interrupted == 1
    assert read_state(tmp_path).held["/h"].reason == "being written"


def test_cut_off_at_any_byte_the_whole_lines_count_and_writing_goes_on(tmp_path: Path) -> None:
    with Journal(tmp_path) as journal:
        journal.write(*story(3))
    path = tmp_path / JOURNAL
    data = path.read_bytes()
    for size in range(0, len(data), 97):
        path.write_bytes(data[:size])
        expected = read_state(tmp_path)
        with Journal(tmp_path) as journal:
            assert same(journal.state, expected)
            journal.write({"event": "run"})
        lines = path.read_bytes().split(b"\n")
        assert lines[:-2] == data[:size].split(b"\n")[:-1]
        assert read_state(tmp_path).n_runs == expected.n_runs + 1


def test_there_is_one_writer(tmp_path: Path) -> None:
    with Journal(tmp_path):
        assert is_running(tmp_path)
        with pytest.raises(SettingsError, match="another runner"):
            Journal(tmp_path)
    assert not is_running(tmp_path)
    Journal(tmp_path).close()


def test_a_broken_line_within_is_told_with_its_number(tmp_path: Path) -> None:
    with Journal(tmp_path) as journal:
        journal.write(*story(1))
    path = tmp_path / JOURNAL
    first, _, rest = path.read_bytes().partition(b"\n")
    path.write_bytes(first + b"\n{broken\n" + rest)
    with pytest.raises(FileError, match="line 2"):
        Journal(tmp_path)
