"""What the columns of a table of poses mean, by their names; and the names that a user may give instead."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from drivers.files.pose_list import AngleUnit, LengthUnit

Kind = Literal["joint", "position", "turn", "angle", "vector", "quaternion", "four", "matrix", "name", "number", "cloud", "sphere", "time"]
Unit = AngleUnit | LengthUnit


@dataclass(frozen=True, slots=True)
class Column:
    """The meaning of one column."""

    kind: Kind
    """`turn` is an angle about a named axis, `angle` the first, second or third of three, `vector` of a rotation vector, `four` of a quaternion
    that may begin with w or with x."""
    index: int = 0
    """Which joint, axis or number, from 0; of a quaternion 0 is w; of a matrix row by row."""
    unit: Unit | None = None


IGNORED = ("-", "_", "ignore", "skip")
"""Names by which a user leaves a column out."""

_UNITS: dict[str, Unit] = {
    **dict.fromkeys(("mm", "millimetre", "millimeter", "millimetres", "millimeters"), "mm"),
    **dict.fromkeys(("m", "metre", "meter", "metres", "meters"), "m"),
    **dict.fromkeys(("deg", "degree", "degrees", "\N{DEGREE SIGN}", "grad"), "deg"),
    **dict.fromkeys(("rad", "radian", "radians"), "rad"),
}
_UNIT_AT_END = re.compile(rf"[\s_/\[({{<]+({'|'.join(sorted(map(re.escape, _UNITS), key=len, reverse=True))})\s*[\])}}>]?$")
_PREFIX = re.compile(
    r"^(?:base|robot|flange|tool0?|tcp|ee|eef|end_?effector|pose|pos|position|cart|cartesian|actual|trans|translation|t|p|rot|"
    r"rotation|orientation|orient|ori|euler|angle|r)_+(?=.)"
)
_JOINT = re.compile(r"^(?:actual_)?(?:joint|jnt|j|axis|ax|a|q|theta|th|rax|achse|gelenk)(?:_?(?:angle|pos|position|value))?_?(\d{1,2})$")
_UR_JOINTS = {"base": 0, "shoulder_pan": 0, "shoulder": 1, "shoulder_lift": 1, "elbow": 2, "wrist_1": 3, "wrist_2": 4, "wrist_3": 5}
_UR_POSE = re.compile(r"^(?:actual|target)_tcp_pose_([0-5])$")
_MATRIX = re.compile(r"^(?:r|m|t|rot)_?([0-4])_?([0-4])$")
_WORDS: dict[str, Column] = {
    **{name: Column("position", i) for i, axis in enumerate("xyz") for name in (axis, f"t{axis}", f"p{axis}", f"pos{axis}")},
    **{name: Column("turn", i) for i, axis in enumerate("xyz") for name in (f"r{axis}", f"rot{axis}")},
    **{name: Column("turn", i) for i, name in enumerate(("roll", "pitch", "yaw"))},
    **{name: Column("vector", i) for i, axis in enumerate("xyz") for name in (f"rv{axis}", f"rotvec_{axis}", f"rotvec{axis}")},
    **{name: Column("quaternion", i) for i, axis in enumerate("wxyz") for name in (f"q{axis}", f"quat_{axis}", f"quaternion_{axis}", f"q_{axis}")},
    **{name: Column("angle", i) for i in range(3) for name in (f"r{i + 1}", f"e{i + 1}", f"euler{i + 1}", f"angle{i + 1}", f"euler_{i + 1}")},
    **{f"n{i + 1}": Column("four", i) for i in range(4)},
    **dict.fromkeys(("name", "pose", "pose_name", "pose_id", "id", "target", "label", "point", "waypoint"), Column("name")),
    **dict.fromkeys(("number", "no", "nr", "no.", "index", "idx", "i", "n", "shot", "frame", "step"), Column("number")),
    **dict.fromkeys(("cloud", "file", "filename", "file_name", "scan", "ply", "pcd", "npz", "pointcloud", "point_cloud", "path"), Column("cloud")),
    **dict.fromkeys(("sphere", "ball", "artefact", "artifact"), Column("sphere")),
    **dict.fromkeys(("time", "timestamp", "time_utc", "date", "datetime"), Column("time")),
}
_TRIPLES = (("a", "b", "c"), ("w", "p", "r"), ("o", "a", "t"), ("alpha", "beta", "gamma"), ("phi", "theta", "psi"))
_GROUPS: dict[str, tuple[str, ...]] = {
    "joints": tuple(f"j{i}" for i in range(1, 7)),
    "position": ("x", "y", "z"),
    "angles": ("r1", "r2", "r3"),
    "quaternion": ("n1", "n2", "n3", "n4"),
    # the last row is 0 0 0 1
    "transform": (*(f"m{i}{k}" for i in "123" for k in "1234"), "-", "-", "-", "-"),
    "matrix": tuple(f"r{i}{k}" for i in "123" for k in "123"),
}


def columns_of(names: Sequence[str]) -> tuple[Column | None, ...]:
    """The meaning of columns, None for those that mean nothing here."""
    plain = [_plain(name) for name in names]
    words = [word for word, _ in plain]
    triple = next((names for names in _TRIPLES if set(names) <= set(words) and not (names == _TRIPLES[0] and {"o", "t"} <= set(words))), ())
    found = [_meaning(word, triple, _holds_quaternion(words)) for word in words]
    made = [None if column is None else Column(column.kind, column.index, unit) for column, (_, unit) in zip(found, plain, strict=True)]
    return _counted_from_zero(made)


def expanded(names: Sequence[str]) -> tuple[str, ...]:
    """Column names with groups written out: joints, position, angles, quaternion, matrix, transform.

    Each may end in a unit, as `joints_deg`.
    """
    result: list[str] = []
    for name in names:
        word, unit = _plain(name)
        ending = f"_{unit}" if unit else ""
        result += [item if item == "-" else f"{item}{ending}" for item in _GROUPS[word]] if word in _GROUPS else [name.strip()]
    return tuple(result)


def _plain(name: str) -> tuple[str, Unit | None]:
    """A name in small letters with underscores and without its unit, and the unit."""
    text = name.strip().lower()
    unit: Unit | None = None
    if (match := _UNIT_AT_END.search(text)) and match.start() > 0:
        text, unit = text[: match.start()], _UNITS[match[1]]
    return re.sub(r"[\s\-.]+", "_", text.strip()).strip("_") or text, unit


def _holds_quaternion(words: Sequence[str]) -> bool:
    """ABB's q1 .. q4 are w, x, y, z, as are q0 .. q3; with more of them they are axes."""
    return sorted(word for word in words if re.fullmatch(r"q_?[0-9]", word)) in (["q1", "q2", "q3", "q4"], ["q0", "q1", "q2", "q3"])


def _meaning(word: str, triple: tuple[str, ...], q_is_quaternion: bool) -> Column | None:
    if word in triple:
        return Column("angle", triple.index(word))
    if q_is_quaternion and re.fullmatch(r"q[0-4]", word):
        return Column("quaternion", int(word[1]))
    found = _numbered(word) or _WORDS.get(word)
    if found is not None:
        return found
    shorter = _PREFIX.sub("", word, count=1)
    return None if shorter == word else _meaning(_turned(word, shorter), triple, q_is_quaternion)


def _numbered(word: str) -> Column | None:
    """Joints, elements of a matrix, and what Universal Robots' logs call them."""
    if match := _UR_POSE.match(word):
        i = int(match[1])
        return Column("position", i) if i < 3 else Column("vector", i - 3)
    if (stripped := word.removesuffix("_joint")) in _UR_JOINTS:
        return Column("joint", _UR_JOINTS[stripped])
    if match := _MATRIX.match(word):
        return Column("matrix", int(match[1]) * 10 + int(match[2]))
    match = _JOINT.match(word)
    return None if match is None or word in _WORDS else Column("joint", int(match[1]))


def _turned(word: str, shorter: str) -> str:
    """The letter behind `rot_` or `r_` is an axis to turn about, behind `rotation_` too; behind others a direction."""
    head = word[: len(word) - len(shorter)].strip("_")
    if shorter in {"x", "y", "z", "w"} and head in {"orientation", "orient", "ori"}:
        return f"q{shorter}"
    return f"r{shorter}" if shorter in {"x", "y", "z"} and head in {"rot", "rotation", "r", "euler", "angle"} else shorter


def _counted_from_zero(columns: list[Column | None]) -> tuple[Column | None, ...]:
    """Joints and matrix elements counted from 0, whichever way the names count."""
    named = [c.index for c in columns if c is not None and c.kind == "joint"]
    by_name = any(c is not None and c.kind == "joint" and c.index == 0 for c in columns)
    first = 0 if by_name or not named else 1
    four = [c.index for c in columns if c is not None and c.kind == "quaternion"]
    elements = [c.index for c in columns if c is not None and c.kind == "matrix"]
    origin = 0 if any(index < 10 or index % 10 == 0 for index in elements) else 1
    result: list[Column | None] = []
    for column in columns:
        if column is not None and column.kind == "joint":
            result.append(Column("joint", column.index - first, column.unit))
        elif column is not None and column.kind == "quaternion":
            result.append(Column("quaternion", column.index - min(four), column.unit))
        elif column is not None and column.kind == "matrix":
            row, place = column.index // 10 - origin, column.index % 10 - origin
            # a fourth column is the translation, a fourth row is 0 0 0 1
            known = Column("matrix", 3 * row + place) if row < 3 and place < 3 else Column("position", row, column.unit) if row < 3 else None
            result.append(known)
        else:
            result.append(column)
    return tuple(result)
