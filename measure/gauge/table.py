"""The table that studies are made of: one measured value a row, with what it was measured under."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from pathlib import Path

import numpy as np

from drivers.errors import DataError, FileError
from drivers.files.disk import read_text, write_text_atomic
from drivers.kinematics.se3 import FloatArray

_MOST_ROWS = 1_000_000
_REMEDY = "Columns: feature, value_mm; beside them nominal_mm, lower_mm, upper_mm, part, operator, trial, direction, minutes, reference_mm, time_utc."


@dataclass(frozen=True, slots=True)
class Measured:
    """One value of one feature."""

    feature: str
    value_mm: float
    nominal_mm: float | None = None
    lower_mm: float | None = None
    """Lower limit of tolerance, as a value."""
    upper_mm: float | None = None
    part: str = ""
    operator: str = ""
    """Who, or with which set-up: whatever reproducibility is to be judged over."""
    trial: str = ""
    direction: str = ""
    """From which side the poses were approached."""
    minutes: float | None = None
    """Since the start of a drift run."""
    reference_mm: float | None = None
    """What the reference gauge says of this feature of this part."""
    time_utc: str = ""

    @property
    def tolerance_mm(self) -> float | None:
        """Width of the tolerance."""
        return None if self.lower_mm is None or self.upper_mm is None else self.upper_mm - self.lower_mm


_NAMES = tuple(field.name for field in fields(Measured))
_NUMBERS = frozenset(name for name in _NAMES if name.endswith("_mm") or name == "minutes")


def read_table(path: str | Path) -> list[Measured]:
    """The values of a CSV file.

    Raises:
        FileError: missing, not UTF-8, columns unknown or missing, or a cell that is not what its column says.
    """
    return parse_table_of_values(read_text(path), file=path)


def parse_table_of_values(text: str, *, file: str | Path) -> list[Measured]:
    """The values of a text in CSV; `file` is only named in errors. Raises FileError as `read_table`."""
    try:
        rows = list(csv.reader(io.StringIO(text), strict=True))
    except csv.Error as error:
        raise FileError(f"is no CSV: {error}", file=file, remedy=_REMEDY) from error
    if len(rows) < 2 or len(rows) > _MOST_ROWS:
        raise FileError("holds no values", file=file, remedy=_REMEDY)
    header = [name.strip() for name in rows[0]]
    unknown = [name for name in header if name not in _NAMES]
    if unknown or len(set(header)) < len(header) or not {"feature", "value_mm"} <= set(header):
        raise FileError(f"columns {', '.join(header)} are not understood", file=file, where="line 1", remedy=_REMEDY)
    found = [_row(header, row, file, f"line {i}") for i, row in enumerate(rows[1:], start=2) if any(cell.strip() for cell in row)]
    if not found:
        raise FileError("holds no values", file=file, remedy=_REMEDY)
    return found


def _row(header: Sequence[str], row: Sequence[str], file: str | Path, where: str) -> Measured:
    if len(row) != len(header):
        raise FileError(f"{len(row)} values where the header has {len(header)}", file=file, where=where, remedy=_REMEDY)
    found: dict[str, str | float | None] = {}
    for name, cell in zip(header, row, strict=True):
        found[name] = _number(cell, name, file, where) if name in _NUMBERS else cell.strip()
    if not found["feature"] or found["value_mm"] is None:
        raise FileError("a row needs a feature and its value_mm", file=file, where=where, remedy=_REMEDY)
    made = Measured(**found)  # type: ignore[arg-type]  # checked above: numbers are numbers, names are text
    if made.tolerance_mm is not None and made.tolerance_mm <= 0:
        raise FileError("lower_mm is not below upper_mm", file=file, where=where, remedy="Give limits as values of the feature.")
    if made.time_utc:
        time_of(made.time_utc, file, where)
    return made


def _number(cell: str, name: str, file: str | Path, where: str) -> float | None:
    if not cell.strip():
        return None
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise FileError(f"{name}: {cell.strip()[:40]!r} is no finite number", file=file, where=where, remedy="Correct it, or leave the cell empty.")
    return value


def time_of(text: str, file: str | Path, where: str) -> datetime:
    """A time as ISO 8601 writes it. Raises FileError."""
    try:
        return datetime.fromisoformat(text)
    except ValueError as error:
        raise FileError(f"time_utc: {text[:40]!r} is no time", file=file, where=where, remedy="Write 2026-11-22T09:30:00Z.") from error


def write_table(rows: Iterable[Measured], path: str | Path) -> None:
    """Write values as CSV, columns that hold nothing left out. Raises FileError where the file cannot be written."""
    rows = list(rows)
    used = [name for name in _NAMES if name in {"feature", "value_mm"} or any(getattr(row, name) not in (None, "") for row in rows)]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(used)
    writer.writerows([["" if (value := getattr(row, name)) is None else value for name in used] for row in rows])
    write_text_atomic(Path(path), stream.getvalue())


def by_feature(rows: Sequence[Measured]) -> dict[str, list[Measured]]:
    """Rows by feature, features in the order in which they come.

    Raises:
        DataError: rows of a feature have different tolerances.
    """
    found: dict[str, list[Measured]] = {}
    for row in rows:
        found.setdefault(row.feature, []).append(row)
    for feature, members in found.items():
        if len({(row.lower_mm, row.upper_mm) for row in members}) > 1:
            raise DataError(f"{feature} has different tolerances in different rows", remedy="One feature has one tolerance.")
    return found


def values_mm(rows: Sequence[Measured]) -> FloatArray:
    """(n,) values."""
    return np.array([row.value_mm for row in rows])
