"""RAPID robtargets and jointtargets: declared singly or as arrays, or written into the Move instructions themselves.

A robtarget is [[x, y, z], [q1, q2, q3, q4], [cf1, cf4, cf6, cfx], [six external axes]], mm and a quaternion w, x, y, z; a
jointtarget is [[six axes], [six external axes]], degrees. An axis that is not there is 9E9.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from drivers.errors import FileError
from drivers.files.pose_list import PoseLabel, PoseList, RotationNumbers
from drivers.kinematics.se3 import FloatArray

Kind = Literal["robtarget", "jointtarget"]
NO_EXTERNAL_AXIS = 9e9
SHAPES: dict[Kind, tuple[int, ...]] = {"robtarget": (3, 4, 4, 6), "jointtarget": (6, 6)}

_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_DECLARED = re.compile(r"\b(robtarget|jointtarget)\s+([A-Za-z]\w*)\s*(\{[^}]*\})?\s*:=([^;]*);", re.IGNORECASE)
_MOVED = re.compile(r"\bMove[A-Za-z]*\s*(?:\\\w+\s*,?\s*)*(\[\s*\[)", re.IGNORECASE)
_TEXT_OR_REMARK = re.compile(r'"[^"\n]*"|!.*')
_TRACK_MM = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class RapidTarget:
    """One target in its own units."""

    kind: Kind
    name: str
    """As declared; of an array with its place, as p{2}; of a Move instruction its line."""
    where: str
    parts: tuple[FloatArray, ...]
    """The inner arrays."""
    declared: bool = True
    """False where it stands in a Move instruction."""
    from_array: bool = False

    @property
    def external(self) -> tuple[float, ...]:
        """External axes, 9E9 where there is none."""
        return tuple(self.parts[-1].tolist())


def is_rapid(text: str) -> bool:
    """Whether a text holds targets, or a Move instruction with one."""
    plain = without_remarks(text)
    return bool(re.search(r"\b(robtarget|jointtarget)\b", plain, re.IGNORECASE) or _MOVED.search(plain))


def without_remarks(text: str) -> str:
    """A text without RAPID's comments and strings; its lines stay."""
    return _TEXT_OR_REMARK.sub("", text)


def rapid_targets(text: str, *, file: str | Path) -> tuple[RapidTarget, ...]:
    """All targets of a text in the order in which they stand there.

    Raises:
        FileError: a declaration that is not in plain numbers.
    """
    plain = without_remarks(text)
    places = [(match.start(), list(_declared(match, plain, file))) for match in _DECLARED.finditer(plain)]
    places += [(match.start(), list(_moved(match, plain))) for match in _MOVED.finditer(plain)]
    return tuple(target for _, targets in sorted(places, key=lambda place: place[0]) for target in targets)


def _declared(match: re.Match[str], text: str, file: str | Path) -> Iterator[RapidTarget]:
    kind: Kind = "robtarget" if match[1].lower() == "robtarget" else "jointtarget"
    where = f"line {_line(text, match.start())}, {match[2]}"
    value = _value(match[4])
    found = [value] if match[3] is None else value if isinstance(value, list) else [None]
    for i, item in enumerate(found, start=1):
        parts = _parts(item, SHAPES[kind])
        if parts is None:
            shape = ",".join(f"[{n} numbers]" for n in SHAPES[kind])
            raise FileError(f"is no {kind} in plain numbers", file=file, where=where, remedy=f"Write [{shape}].")
        name = match[2] if match[3] is None else f"{match[2]}{{{i}}}"
        yield RapidTarget(kind, name, where, parts, from_array=match[3] is not None)


def _moved(match: re.Match[str], text: str) -> Iterator[RapidTarget]:
    value = _value(_bracketed(text, match.start(1)))
    line = _line(text, match.start())
    for kind, shape in SHAPES.items():
        parts = _parts(value, shape)
        if parts is not None:
            yield RapidTarget(kind, f"line_{line}", f"line {line}", parts, declared=False)


def _line(text: str, place: int) -> int:
    return text.count("\n", 0, place) + 1


def _bracketed(text: str, start: int) -> str:
    """From an opening bracket to the one that closes it."""
    depth = 0
    for place in range(start, min(len(text), start + 2000)):
        depth += {"[": 1, "]": -1}.get(text[place], 0)
        if depth == 0:
            return text[start : place + 1]
    return ""


def _value(text: str) -> object:
    """Nested lists of the numbers in brackets; None for anything else."""
    tokens = re.findall(rf"{_NUMBER.pattern}|[\[\],]|\S", text)
    stack: list[list[object]] = [[]]
    expects_item = True
    for token in tokens:
        if token == "[" and expects_item and len(stack) < 6:
            stack.append([])
        elif token == "]" and len(stack) > 1 and not expects_item:
            inner = stack.pop()
            stack[-1].append(inner)
        elif token == "," and len(stack) > 1 and not expects_item:
            expects_item = True
            continue
        elif expects_item and _NUMBER.fullmatch(token) and len(stack) > 1:
            stack[-1].append(float(token))
        else:
            return None
        expects_item = token == "["
    return stack[0][0] if len(stack) == 1 and len(stack[0]) == 1 else None


def _parts(value: object, shape: Sequence[int]) -> tuple[FloatArray, ...] | None:
    """The inner arrays of a target; None unless their lengths are as in shape and all numbers finite."""
    if not isinstance(value, list) or len(value) != len(shape):
        return None
    for inner, n in zip(value, shape, strict=True):
        if not isinstance(inner, list) or len(inner) != n or not all(isinstance(item, float) and math.isfinite(item) for item in inner):
            return None
    return tuple(np.array(inner, dtype=np.float64) for inner in value)


def parse_rapid_poses(text: str, *, file: str | Path, use: Literal["both", "joints", "poses"] = "both") -> PoseList:
    """The targets of a RAPID text as poses. Where both kinds stand there they are paired by their names or numbers.

    Raises:
        FileError: no targets, both kinds without pairs, a robot that stands on a moving track, or as `rapid_targets`.
    """
    targets = rapid_targets(text, file=file)
    robtargets = [] if use == "joints" else [target for target in targets if target.kind == "robtarget"]
    jointtargets = [] if use == "poses" else [target for target in targets if target.kind == "jointtarget"]
    if not robtargets and not jointtargets:
        raise FileError("holds no target", file=file, remedy="Give a module with robtargets or jointtargets in plain numbers.")
    if robtargets and jointtargets and [_key(t.name) for t in robtargets] != [_key(t.name) for t in jointtargets]:
        message = f"holds {len(robtargets)} robtargets and {len(jointtargets)} jointtargets that are not pairs"
        raise FileError(message, file=file, remedy="Say with --use joints or --use poses which are meant, or leave one kind in the file.")
    _check_track(robtargets or jointtargets, file)
    labels = tuple(PoseLabel(target.where, name=target.name) for target in jointtargets or robtargets)
    quaternions = np.array([target.parts[1] for target in robtargets]) if robtargets else None
    kinds = [f"{len(found)} {kind}s" for kind, found in (("robtarget", robtargets), ("jointtarget", jointtargets)) if found]
    return PoseList(
        file=str(file),
        kind="rapid",
        labels=labels,
        joints=np.array([target.parts[0] for target in jointtargets]) if jointtargets else None,
        joint_unit="deg",
        positions=np.array([target.parts[0] for target in robtargets]) if robtargets else None,
        position_unit="mm",
        rotations=None if quaternions is None else RotationNumbers(quaternions, convention="quaternion-wxyz"),
        described=(f"RAPID: {' and '.join(kinds)}, taken for poses of tool0 in wobj0",) if robtargets else (f"RAPID: {kinds[0]}",),
    )


def _key(name: str) -> str:
    """By what a robtarget and a jointtarget are a pair: the numbers in their names, else the names."""
    return "".join(re.findall(r"\d+|\{", name)) or name.lower()


def _check_track(targets: Sequence[RapidTarget], file: str | Path) -> None:
    external = np.array([target.external for target in targets])
    moving = np.flatnonzero(np.ptp(external, axis=0) > _TRACK_MM)
    if moving.size:
        message = f"external axis {moving[0] + 1} moves: the robot, or the part, stands elsewhere from target to target"
        raise FileError(message, file=file, remedy="Calibrate with the external axes at one place, one session a place.")
