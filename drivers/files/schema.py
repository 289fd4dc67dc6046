"""pydantic models of files, with the house's errors: file, key path and line, what was found, what is allowed."""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from drivers.errors import FileError
from drivers.files.yaml import line_of
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

Model = TypeVar("Model", bound=BaseModel)


class StrictModel(BaseModel):
    """Unknown keys, wrong types and non-finite numbers are errors; whole numbers pass as floats."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, arbitrary_types_allowed=True)


def _as_tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _rigid(value: object) -> FloatArray:
    try:
        matrix = np.array(value, dtype=np.float64) if isinstance(value, list) and not _has_other_than_numbers(value) else np.zeros(0)
    except (ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4):
        msg = "must be 4 rows of 4 numbers"
        raise ValueError(msg)
    if not se3.is_rigid(matrix, 1e-6):
        why = "it is transposed, the translation belongs in the last column" if se3.is_rigid(matrix.T, 1e-6) else _why_not_rigid(matrix)
        msg = f"is no rigid transform to 1e-6: {why}"
        raise ValueError(msg)
    matrix.flags.writeable = False
    return matrix


def _has_other_than_numbers(rows: Sequence[object]) -> bool:
    items = [item for row in rows for item in (row if isinstance(row, list) else [None])]
    return any(isinstance(item, bool) or not isinstance(item, int | float) for item in items)


def _why_not_rigid(matrix: FloatArray) -> str:
    if not np.isfinite(matrix).all():
        return "a number is not finite"
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        return "the last row must be 0 0 0 1"
    if np.linalg.det(matrix[:3, :3]) < 0:
        return "it mirrors, the determinant is negative"
    return f"R R^T is off from the identity by {np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max():.2g} (write more decimals)"


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Text = Annotated[str, Field(min_length=1)]
Pair = Annotated[tuple[float, float], BeforeValidator(_as_tuple)]
TextPair = Annotated[tuple[Text, Text], BeforeValidator(_as_tuple)]
Vector3 = Annotated[tuple[float, float, float], BeforeValidator(_as_tuple)]
Corners = Annotated[tuple[Vector3, Vector3], BeforeValidator(_as_tuple)]
Numbers = Annotated[tuple[float, ...], BeforeValidator(_as_tuple)]
Transform = Annotated[np.ndarray, BeforeValidator(_rigid)]
"""(4, 4) float64, rigid to 1e-6, read-only."""


def check(model: type[Model], data: object, *, file: str, text: str | None = None) -> Model:
    """Plain data as a checked model.

    Args:
        model: the pydantic model.
        data: what `parse_yaml` gave.
        file: named in errors.
        text: the YAML text, for line numbers in errors.

    Raises:
        FileError: for the first thing wrong, with the number of further ones.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise _file_error(model, error, file, text) from error


def _file_error(model: type[BaseModel], error: ValidationError, file: str, text: str | None) -> FileError:
    # a misspelt key is also a missing one: the misspelling tells more
    first, *others = sorted(error.errors(include_url=False), key=lambda item: item["type"] != "extra_forbidden")
    path = _key_path(model, first["loc"])
    line = line_of(text, path, file=file) if text is not None and path else None
    where = ".".join(str(part) for part in path) or "top level"
    message = _message(str(first["type"]), str(first["msg"]), first["input"])
    if others:
        message += f" (and {len(others)} more)"
    remedy = _remedy(model, path, str(first["type"]), str(first["msg"]))
    return FileError(message, file=file, where=where if line is None else f"{where} (line {line})", remedy=remedy)


def _message(kind: str, text: str, found: object) -> str:
    if kind == "extra_forbidden":
        return "unknown key"
    if kind == "missing":
        return "is missing"
    text = text.removeprefix("Value error, ").removeprefix("Input should be ").replace("a valid dictionary or instance of", "a mapping for")
    if kind == "value_error":
        return text
    if kind == "union_tag_invalid":
        return f"this kind is not known, it must be one of{text.rpartition(':')[2]}"
    if kind in _PLAIN_WORDS:
        return _PLAIN_WORDS[kind]
    shown = repr(found) if not isinstance(found, dict | list | tuple) else f"a {'mapping' if isinstance(found, dict) else 'list'}"
    return f"{shown[:60]} is not allowed here, it must be {text}"


_PLAIN_WORDS = {
    "union_tag_not_found": "the key 'kind' is missing",
    "too_long": "the list is too long",
    "string_too_short": "an empty text is not allowed here",
    "tuple_type": "a list belongs here",
}


def _remedy(model: type[BaseModel], path: tuple[str | int, ...], kind: str, text: str) -> str:
    if kind == "extra_forbidden":
        return f"Allowed: {', '.join(allowed_keys(model, path[:-1])) or 'no keys'}."
    if kind == "missing":
        return f"Add the key {path[-1]!r}." if isinstance(path[-1], str) else "Give one more number."
    if kind == "string_type":
        return "Put the value in quotes."
    return "Correct the value." if "metres" not in text else "Lengths are mm."


def allowed_keys(model: type[BaseModel], path: Sequence[str | int]) -> list[str]:
    """The keys allowed in the mapping at a key path."""
    found: list[Any] = [model]
    for part in path:
        found = [inner for outer in found for inner in _step(outer, part)]
    names = [name for item in found if _is_model(item) for name in item.model_fields]
    return list(dict.fromkeys(names))


def _step(kind: Any, part: str | int) -> list[Any]:
    """Models that may stand below `part` in a value of a kind."""
    if _is_model(kind):
        fields: Mapping[str, Any] = kind.model_fields
        return _unwrap(fields[str(part)].annotation) if part in fields else []
    arguments = get_args(kind)
    return _unwrap(arguments[1] if get_origin(kind) is dict else arguments[0]) if arguments else []


def _unwrap(annotation: Any) -> list[Any]:
    if get_origin(annotation) is Annotated:
        return _unwrap(get_args(annotation)[0])
    if get_origin(annotation) in {Union, types.UnionType}:
        return [inner for option in get_args(annotation) for inner in _unwrap(option)]
    return [annotation]


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _key_path(model: type[BaseModel], location: Sequence[str | int]) -> tuple[str | int, ...]:
    """The location that pydantic gives, without the marks it adds for unions and keys."""
    kept: list[str | int] = []
    found: list[Any] = [model]
    for part in location:
        below = [inner for outer in found for inner in _step(outer, part)]
        names_a_key = below or (part == location[-1] and any(map(_is_model, found)))
        if part == "[key]" or (isinstance(part, str) and len(found) > 1 and not names_a_key):
            continue  # a mark that tells which type of a union was tried
        kept.append(part)
        found = below or found
    return tuple(kept)
