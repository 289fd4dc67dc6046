"""Lists of targets as people have them: CSV, JSON, and declarations of RAPID robtargets and jointtargets.

CSV: a header line; column `name` is optional; either `joint1_rad` ... `jointN_rad` (or `_deg`), or a flange pose in the base as
`x_mm, y_mm, z_mm, qw, qx, qy, qz`. Lines that begin with # are comments.
JSON: a list (or an object with the list under `targets`) of objects with `joints_rad`, `joints_deg` or `base_from_flange` (4x4, mm), and
optionally `name` and, for poses, `near_joints_rad`.
RAPID: every `robtarget name:=[...]` and `jointtarget name:=[...]` of a text, mm and degrees, for tool0 and wobj0.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.errors import FileError
from drivers.files.checks import Record, as_mapping
from drivers.files.disk import read_text
from drivers.files.rapid_targets import NO_EXTERNAL_AXIS, RapidTarget, rapid_targets, without_remarks
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

_POSE_COLUMNS = ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
_QUATERNION_TOLERANCE = 1e-3
_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_CORRECTED = re.compile(r"^[#!] spherecal calibration [0-9a-f]{64}", re.MULTILINE)


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """One target: axis angles, or a flange pose; exactly one of the two."""

    name: str
    where: str
    """Place in its file, for messages."""
    joints_rad: FloatArray | None = None
    base_from_flange: FloatArray | None = None
    """(4, 4), nominal pose of the flange in the base."""
    near_joints_rad: FloatArray | None = None
    quadrants: tuple[int, int, int] | None = None
    """RAPID's cf1, cf4, cf6: floor(angle / 90 degrees) of axes 1, 4 and 6."""
    external: tuple[float, ...] = (NO_EXTERNAL_AXIS,) * 6
    """RAPID's external axes, handed through."""


def read_targets(path: str | Path, n_joints: int) -> tuple[Target, ...]:
    """The targets of a file; its kind is told by its content.

    Raises:
        FileError: unreadable, or not as this module's docstring says; with place and remedy.
    """
    return parse_targets(read_text(path), n_joints, file=path)


def parse_targets(text: str, n_joints: int, *, file: str | Path) -> tuple[Target, ...]:
    """The targets of a text; `file` is only named in errors.

    Raises:
        FileError: as `read_targets`.
    """
    if _CORRECTED.search(text):
        raise FileError("holds targets that spherecal has corrected already", file=file, remedy="Give the nominal targets they were made from.")
    if text.lstrip()[:1] in ("[", "{"):
        targets = _json_targets(text, n_joints, file)
    elif re.search(r"\b(robtarget|jointtarget)\b", without_remarks(text), re.IGNORECASE):
        targets = _rapid_targets(text, n_joints, file)
    else:
        targets = _csv_targets(text, n_joints, file)
    if not targets:
        raise FileError("holds no target", file=file, remedy="Give at least one; see docs/export.md.")
    return targets


def _json_targets(text: str, n_joints: int, file: str | Path) -> tuple[Target, ...]:
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileError(f"broken JSON ({error})", file=file, remedy="Correct it there; see docs/export.md for an example.") from error
    items = data.get("targets") if isinstance(data, dict) else data
    if not isinstance(items, list):
        raise FileError("no list of targets", file=file, where="targets", remedy="Write a list of objects; see docs/export.md.")
    return tuple(_json_target(item, i, n_joints, str(file)) for i, item in enumerate(items))


def _json_target(item: object, i: int, n_joints: int, file: str) -> Target:
    where = f"target {i + 1}"
    record = Record(as_mapping(item, file=file, where=where), file, where)
    joints, degrees, pose = record.vector("joints_rad", n_joints), record.vector("joints_deg", n_joints), record.transform("base_from_flange")
    near, name = record.vector("near_joints_rad", n_joints), record.text("name") or f"target_{i + 1}"
    if sum(given is not None for given in (joints, degrees, pose)) != 1:
        record.fail("joints_rad", "give exactly one of joints_rad, joints_deg and base_from_flange", "Remove the others.")
    if record.rest:
        record.fail(next(iter(record.rest)), "is not known", "Allowed: name, joints_rad, joints_deg, base_from_flange, near_joints_rad.")
    return Target(name, where, np.radians(degrees) if degrees is not None else joints, pose, near)


def _csv_targets(text: str, n_joints: int, file: str | Path) -> tuple[Target, ...]:
    lines = [(i + 1, line) for i, line in enumerate(text.splitlines()) if line.strip() and not line.lstrip().startswith("#")]
    rows = [_csv_cells(line, i, file) for i, line in lines]
    if not rows:
        return ()
    header = rows[0]
    columns, scale = _csv_columns(header, n_joints, file)
    targets: list[Target] = []
    for (line, _), cells in zip(lines[1:], rows[1:], strict=True):
        where = f"line {line}"
        if len(cells) != len(header):
            raise FileError(f"{len(cells)} cells under {len(header)} columns", file=file, where=where, remedy="Give one value a column.")
        named = dict(zip(header, cells, strict=True))
        values = np.array([_number(named[column], column, file, where) for column in columns])
        name = named.get("name") or f"target_{len(targets) + 1}"
        if scale is None:
            targets.append(Target(name, where, base_from_flange=_pose(values, file, where)))
        else:
            targets.append(Target(name, where, joints_rad=values * scale))
    return tuple(targets)


def _csv_cells(line: str, number: int, file: str | Path) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader(io.StringIO(line), strict=True))]
    except csv.Error as error:
        raise FileError(f"broken CSV ({error})", file=file, where=f"line {number}", remedy="Separate values by commas, without quotes.") from error


def _csv_columns(header: list[str], n_joints: int, file: str | Path) -> tuple[tuple[str, ...], float | None]:
    """The columns that hold the target and, for axis angles, the factor to rad; None for a pose."""
    choices: list[tuple[tuple[str, ...], float | None]] = [
        (tuple(f"joint{i + 1}_rad" for i in range(n_joints)), 1.0),
        (tuple(f"joint{i + 1}_deg" for i in range(n_joints)), np.pi / 180),
        (_POSE_COLUMNS, None),
    ]
    found = [choice for choice in choices if set(header) - {"name"} == set(choice[0]) and len(set(header)) == len(header)]
    if not found:
        allowed = "; or ".join(", ".join(columns) for columns, _ in choices)
        raise FileError(
            f"the columns are {', '.join(header) or 'missing'}", file=file, where="header", remedy=f"Name them {allowed}; and name, if wanted."
        )
    return found[0]


def _rapid_targets(text: str, n_joints: int, file: str | Path) -> tuple[Target, ...]:
    if n_joints != 6:
        raise FileError(f"RAPID targets are for six axes, this robot has {n_joints}", file=file, remedy="Give the targets as CSV or JSON.")
    return tuple(_rapid_target(target, file) for target in rapid_targets(text, file=file) if target.declared)


def _rapid_target(target: RapidTarget, file: str | Path) -> Target:
    if target.from_array:
        raise FileError("is an array of targets", file=file, where=target.where, remedy="Declare every target by itself.")
    parts = target.parts
    if target.kind == "jointtarget":
        return Target(target.name, target.where, joints_rad=np.radians(parts[0]), external=target.external)
    quadrants = [round(value) for value in parts[2][:3]]
    pose = _pose(np.concatenate(parts[:2]), file, target.where)
    return Target(target.name, target.where, base_from_flange=pose, quadrants=(quadrants[0], quadrants[1], quadrants[2]), external=target.external)


def _pose(values: FloatArray, file: str | Path, where: str) -> FloatArray:
    """(4, 4) of x, y, z in mm and a quaternion w, x, y, z that may be rounded."""
    quaternion = values[3:]
    norm = float(np.linalg.norm(quaternion))
    if not abs(norm - 1) < _QUATERNION_TOLERANCE:
        raise FileError(f"the quaternion has length {norm:.6g}, not 1", file=file, where=where, remedy="Give it as w, x, y, z with enough digits.")
    w, vector = quaternion[0] / norm, quaternion[1:] / norm
    k = se3.hat(vector)
    return se3.from_rotation_translation(np.eye(3) + 2 * w * k + 2 * k @ k, values[:3])


def _number(text: str, column: str, file: str | Path, where: str) -> float:
    value = float(text) if _NUMBER.fullmatch(text) else np.inf
    if not np.isfinite(value):
        raise FileError(f"{column}: {text[:40]!r} is no finite number", file=file, where=where, remedy="Write a plain number.")
    return value


def json_data(head: Mapping[str, object], rows: list[dict[str, object]]) -> str:
    """JSON text of targets under a head."""
    return json.dumps({**head, "targets": rows}, indent=2, allow_nan=False) + "\n"
