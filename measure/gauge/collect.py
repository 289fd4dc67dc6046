"""Rows of a study from the JSON objects that `verify`, `check` and `inspect` print: one file a run."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from drivers.errors import FileError
from drivers.files.disk import read_text
from measure.gauge.table import Measured

_REMEDY = "Give files that hold what `spherecal verify --json` or `spherecal inspect --json` printed."


def rows_of_results(paths: Sequence[str | Path], *, part: str = "", operator: str = "", direction: str = "") -> list[Measured]:
    """The figures of some results, each file a trial named after it.

    Args:
        paths: JSON files, in the order of the runs.
        part: of all of them.
        operator: of all of them.
        direction: of approach, of all of them.

    Raises:
        FileError: missing, no JSON, or without any figure that is known.
    """
    return [
        Measured(**figure, part=part, operator=operator, direction=direction, trial=Path(path).stem)  # type: ignore[arg-type]
        for path in paths
        for figure in _figures(path)
    ]


def _figures(path: str | Path) -> list[dict[str, object]]:
    try:
        data = json.loads(read_text(path))
    except ValueError as error:
        raise FileError(f"is no JSON: {error}", file=path, remedy=_REMEDY) from error
    found = [*_lengths(data), *_spheres(data), *_features(data)] if isinstance(data, Mapping) else []
    if not found:
        raise FileError("holds no figure of a length, a sphere or a feature", file=path, remedy=_REMEDY)
    return found


def _lengths(data: Mapping[str, object]) -> Iterator[dict[str, object]]:
    for length in _dicts(data.get("lengths")):
        between = length.get("between")
        if _is_number(length.get("measured_mm")) and isinstance(between, list):
            yield {"feature": f"length {'-'.join(map(str, between))}", "value_mm": length["measured_mm"], "reference_mm": length.get("reference_mm")}


def _spheres(data: Mapping[str, object]) -> Iterator[dict[str, object]]:
    spheres = data.get("spheres")
    for name, sphere in spheres.items() if isinstance(spheres, Mapping) else ():
        if not isinstance(sphere, Mapping):
            continue
        for key, what in (("diameter_error_mm", "diameter error"), ("form_mm", "form")):
            if _is_number(sphere.get(key)):
                yield {"feature": f"{what} of sphere {name}", "value_mm": sphere[key]}
        centre = sphere.get("centre_in_base_mm")
        if isinstance(centre, list) and len(centre) == 3 and all(map(_is_number, centre)):
            for axis, value in zip("xyz", centre, strict=True):
                yield {"feature": f"sphere {name} {axis}", "value_mm": value}


def _features(data: Mapping[str, object]) -> Iterator[dict[str, object]]:
    """Toleranced quantities of an inspection, lengths alone."""
    for check in _dicts(data.get("checks")):
        if check.get("unit") == "mm" and _is_number(check.get("measured")):
            limits = {"nominal_mm": check.get("nominal"), "lower_mm": check.get("lower"), "upper_mm": check.get("upper")}
            yield {"feature": str(check.get("name")), "value_mm": check["measured"], **limits}


def _dicts(found: object) -> list[Mapping[str, object]]:
    return [item for item in found if isinstance(item, Mapping)] if isinstance(found, list) else []


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
