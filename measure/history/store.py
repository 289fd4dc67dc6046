"""Reading and writing the history: rows are added, never changed (the database itself refuses that)."""

from __future__ import annotations

import datetime
import getpass
import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

from drivers.errors import DataError, SettingsError
from measure.console import json_text
from measure.history.database import Database, open_database
from measure.history.rows import ActivationRow, CalibrationRow, ResultKind, ResultRow
from measure.history.tables import tables

if TYPE_CHECKING:
    from sqlalchemy import Connection, Table

    from calibrate import Calibration

_SHORTEST_ID = 6
_NOT_IN_DIGEST = ("seconds", "seconds_to_verdict", "stitch", "out", "history", "marked")
_Row = TypeVar("_Row", CalibrationRow, ResultRow, ActivationRow)


class History:
    """The history of one or more cells; a context manager."""

    def __init__(self, database: Database) -> None:
        self._database = database

    @classmethod
    def open(cls, place: str) -> Self:
        """Open a place, made where it is not there; raises as `open_database`."""
        return cls(open_database(place))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self._database.close()

    @property
    def name(self) -> str:
        """Where it is, for messages."""
        return self._database.name

    def add_calibration(self, calibration: Calibration, file: str | Path) -> None:
        """Keep a calibration and the whole of its file; one that is there already stays as it is.

        Raises:
            FileError: the database, or the calibration's file.
        """
        from drivers.files.disk import read_text

        parent = calibration.inputs.get("parent")
        row = {
            "id": calibration.id,
            "cell": calibration.cell_name,
            "recorded_utc": now_utc(),
            "created_utc": calibration.created_utc,
            "verdict": calibration.verdict,
            "parent": None if parent is None else str(parent),
            "file": str(Path(file).absolute()),
            "yaml": read_text(file),
        }
        with self._database.writing() as connection:
            table = tables().calibration
            if not _is_there(connection, table, "id", calibration.id):
                connection.execute(table.insert().values(row))

    def add_result(
        self, kind: ResultKind, calibration: Calibration, content: Mapping[str, object], *, verdict: str, taken_utc: str | None, software: str
    ) -> None:
        """Keep what a command printed; the same result a second time changes nothing. FileError as `Database.writing`."""
        text = json_text(content)
        told = {key: value for key, value in json.loads(text).items() if key not in _NOT_IN_DIGEST}
        now = now_utc()
        row = {
            "digest": hashlib.sha256(json.dumps([kind, calibration.id, told], sort_keys=True).encode()).hexdigest(),
            "cell": calibration.cell_name,
            "kind": kind,
            "calibration": calibration.id,
            "recorded_utc": now,
            "taken_utc": taken_utc or now,
            "verdict": verdict,
            "software": software,
            "content": text,
        }
        with self._database.writing() as connection:
            table = tables().result
            if not _is_there(connection, table, "digest", str(row["digest"])):
                connection.execute(table.insert().values(row))

    def activate(self, calibration_id: str, *, why: str, forced: bool = False) -> ActivationRow:
        """From now on the cell uses this calibration.

        Raises:
            DataError: it is not in the history, or its verdict is `fail` and nobody forced it.
            FileError: the database.
        """
        row = self.calibration(calibration_id)
        if row.verdict == "fail" and not forced:
            remedy = "Calibrate anew; --force takes it knowingly, and the history tells so for ever."
            raise DataError(f"the calibration {row.id[:12]} failed", file=self.name, remedy=remedy)
        values = {"cell": row.cell, "calibration": row.id, "at_utc": now_utc(), "who": who(), "why": why, "forced": forced and row.verdict == "fail"}
        with self._database.writing() as connection:
            connection.execute(tables().activation.insert().values(values))
        return self.activations(row.cell)[-1]

    def set_check_every(self, cell: str, hours: float | None) -> None:
        """How often a cell is to be checked; None for no rule. SettingsError for what is no time."""
        if hours is not None and not 0 < hours < float("inf"):
            raise SettingsError(f"{hours:g} h is no time between checks", where="--check-every", remedy="Give hours, e.g. 24.")
        with self._database.writing() as connection:
            connection.execute(tables().rule.insert().values(cell=cell, at_utc=now_utc(), who=who(), check_every_h=hours))

    def check_every_h(self, cell: str) -> float | None:
        """Hours between checks, as the last rule has it."""
        from sqlalchemy import select

        table = tables().rule
        with self._database.reading() as connection:
            last = connection.execute(select(table.c.check_every_h).where(table.c.cell == cell).order_by(table.c.number.desc()).limit(1)).first()
        return None if last is None or last[0] is None else float(last[0])

    def cells(self) -> tuple[str, ...]:
        """Names of the cells that anything is known of."""
        from sqlalchemy import select, union

        known = tables()
        with self._database.reading() as connection:
            found = connection.execute(union(select(known.calibration.c.cell), select(known.result.c.cell)))
            return tuple(sorted(str(row[0]) for row in found))

    def calibrations(self, cell: str) -> tuple[CalibrationRow, ...]:
        """Of a cell, in the order in which they were recorded."""
        return self._rows(CalibrationRow, tables().calibration, "recorded_utc", cell=cell)

    def results(self, cell: str, kind: ResultKind | None = None) -> tuple[ResultRow, ...]:
        """Of a cell, in the order in which their shots were taken."""
        found = self._rows(ResultRow, tables().result, "number", cell=cell, **({} if kind is None else {"kind": kind}))
        return tuple(sorted(found, key=lambda row: (row.taken_utc, row.number)))

    def activations(self, cell: str) -> tuple[ActivationRow, ...]:
        """Of a cell, the first first."""
        return self._rows(ActivationRow, tables().activation, "number", cell=cell)

    def active(self, cell: str) -> ActivationRow | None:
        """What the cell uses now."""
        every = self.activations(cell)
        return every[-1] if every else None

    def previous(self, cell: str) -> str:
        """Id of the calibration that the cell used before the one it uses now; DataError where there was none."""
        every = self.activations(cell)
        earlier = [row.calibration for row in every if row.calibration != every[-1].calibration]
        if not earlier:
            raise DataError(
                "no other calibration was active before", file=self.name, remedy="`spherecal activate` takes any calibration of the history."
            )
        return earlier[-1]

    def calibration(self, id_or_start: str) -> CalibrationRow:
        """The calibration of an id, or of its beginning; DataError where there is none, or more than one."""
        from sqlalchemy import select

        table = tables().calibration
        if len(id_or_start) < _SHORTEST_ID:
            raise DataError(f"{id_or_start!r} is too short for an id", file=self.name, remedy=f"Give {_SHORTEST_ID} or more of its digits.")
        with self._database.reading() as connection:
            found = connection.execute(select(*_columns(CalibrationRow, table)).where(table.c.id.startswith(id_or_start, autoescape=True))).all()
        if len(found) != 1:
            what = "no calibration" if not found else f"{len(found)} calibrations"
            raise DataError(f"{what} {id_or_start} in the history", file=self.name, remedy="`spherecal history CELL` lists them.")
        return CalibrationRow(*found[0])

    def yaml_of(self, calibration_id: str) -> str:
        """The text of a calibration's file."""
        from sqlalchemy import select

        table = tables().calibration
        row = self.calibration(calibration_id)
        with self._database.reading() as connection:
            return str(connection.execute(select(table.c.yaml).where(table.c.id == row.id)).scalar_one())

    def _rows(self, row_type: type[_Row], table: Table, order: str, **wanted: str) -> tuple[_Row, ...]:
        from sqlalchemy import select

        query = select(*_columns(row_type, table)).order_by(table.c[order])
        for name, value in wanted.items():
            query = query.where(table.c[name] == value)
        with self._database.reading() as connection:
            return tuple(row_type(*row) for row in connection.execute(query))


def now_utc() -> str:
    """To the microsecond, so that the order of rows is the order of time."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")


def who() -> str:
    """Name of the user whose process this is."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "unknown"


def _columns(kind: type[Any], table: Table) -> list[Any]:
    return [table.c[field.name] for field in fields(kind)]


def _is_there(connection: Connection, table: Table, column: str, value: str) -> bool:
    from sqlalchemy import select

    return connection.execute(select(table.c[column]).where(table.c[column] == value)).first() is not None
