"""Poses from a table of text: CSV and its kin, whatever delimiter, decimal mark, header and column names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.errors import FileError
from drivers.files.delimited import Table, parse_table
from drivers.files.pose_columns import IGNORED, Column, Kind, columns_of, expanded
from drivers.files.pose_list import AngleUnit, LengthUnit, PoseLabel, PoseList, RotationNumbers
from drivers.kinematics.se3 import FloatArray

_COLUMNS = (
    "Name them with --columns: joints (or j1, j2, ...), x,y,z, and rx,ry,rz (about named axes), r1,r2,r3 (in the order of the turns), qw,qx,qy,qz, "
    "quaternion (four, w where --rotation says), rvx,rvy,rvz, matrix or transform (16); name, number, cloud, sphere, time; - leaves a column out. "
    "Units may follow: x_mm, joints_deg."
)
_ROTATIONS: tuple[tuple[Kind, int], ...] = (("turn", 3), ("angle", 3), ("vector", 3), ("quaternion", 4), ("four", 4), ("matrix", 9))
_KNOWN: Mapping[Kind, str] = {"vector": "rotation-vector", "quaternion": "quaternion-wxyz", "matrix": "matrix"}
_FARTHEST_ANGLE_DEG = 720.0
_Key = tuple[Kind, int]


def parse_pose_table(text: str, *, file: str | Path, columns: Sequence[str] | None = None) -> PoseList:
    """The poses of a text that holds a table; see `poses_of_table`."""
    return poses_of_table(parse_table(text, file=file), file=file, columns=columns)


def poses_of_table(table: Table, *, file: str | Path, columns: Sequence[str] | None = None) -> PoseList:
    """The poses of a table.

    Args:
        table: cells of text.
        file: only named in errors.
        columns: names of the columns in their order, instead of the header's.

    Raises:
        FileError: columns that are missing, doubled or not understood, or a cell that holds no number.
    """
    names, told = _names(table, columns, file)
    meaning = columns_of(names)
    reader = _Reader(table, names, meaning, _places(meaning, names, file), str(file))
    described = [f"{len(table.rows)} poses, {table.described}", told]
    if unused := [name for name, column in zip(names, meaning, strict=True) if column is None and name.lower() not in IGNORED]:
        described.append(f"columns that are not used: {', '.join(unused)}")
    return PoseList(
        file=str(file),
        kind="table",
        labels=tuple(reader.label(i) for i in range(len(table.rows))),
        joints=reader.numbers("joint"),
        joint_unit=reader.angle_unit("joint"),
        positions=reader.numbers("position"),
        position_unit=reader.length_unit("position"),
        rotations=reader.rotations(),
        described=tuple(described),
    )


@dataclass(frozen=True, slots=True)
class _Reader:
    """A table whose columns are understood."""

    table: Table
    names: tuple[str, ...]
    meaning: tuple[Column | None, ...]
    places: Mapping[_Key, int]
    """Which column holds what."""
    file: str

    def columns(self, kind: Kind) -> list[int]:
        """The columns of one kind, in the order of their index."""
        return [self.places[key] for key in sorted(key for key in self.places if key[0] == kind)]

    def numbers(self, kind: Kind) -> FloatArray | None:
        """(m, k) of one kind; None without such columns."""
        columns = self.columns(kind)
        return np.array([[self._number(row, i) for i in columns] for row in range(len(self.table.rows))]) if columns else None

    def angle_unit(self, kind: Kind) -> AngleUnit | None:
        """As the names of the columns say."""
        unit = self._unit(kind, ("deg", "rad"))
        return "deg" if unit == "deg" else "rad" if unit == "rad" else None

    def length_unit(self, kind: Kind) -> LengthUnit | None:
        """As the names of the columns say."""
        unit = self._unit(kind, ("mm", "m"))
        return "mm" if unit == "mm" else "m" if unit == "m" else None

    def rotations(self) -> RotationNumbers | None:
        """The numbers of the rotations; None without such columns."""
        for kind, _ in _ROTATIONS:
            numbers = self.numbers(kind)
            if numbers is not None:
                known = _KNOWN.get(kind) or (self._make() if kind == "angle" else None)
                return RotationNumbers(numbers, by_axis=kind == "turn", convention=known, unit=self.angle_unit(kind))
        return None

    def _make(self) -> str | None:
        """The controller's make, where only one names its three angles like this (A, B, C are KUKA's and Mitsubishi's)."""
        letters = "".join(self.names[i].strip().lower()[:1] for i in self.columns("angle"))
        return {"wpr": "fanuc", "oat": "kawasaki"}.get(letters)

    def label(self, row: int) -> PoseLabel:
        """What stands beside the numbers."""
        number = self._cell(row, "number")
        value = None if number is None else self.table.number(number)
        whole = int(value) if value is not None and value == int(value) and abs(value) < 1e9 else None
        texts = (self._cell(row, "cloud"), self._cell(row, "sphere"), self._cell(row, "time"))
        return PoseLabel(self.table.where(row), self._cell(row, "name"), whole, *texts)

    def _cell(self, row: int, kind: Kind) -> str | None:
        place = self.places.get((kind, 0))
        return None if place is None else self.table.rows[row][place] or None

    def _number(self, row: int, column: int) -> float:
        cell = self.table.rows[row][column]
        value = self.table.number(cell)
        if value is None:
            message = f"{self.names[column]}: {cell[:40]!r} is no finite number"
            raise FileError(message, file=self.file, where=self.table.where(row), remedy="Correct it, or leave the pose out.")
        return value

    def _unit(self, kind: Kind, allowed: tuple[str, ...]) -> str | None:
        named = [(self.names[i], column.unit) for i in self.columns(kind) if (column := self.meaning[i]) is not None]
        units = {unit for _, unit in named}
        if len(units) > 1:
            given = ", ".join(name for name, _ in named)
            raise FileError(f"columns of one kind have different units: {given}", file=self.file, where="header", remedy="Bring them to one unit.")
        unit = next(iter(units), None)
        if unit is not None and unit not in allowed:
            raise FileError(f"{named[0][0]!r} has the unit {unit}", file=self.file, where="header", remedy=f"Use {' or '.join(allowed)}.")
        return unit


def _names(table: Table, columns: Sequence[str] | None, file: str | Path) -> tuple[tuple[str, ...], str]:
    """The names of the columns, and where they come from."""
    if columns is not None:
        names = expanded(columns)
        if len(names) != table.n_columns:
            message = f"{len(names)} columns are named, the lines hold {table.n_columns}"
            raise FileError(message, file=file, where="--columns", remedy="Name every column; - leaves one out.")
        if unknown := [n for n, c in zip(names, columns_of(names), strict=True) if c is None and n.lower() not in IGNORED]:
            raise FileError(f"the column name {unknown[0]!r} is not known", file=file, where="--columns", remedy=_COLUMNS)
        return names, "columns as given"
    if table.header is not None:
        return table.header, f"columns: {', '.join(table.header)}"
    # what numpy.savetxt writes
    for remark in reversed(table.remarks):
        cells = table.split_remark(remark)
        if len(cells) == table.n_columns and sum(column is not None for column in columns_of(cells)) >= 6:
            return cells, f"columns by the remark: {', '.join(cells)}"
    return _by_shape(table, file), "no header: the columns are told by their number and size"


def _by_shape(table: Table, file: str | Path) -> tuple[str, ...]:
    """Names for the columns of a table without header, where only one reading is possible.

    Raises:
        FileError: there are several readings, or none.
    """
    is_number = [all(table.number(row[i]) is not None for row in table.rows) for i in range(table.n_columns)]
    texts = [i for i, numeric in enumerate(is_number) if not numeric]
    numbers = np.array([[table.number(row[i]) for i in range(table.n_columns) if is_number[i]] for row in table.rows], dtype=np.float64)
    readings = _readings(numbers) if len(texts) <= 1 else []
    if len(readings) != 1:
        found = " or ".join(",".join(reading) for reading in readings) or "nothing that is known"
        message = f"there is no header, and {table.n_columns} columns may be {found}"
        raise FileError(message, file=file, where=f"line {table.lines[0]}", remedy=_COLUMNS)
    names = iter(expanded(readings[0]))
    return tuple(next(names) if numeric else "name" for numeric in is_number)


_POSE: tuple[str, ...] = ("position", "angles")
_POSE_BY_QUATERNION: tuple[str, ...] = ("position", "quaternion")


def _readings(numbers: FloatArray) -> list[tuple[str, ...]]:
    """What rows of plain numbers (m, k) can be."""
    k = numbers.shape[1]
    if k in {7, 8} and len(numbers) > 1 and np.array_equal(numbers[:, 0] - numbers[0, 0], np.arange(len(numbers))):
        return [("number", *reading) for reading in _readings(numbers[:, 1:])]
    if k == 6:
        return [_POSE] if _is_far(numbers) else [("joints",), _POSE]
    if k == 7:
        return [_POSE_BY_QUATERNION] if _are_unit(numbers[:, 3:]) else []
    if k == 16:
        return [("transform",)] if (numbers[:, 12:] == [0, 0, 0, 1]).all() else []
    return _readings_of_both(numbers) if k in {12, 13} else []


def _readings_of_both(numbers: FloatArray) -> list[tuple[str, ...]]:
    """Six axes and a pose, in either order."""
    if numbers.shape[1] == 12:
        pose, fits = _POSE, [_is_far(numbers), _is_far(numbers[:, 6:])]
        fits = fits if any(fits) else [True, True]
    else:
        pose, fits = _POSE_BY_QUATERNION, [_are_unit(numbers[:, 3:7]), _are_unit(numbers[:, 9:])]
    choices = [(*pose, "joints"), ("joints", *pose)]
    return [choice for choice, fit in zip(choices, fits, strict=True) if fit]


def _is_far(numbers: FloatArray) -> bool:
    """Whether the first three numbers cannot be angles in degrees."""
    return bool((np.abs(numbers[:, :3]) > _FARTHEST_ANGLE_DEG).any())


def _are_unit(quaternions: FloatArray) -> bool:
    return bool((np.abs(np.linalg.norm(quaternions, axis=1) - 1) < 1e-2).all())


def _places(meaning: Sequence[Column | None], names: Sequence[str], file: str | Path) -> dict[_Key, int]:
    """Which column holds what, checked: nothing twice, triples whole, and joints or a pose at all."""
    places: dict[_Key, int] = {}
    for i, column in enumerate(meaning):
        if column is None:
            continue
        if (column.kind, column.index) in places:
            first = names[places[column.kind, column.index]]
            raise FileError(f"the columns {first!r} and {names[i]!r} mean the same", file=file, where="header", remedy=_COLUMNS)
        places[column.kind, column.index] = i
    counts = {kind: sorted(index for other, index in places if other == kind) for kind, _ in places}
    wholes: tuple[tuple[Kind, int | None], ...] = (("joint", None), ("position", 3), *_ROTATIONS)
    for kind, needed in wholes:
        found = counts.get(kind, [])
        if found and found != list(range(len(found) if needed is None else needed)):
            given = ", ".join(names[places[kind, index]] for index in found)
            raise FileError(f"columns of one kind are not whole: only {given}", file=file, where="header", remedy=_COLUMNS)
    rotations = [kind for kind, _ in _ROTATIONS if kind in counts]
    if len(rotations) > 1:
        given = " and ".join(names[places[kind, 0]] for kind in rotations)
        raise FileError(f"the rotation is given twice: {given}", file=file, where="header", remedy=_COLUMNS)
    if ("position" in counts) != bool(rotations) or not ("position" in counts or "joint" in counts):
        what = ", ".join(names) or "nothing"
        raise FileError(f"neither axis angles nor a whole pose in the columns {what}", file=file, where="header", remedy=_COLUMNS)
    return places
