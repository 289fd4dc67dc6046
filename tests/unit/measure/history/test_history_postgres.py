"""The same history in a PostgreSQL of the system's packages, where one is installed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.errors import FileError
from measure.history.database import open_database
from measure.history.marks import marks_of
from measure.history.store import History
from tests.support.history import CELL, file_of, named, writer
from tests.support.postgres import postgres_url, why_not

pytestmark = pytest.mark.skipif(why_not() is not None, reason=why_not() or "")


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with postgres_url() as found:
        yield found


def test_a_history_in_postgresql(url: str, tmp_path: Path) -> None:
    # two processes that make the tables and write at once
    n = 8
    writers = [writer(url, who, n) for who in "ab"]
    for process in writers:
        _, trouble = process.communicate(timeout=120)
        assert process.returncode == 0, trouble
    with History.open(url) as history:
        assert len(history.results(CELL)) == 2 * n
        for number in (1, 2):
            history.add_calibration(named(number), file_of(tmp_path, number))
            history.activate(named(number).id, why="")
        assert history.previous(CELL) == named(1).id
        assert history.yaml_of("000002") == file_of(tmp_path, 2).read_text()
    assert "the cell has used" in marks_of(url, named(1))[0]


@pytest.mark.parametrize("statement", ["DELETE FROM result", "UPDATE result SET cell = 'x'", "TRUNCATE result"])
def test_postgresql_itself_refuses_changes(url: str, statement: str) -> None:
    database = open_database(url)
    with pytest.raises(FileError, match="never changed"), database.writing() as connection:
        connection.exec_driver_sql(statement)
    database.close()
