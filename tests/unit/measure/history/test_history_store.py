"""The history only grows, survives kills and two writers, and says which calibration a cell uses."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from drivers.errors import DataError, FileError, SettingsError
from measure.history.database import open_database
from measure.history.store import History
from tests.support.history import CELL, file_of, named, writer


@pytest.fixture
def place(tmp_path: Path) -> str:
    return str(tmp_path / "history.sqlite")


def kept(history: History, folder: Path, *numbers: int, verdict: str = "pass") -> None:
    for number in numbers:
        history.add_calibration(named(number, verdict), file_of(folder, number))


def test_what_was_kept_is_there_after_reopening(place: str, tmp_path: Path) -> None:
    with History.open(place) as history:
        kept(history, tmp_path, 1, 2)
        history.add_result("check", named(1), {"verdict": "conform", "x": 0.1}, verdict="conform", taken_utc="2026-01-02T00:00:00Z", software="tests")
        history.set_check_every(CELL, 24.0)
    with History.open(place) as history:
        assert [row.id for row in history.calibrations(CELL)] == [named(1).id, named(2).id]
        assert history.yaml_of("000001") == file_of(tmp_path, 1).read_text()
        (row,) = history.results(CELL)
        assert (row.kind, row.data["x"], row.taken_utc) == ("check", 0.1, "2026-01-02T00:00:00Z")
        assert history.check_every_h(CELL) == 24.0
        assert history.cells() == (CELL,)


def test_the_same_again_changes_nothing(place: str, tmp_path: Path) -> None:
    with History.open(place) as history:
        for seconds in (1.0, 2.0):
            kept(history, tmp_path, 1)
            content = {"verdict": "conform", "seconds": seconds}
            history.add_result("check", named(1), content, verdict="conform", taken_utc="2026-01-02T00:00:00Z", software="tests")
        assert len(history.calibrations(CELL)) == len(history.results(CELL)) == 1


@pytest.mark.parametrize("statement", ["DELETE FROM {}", "UPDATE {} SET cell = 'other'"])
@pytest.mark.parametrize("table", ["calibration", "result", "activation", "rule"])
def test_the_database_itself_refuses_changes(place: str, tmp_path: Path, table: str, statement: str) -> None:
    with History.open(place) as history:
        kept(history, tmp_path, 1)
        history.add_result("check", named(1), {}, verdict="conform", taken_utc=None, software="tests")
        history.activate(named(1).id, why="")
        history.set_check_every(CELL, 1.0)
    connection = sqlite3.connect(place)
    with pytest.raises(sqlite3.IntegrityError, match="never changed"):
        connection.execute(statement.format(table))
    connection.close()


def test_activation_is_a_log_and_rollback_goes_to_the_one_before(place: str, tmp_path: Path) -> None:
    with History.open(place) as history:
        kept(history, tmp_path, 1, 2)
        assert history.active(CELL) is None
        with pytest.raises(DataError, match="no other calibration was active"):
            history.previous(CELL)
        for number in (1, 2):
            history.activate(named(number).id[:8], why=f"number {number}")
        assert history.previous(CELL) == named(1).id
        history.activate(history.previous(CELL), why="rollback")
        # back again is the other one, not an endless fall into the past
        assert history.previous(CELL) == named(2).id
        assert [row.why for row in history.activations(CELL)] == ["number 1", "number 2", "rollback"]
        assert history.active(CELL) == history.activations(CELL)[-1]


def test_a_failed_calibration_is_put_to_use_by_force_only(place: str, tmp_path: Path) -> None:
    with History.open(place) as history:
        kept(history, tmp_path, 1, verdict="fail")
        with pytest.raises(DataError, match="failed"):
            history.activate(named(1).id, why="")
        assert history.activations(CELL) == ()
        assert history.activate(named(1).id, why="known", forced=True).forced


@pytest.mark.parametrize(("asked", "message"), [("0000", "too short"), ("ffffff", "no calibration"), ("00000_", "no calibration")])
def test_ids_that_mean_nothing(place: str, tmp_path: Path, asked: str, message: str) -> None:
    with History.open(place) as history:
        kept(history, tmp_path, 1)
        with pytest.raises(DataError, match=message):
            history.calibration(asked)


def test_two_writers_lose_nothing(place: str) -> None:
    """Both begin at once on a file that is not there yet, so that they race for making the tables too."""
    n = 12
    writers = [writer(place, who, n) for who in "ab"]
    for process in writers:
        _, trouble = process.communicate(timeout=120)
        assert process.returncode == 0, trouble
    with History.open(place) as history:
        rows = history.results(CELL)
    assert len(rows) == 2 * n
    assert sorted(row.number for row in rows) == list(range(1, 2 * n + 1))


def test_a_killed_writer_leaves_every_row_that_it_told(place: str) -> None:
    kill_and_look(place, "a", after=7)


@pytest.mark.qualify
def test_many_killed_writers(place: str) -> None:
    for number in range(30):
        kill_and_look(place, "abcdefghijklmnopqrstuvwxyz0123"[number], after=1 + number)


def kill_and_look(place: str, who: str, after: int) -> None:
    process = writer(place, who)
    assert process.stdout is not None
    told = 0
    while told < after:
        told = int(process.stdout.readline())
    process.kill()
    told = max([told, *map(int, process.stdout.read().split())])
    process.communicate(timeout=60)
    connection = sqlite3.connect(place)
    assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    connection.close()
    with History.open(place) as history:
        rows = [row for row in history.results(CELL) if row.calibration == who * 64]
        assert told <= len(rows) <= told + 1
        assert {row.data["number"] for row in rows} == set(range(len(rows)))
        history.set_check_every(CELL, 1.0)


def test_what_is_no_history_is_left_alone(tmp_path: Path) -> None:
    text = tmp_path / "history.sqlite"
    text.write_text("this is a letter, and long enough to be looked at\n" * 20)
    with pytest.raises(FileError, match="is no database"):
        open_database(str(text))
    assert text.read_text().startswith("this is a letter")
    with pytest.raises(FileError, match="no such folder"):
        open_database(str(tmp_path / "no" / "history.sqlite"))
    with pytest.raises(SettingsError, match="no place for a history"):
        open_database("nonsense://host/name")


def test_a_history_of_a_newer_program_is_not_touched(place: str) -> None:
    open_database(place).close()
    connection = sqlite3.connect(place)
    with connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
    connection.close()
    with pytest.raises(FileError, match="newer spherecal"):
        open_database(place)


def test_a_password_is_never_told() -> None:
    with pytest.raises((FileError, SettingsError)) as error:
        open_database("postgresql://user:hidden@127.0.0.1:1/none")
    assert "hidden" not in str(error.value)
