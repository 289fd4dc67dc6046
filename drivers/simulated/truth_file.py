"""The file of a truth: format spherecal-truth/1, strict both ways."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from drivers.errors import FileError
from drivers.files.disk import read_text, write_text_atomic
from drivers.files.yaml import dump_yaml, parse_yaml
from drivers.kinematics import se3
from drivers.simulated.truth import Truth

FORMAT = "spherecal-truth/1"


def load_truth(path: str | Path) -> Truth:
    """The truth of a file.

    Raises:
        FileError: missing, broken, another format, an unknown key, a wrong type, a transform that is not rigid.
    """
    return parse_truth(read_text(path), file=path)


def parse_truth(text: str, *, file: str | Path) -> Truth:
    """The truth of a YAML text; raises as `load_truth`, `file` is only named in errors."""
    data = parse_yaml(text, file=file)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else type(data).__name__
        raise FileError(f"the format is {found!r}", file=file, where="format", remedy=f"A truth file begins with `format: {FORMAT}`.")
    content = {key: value for key, value in data.items() if key != "format"}
    try:
        # by way of JSON, pydantic's strict mode takes lists for tuples and whole numbers for floats, and nothing else
        truth = TypeAdapter(Truth).validate_json(json.dumps(content), strict=True)
    except (ValidationError, TypeError) as error:
        raise _told(error, file) from error
    _check(truth, file)
    return truth


def write_truth(truth: Truth, path: str | Path) -> None:
    """Write a truth in one step; `load_truth` gives back an equal one.

    Raises:
        FileError: the folder is missing or not writable.
    """
    write_text_atomic(path, dump_yaml({"format": FORMAT, **asdict(truth)}))


def _told(error: ValidationError | TypeError, file: str | Path) -> FileError:
    if isinstance(error, TypeError):
        return FileError(f"holds a value that is not plain data ({error})", file=file, remedy="Use text, numbers, lists and mappings.")
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return FileError(first["msg"].lower(), file=file, where=where, remedy="The keys are those of drivers/simulated/truth.py.")


def _check(truth: Truth, file: str | Path) -> None:
    transforms = {"camera.flange_from_camera": truth.camera.flange_from_camera}
    transforms |= {f"boxes.{i}.base_from_box": box.base_from_box for i, box in enumerate(truth.boxes)}
    if truth.workpiece is not None:
        transforms["workpiece.base_from_part"] = truth.workpiece.base_from_part
    for where, transform in transforms.items():
        if not se3.is_rigid(transform):
            raise FileError("this is no rigid transform", file=file, where=where, remedy="Give an orthonormal rotation and the last row 0 0 0 1.")
    lengths = {len(values) for values in truth.robot.per_axis().values()} - {0}
    if len(lengths) > 1:
        counts = " or ".join(str(n) for n in sorted(lengths))
        raise FileError(f"lists of {counts} axes", file=file, where="robot", remedy="Give every list one entry per axis, or leave it out.")
