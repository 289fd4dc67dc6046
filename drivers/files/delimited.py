"""Tables of text whose delimiter, decimal mark and header nobody wrote down."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path

from drivers.errors import FileError

_POINT = re.compile(r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_COMMA = re.compile(r"[-+]?(?:[0-9]+,[0-9]*|,[0-9]+)(?:[eE][-+]?[0-9]+)?")
_DELIMITERS = {"\t": "tabs", ";": "semicolons", "|": "bars", ",": "commas", " ": "blanks"}
_NO_TEXT = {"json": "from JSON"}
_COMMENTS = ("#", "%", "//")
_MOST_LINES = 100_000
_MOST_CHARACTERS = 20_000
_REMEDY = "Give one pose a line, with one value a column, as spreadsheets save CSV."


@dataclass(frozen=True, slots=True)
class Table:
    """Cells of text, stripped."""

    header: tuple[str, ...] | None
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    """Where each row stands in the file, from 1."""
    delimiter: str
    decimal_comma: bool
    remarks: tuple[str, ...] = ()
    """Comment lines above the first row, without their mark."""

    @property
    def n_columns(self) -> int:
        """The same for all rows."""
        return len(self.rows[0])

    @property
    def described(self) -> str:
        """How the text was read, in words."""
        parts = [
            _NO_TEXT.get(self.delimiter) or f"separated by {_DELIMITERS[self.delimiter]}",
            "with decimal commas" if self.decimal_comma else "",
            "" if self.header else "no header",
        ]
        return ", ".join(part for part in parts if part)

    def where(self, row: int) -> str:
        """The place of a row in its file, for messages."""
        return f"{'pose' if self.delimiter in _NO_TEXT else 'line'} {self.lines[row]}"

    def number(self, cell: str) -> float | None:
        """The number in a cell; None where there is none."""
        return number_in(cell, decimal_comma=self.decimal_comma)

    def split_remark(self, remark: str) -> tuple[str, ...]:
        """The cells of a remark that may be a header."""
        return tuple(_split(remark, self.delimiter) or ())


def number_in(cell: str, *, decimal_comma: bool) -> float | None:
    """The finite number that a cell holds, and nothing else; None otherwise."""
    text = cell.strip().replace("\N{MINUS SIGN}", "-")
    if decimal_comma and _COMMA.fullmatch(text):
        text = text.replace(",", ".")
    if not _POINT.fullmatch(text):
        return None
    value = float(text)
    return value if abs(value) < 1e300 else None


def parse_table(text: str, *, file: str | Path) -> Table:
    """The table in a text; `file` is only named in errors.

    A first row without any number is the header. Lines that begin with #, % or // are remarks.

    Raises:
        FileError: no table, rows of different lengths, or no numbers.
    """
    lines, remarks = _data_lines(text, file)
    if not lines:
        raise FileError("holds no rows", file=file, remedy=_REMEDY)
    delimiter, rows = _best_split(lines, file)
    decimal_comma = delimiter != "," and any(_COMMA.fullmatch(cell) for row in rows for cell in row)
    first_is_text = not any(number_in(cell, decimal_comma=decimal_comma) is not None for cell in rows[0])
    if first_is_text and len(rows) == 1:
        raise FileError("holds no row with a number", file=file, remedy=_REMEDY)
    start = 1 if first_is_text else 0
    header = tuple(rows[0]) if first_is_text else None
    numbers = tuple(number for number, _ in lines[start:])
    return Table(header, tuple(tuple(row) for row in rows[start:]), numbers, delimiter, decimal_comma, tuple(remarks))


def _data_lines(text: str, file: str | Path) -> tuple[list[tuple[int, str]], list[str]]:
    """Numbered lines that are no remarks, and the remarks above the first of them."""
    lines: list[tuple[int, str]] = []
    remarks: list[str] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if len(line) > _MOST_CHARACTERS or len(lines) > _MOST_LINES:
            raise FileError("is too long for a list of poses", file=file, where=f"line {number}", remedy=_REMEDY)
        if not line.strip() or line.lstrip().startswith(_COMMENTS):
            remarks += [line.strip().lstrip("#%/ \t")] if line.strip() and not lines else []
        else:
            lines.append((number, line))
    return lines, remarks


def _best_split(lines: list[tuple[int, str]], file: str | Path) -> tuple[str, list[list[str]]]:
    """The delimiter that makes the most numbers of all lines, and the cells by it."""
    found: list[tuple[tuple[bool, float, float], str, list[list[str]]]] = []
    for delimiter in _DELIMITERS:
        split = [_split(line, delimiter) for _, line in lines]
        rows = _without_empty_end([cells for cells in split if cells is not None])
        if len(rows) == len(lines):
            found.append((_score(rows, decimal_comma=delimiter != ","), delimiter, rows))
    _, delimiter, rows = max(found, key=lambda item: item[0])
    _check_lengths(rows, lines, file)
    return delimiter, rows


def _score(rows: list[list[str]], *, decimal_comma: bool) -> tuple[bool, float, float]:
    """Rows of one length above all; then many numbers; then little else."""
    n_numbers = sum(number_in(cell, decimal_comma=decimal_comma) is not None for row in rows for cell in row)
    same = len({len(row) for row in rows}) == 1 and len(rows[0]) > 1
    return same, n_numbers, n_numbers / max(sum(map(len, rows)), 1)


def _split(line: str, delimiter: str) -> list[str] | None:
    """Stripped cells; None where quotes do not close."""
    if delimiter == " ":
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader(io.StringIO(line), delimiter=delimiter, strict=True, skipinitialspace=True))]
    except (csv.Error, StopIteration):
        return None


def _without_empty_end(rows: list[list[str]]) -> list[list[str]]:
    """Lines that all end with a delimiter have no further column."""
    return [row[:-1] for row in rows] if all(len(row) > 1 and not row[-1] for row in rows) else rows


def _check_lengths(rows: list[list[str]], lines: list[tuple[int, str]], file: str | Path) -> None:
    usual = max({len(row) for row in rows}, key=[len(row) for row in rows].count)
    for (number, _), row in zip(lines, rows, strict=True):
        if len(row) != usual:
            message = f"{len(row)} values where the other lines have {usual}"
            raise FileError(message, file=file, where=f"line {number}", remedy=_REMEDY)
