"""One record of a file: typed access to its keys, every complaint with file, place, key and remedy."""

from __future__ import annotations

import datetime
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import NoReturn

import numpy as np

from drivers.errors import FileError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

# Controllers print rotations with 4 to 9 decimals; beyond this it is no rounding.
_RIGID_TOLERANCE = 1e-4


@dataclass(frozen=True, slots=True)
class Record:
    """A mapping read from a file; getters return None for a key that is missing or null."""

    values: Mapping[str, object]
    file: str
    where: str
    taken: set[str] = field(default_factory=set)
    """Keys that a getter was asked for; the others are in `rest`."""

    def fail(self, key: str, found: str, remedy: str) -> NoReturn:
        """Raise the FileError for one key."""
        raise FileError(f"{key}: {found}", file=self.file, where=self.where, remedy=remedy)

    def get(self, key: str) -> object:
        """The raw value."""
        self.taken.add(key)
        return self.values.get(key)

    @property
    def rest(self) -> dict[str, object]:
        """The keys that no getter was asked for."""
        return {key: value for key, value in self.values.items() if key not in self.taken}

    def text(self, key: str) -> str | None:
        """A text that is not empty."""
        value = self.get(key)
        if value is not None and not (isinstance(value, str) and value):
            self.fail(key, f"{_shown(value)} is no text", 'Write a text in quotes, e.g. "A".')
        return value

    def choice(self, key: str, allowed: tuple[str, ...]) -> str | None:
        """One of some words."""
        value = self.get(key)
        if value is not None and value not in allowed:
            self.fail(key, f"{_shown(value)} is not known", f"Allowed: {', '.join(allowed)}.")
        return None if value is None else str(value)

    def whole(self, key: str) -> int | None:
        """A whole number from 0."""
        value = self.get(key)
        if value is not None and (not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 53):
            self.fail(key, f"{_shown(value)} is no whole number from 0", "Number the shots 0, 1, 2, ...")
        return value

    def number(self, key: str) -> float | None:
        """A finite number."""
        value = self.get(key)
        if value is None:
            return None
        self._check_number(key, value)
        return float(value)  # type: ignore[arg-type]

    def vector(self, key: str, length: int | None = None) -> FloatArray | None:
        """A list of finite numbers, of a given length or of any but 0."""
        value = self.get(key)
        if value is None:
            return None
        if not isinstance(value, list) or not value or (length is not None and len(value) != length):
            size = "a list of" if length is None else f"a list of {length}"
            self.fail(key, f"{_shown(value)} is not {size} numbers", f"Write {size} numbers, or null.")
        for i, item in enumerate(value):
            self._check_number(f"{key}[{i}]", item)
        return np.array(value, dtype=np.float64)

    def transform(self, key: str) -> FloatArray | None:
        """A rigid (4, 4) transform; rounding up to 1e-4 is taken out of its rotation."""
        value = self.get(key)
        if value is None:
            return None
        remedy = "Write four rows of four numbers: a rotation, a translation in mm, and 0 0 0 1; or null."
        if not isinstance(value, list) or len(value) != 4 or not all(isinstance(row, list) and len(row) == 4 for row in value):
            self.fail(key, f"{_shown(value)} is no 4 x 4 matrix", remedy)
        for i, row in enumerate(value):
            for j, item in enumerate(row):
                self._check_number(f"{key}[{i}][{j}]", item)
        return self._rigid(key, np.array(value, dtype=np.float64), remedy)

    def _rigid(self, key: str, matrix: FloatArray, remedy: str) -> FloatArray:
        if not se3.is_rigid(matrix, _RIGID_TOLERANCE):
            turned = se3.is_rigid(matrix.T, _RIGID_TOLERANCE)
            why = "it is transposed: the translation belongs in the last column" if turned else _why_not_rigid(matrix)
            self.fail(key, f"the matrix is no rigid transform ({why})", remedy)
        return se3.from_rotation_translation(se3.nearest_rotation(matrix[:3, :3]), matrix[:3, 3])

    def _check_number(self, key: str, value: object) -> None:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.fail(key, f"{_shown(value)} is no number", "Write a number.")
        # an int of thousands of digits has no float
        if not (abs(value) < 1e300 and math.isfinite(value)):
            self.fail(key, f"{_shown(value)} is not finite", "Write a finite number, or mark the shot as failed.")

    def time_utc(self, key: str) -> str | None:
        """An ISO 8601 date and time, kept as text."""
        value = self.text(key)
        if value is not None:
            try:
                datetime.datetime.fromisoformat(value)
            except ValueError:
                self.fail(key, f"{_shown(value)} is no date and time", 'Write it like "2026-01-31T12:00:00Z".')
        return value

    def relative_path(self, key: str) -> str | None:
        """A path inside the folder of the file, with forward slashes."""
        value = self.text(key)
        if value is not None:
            leaves = ".." in PurePosixPath(value).parts or PurePosixPath(value).is_absolute() or PureWindowsPath(value).anchor
            if leaves or "\\" in value or not value.isprintable():
                remedy = 'Write a relative path with forward slashes, like "scans/0000.ply".'
                self.fail(key, f"{_shown(value)} does not stay inside the folder", remedy)
        return value

    def digest(self, key: str) -> str | None:
        """A sha256 in hex, as lower-case text."""
        value = self.text(key)
        if value is not None and not re.fullmatch(r"[0-9a-fA-F]{64}", value):
            self.fail(key, f"{_shown(value)} is no sha256", "Write the 64 hex digits that `sha256sum` prints.")
        return None if value is None else value.lower()


def as_mapping(value: object, *, file: str | Path, where: str) -> Mapping[str, object]:
    """A mapping with text keys.

    Raises:
        FileError: for anything else.
    """
    if not isinstance(value, dict):
        raise FileError(f"{_shown(value)} stands where `key: value` lines belong", file=file, where=where, remedy="See docs/file_formats.md.")
    if odd := [key for key in value if not isinstance(key, str)]:
        raise FileError(f"the key {odd[0]!r} is no text", file=file, where=where, remedy=f'Put it in quotes: "{odd[0]}".')
    return value


def parse_json_object(text: str, *, file: str | Path, where: str) -> Mapping[str, object]:
    """A JSON object, strictly: no duplicate keys, no NaN or Infinity.

    Raises:
        FileError: for anything else.
    """
    try:
        value = json.loads(text, object_pairs_hook=_unique)
        place = _not_finite(value, "")
    except json.JSONDecodeError as error:
        raise FileError(f"broken JSON ({error.msg} at character {error.pos + 1})", file=file, where=where, remedy=_JSON_REMEDY) from error
    except (ValueError, RecursionError) as error:
        raise FileError(f"broken JSON ({error})", file=file, where=where, remedy=_JSON_REMEDY) from error
    if not isinstance(value, dict):
        raise FileError("is no JSON object", file=file, where=where, remedy=_JSON_REMEDY)
    if place is not None:
        raise FileError(f"{place}: NaN or infinite", file=file, where=where, remedy='Write null, or set the "status" of the shot to "failed".')
    return value


_JSON_REMEDY = "Each line must be one whole JSON object; correct the line or delete it."


def _unique(pairs: list[tuple[str, object]]) -> dict[str, object]:
    result = dict(pairs)
    if len(result) < len(pairs):
        names = [name for name, _ in pairs]
        msg = f"the key {next(name for name in names if names.count(name) > 1)!r} is given twice"
        raise ValueError(msg)
    return result


def _not_finite(value: object, path: str) -> str | None:
    """The key path of the first number that is NaN or infinite."""
    if isinstance(value, float):
        return None if math.isfinite(value) else path
    items: list[tuple[str, object]] = []
    if isinstance(value, dict):
        items = [(f"{path}.{key}" if path else str(key), item) for key, item in value.items()]
    elif isinstance(value, list):
        items = [(f"{path}[{i}]", item) for i, item in enumerate(value)]
    return next((found for key, item in items if (found := _not_finite(item, key))), None)


def _why_not_rigid(matrix: FloatArray) -> str:
    rotation = matrix[:3, :3]
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > _RIGID_TOLERANCE:
        return "the last row is not 0 0 0 1"
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > _RIGID_TOLERANCE:
        return f"R R^T is off from the identity by {error:.2g}"
    return "it mirrors: the determinant is -1"


def _shown(value: object) -> str:
    text = repr(value) if not isinstance(value, int) or isinstance(value, bool) or abs(value) < 1 << 64 else "a huge number"
    return text if len(text) <= 60 else f"{text[:57]}..."
