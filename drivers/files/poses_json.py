"""Poses from JSON, as programs and cameras' tools write them: a list of objects, an object of objects, or an object a line.

Every object becomes a row of a table whose columns `drivers.files.pose_columns` understands: keys of nested objects are
joined, and lists of numbers are told by their shape and their key.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from drivers.errors import FileError
from drivers.files.delimited import Table
from drivers.files.pose_columns import expanded

_REMEDY = "Give a list of objects of the same keys, one a pose, as {\"joints_deg\": [...], \"position_mm\": [...], \"quaternion_wxyz\": [...]}."
_MOST_POSES = 100_000
_DEEPEST = 6
_UNIT = re.compile(r"[_ ](mm|m|deg|rad)$", re.IGNORECASE)
_JOINTS = re.compile(r"joint|jnt|axis|axes|robax|^q$|_q$")
_POSITION = re.compile(r"pos|trans|xyz|point|origin|^t$|^p$|_t$|_p$")
_VECTOR = re.compile(r"vec")
_QUATERNIONS = {"wxyz": ["qw", "qx", "qy", "qz"], "xyzw": ["qx", "qy", "qz", "qw"]}
Cells = list[tuple[str, str]]


def is_json(text: str) -> bool:
    """Whether a text is meant as JSON; no table, RAPID or URScript begins like this."""
    return bool(re.match(r"\s*(\{|\[\s*[\[{])", text))


def parse_json_table(text: str, *, file: str | Path) -> Table:
    """The table that a JSON text stands for, lines numbered by pose from 1.

    Raises:
        FileError: no JSON, no list of objects, or objects whose keys differ.
    """
    rows = [list(_cells(item, (), file, f"pose {i}")) for i, item in enumerate(_poses(_parsed(text, file), file), start=1)]
    header = tuple(name for name, _ in rows[0])
    for i, row in enumerate(rows, start=1):
        if tuple(name for name, _ in row) != header:
            differing = sorted({name for name, _ in row} ^ set(header)) or ["their order"]
            raise FileError(f"pose {i} differs from the first in {differing[0]!r}", file=file, where=f"pose {i}", remedy=_REMEDY)
    cells = tuple(tuple(cell for _, cell in row) for row in rows)
    return Table(header, cells, tuple(range(1, len(rows) + 1)), "json", decimal_comma=False)


def _parsed(text: str, file: str | Path) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        lines = [line for line in text.splitlines() if line.strip()]
        if len(lines) > 1 and lines[0].lstrip().startswith("{") and lines[0].rstrip().endswith("}"):
            return [_line(line, i, file) for i, line in enumerate(lines, start=1)]
        raise FileError(f"is no JSON: {error}", file=file, remedy=_REMEDY) from error


def _line(line: str, number: int, file: str | Path) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError) as error:
        raise FileError(f"is no JSON: {error}", file=file, where=f"line {number}", remedy=_REMEDY) from error


def _poses(found: Any, file: str | Path) -> list[dict[str, Any]]:
    """The objects that are poses; the keys of an object of objects become names."""
    poses = _listed(found, 0)
    if not poses or len(poses) > _MOST_POSES:
        raise FileError("holds no list of poses", file=file, remedy=_REMEDY)
    return poses


def _listed(found: Any, depth: int) -> list[dict[str, Any]]:
    if depth > _DEEPEST:
        return []
    if isinstance(found, list):
        if found and all(isinstance(item, dict) for item in found):
            return found
        plain = found and all(isinstance(item, list) for item in found) and all(_shape(item) in {(4, 4), (16,)} for item in found)
        return [{"transform": item} for item in found] if plain else []
    if not isinstance(found, dict):
        return []
    values = list(found.values())
    if len(values) > 1 and all(isinstance(value, dict) and value.keys() == values[0].keys() for value in values):
        return [{"name": key, **value} for key, value in found.items()]
    inner = [_listed(value, depth + 1) for value in values if isinstance(value, list | dict)]
    return max(inner, key=len, default=[])


def _cells(value: Any, path: tuple[str, ...], file: str | Path, where: str) -> Iterator[tuple[str, str]]:
    """Names and texts of everything in an object."""
    name = "_".join(path)
    if isinstance(value, dict) and len(path) <= _DEEPEST:
        for key, item in value.items():
            yield from _cells(item, (*path, str(key)), file, where)
    elif isinstance(value, list) and (shape := _shape(value)):
        numbers = value if len(shape) == 1 else [number for row in value for number in row]
        yield from zip(_names(path, shape), map(_text, numbers), strict=True)
    elif value is None or isinstance(value, str | int | float):
        yield name, _text(value)


def _text(value: Any) -> str:
    return "" if value is None else str(value).strip()


def _shape(value: Sequence[Any]) -> tuple[int, ...]:
    """Of a list of numbers or of equally long lists of numbers; empty for anything else."""
    if value and all(isinstance(item, int | float) and not isinstance(item, bool) for item in value):
        return (len(value),)
    if value and all(isinstance(item, list) and len(_shape(item)) == 1 for item in value) and len({len(item) for item in value}) == 1:
        return (len(value), len(value[0]))
    return ()


def _names(path: tuple[str, ...], shape: tuple[int, ...]) -> tuple[str, ...]:
    """Names of the numbers of a list; of those that mean nothing, its path and their place."""
    key = path[-1].lower() if path else ""
    unit = match[0].lower() if (match := _UNIT.search(key)) else ""
    key = key.removesuffix(unit)
    size = shape[0] if len(shape) == 1 else shape[0] * shape[1]
    groups: list[str] = []
    if shape in {(4, 4), (16,)}:
        groups = ["transform"]
    elif shape in {(3, 3), (9,)}:
        groups = ["matrix"]
    elif _JOINTS.search(key) and len(shape) == 1:
        return tuple(f"j{i + 1}{unit}" for i in range(size))
    elif shape == (3,):
        groups = ["position"] if _POSITION.search(key) else ["rvx", "rvy", "rvz"] if _VECTOR.search(key) else ["angles"]
    elif shape == (4,):
        groups = _QUATERNIONS.get(key[-4:], ["quaternion"])
    elif shape in {(6,), (7,)}:
        groups = ["position", "angles" if size == 6 else "quaternion"]
    names = expanded([f"{group}{unit}" if groups in (["position"], ["angles"]) else group for group in groups])
    return names if len(names) == size else tuple(f"{'_'.join(path)}[{i}]" for i in range(size))
