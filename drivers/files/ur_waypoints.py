"""Poses in URScript and in PolyScope's exported programs: `p[x, y, z, rx, ry, rz]` in m and rad, `[q1 ... q6]` in rad."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from drivers.errors import FileError
from drivers.files.pose_list import PoseLabel, PoseList, RotationNumbers

_NUMBER = r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
_SIX = re.compile(
    rf"(?:(?P<name>[A-Za-z_]\w*)\s*=\s*|(?P<call>[A-Za-z_]\w*)\s*\(\s*)?(?P<pose>p?)\[\s*(?P<numbers>{_NUMBER}(?:\s*,\s*{_NUMBER}){{5}})\s*\]"
)
_MOVES = ("movej", "movel", "movep", "movec")
_POINT = re.compile(r"(.+)_([pq])")
_REMEDY = "Give a script with waypoints as p[x, y, z, rx, ry, rz] or [q1, ..., q6] in plain numbers, in m and rad."


@dataclass(frozen=True, slots=True)
class _Six:
    is_pose: bool
    name: str | None
    call: str | None
    line: int
    numbers: tuple[float, ...]


def is_ur_script(text: str) -> bool:
    """Whether a text holds six numbers in brackets, as URScript writes poses and axis angles."""
    return _SIX.search(_without_remarks(text)) is not None


def parse_ur_poses(text: str, *, file: str | Path, use: Literal["both", "joints", "poses"] = "both") -> PoseList:
    """The waypoints of a script: by name (`Waypoint_1_p`, `Waypoint_1_q`) where there are such, else those of the moves in order.

    Raises:
        FileError: no waypoints, or poses and axis angles of which nobody can tell what belongs to what.
    """
    found = [_six(match, _without_remarks(text)) for match in _SIX.finditer(_without_remarks(text))]
    waypoints = [six for six in found if six.name is not None and _POINT.fullmatch(six.name)]
    chosen = waypoints or [six for six in found if six.name is None and (six.call is None or six.call in _MOVES)]
    poses = [] if use == "joints" else [six for six in chosen if six.is_pose]
    joints = [] if use == "poses" else [six for six in chosen if not six.is_pose]
    if not poses and not joints:
        raise FileError("holds no waypoint", file=file, remedy=_REMEDY)
    if poses and joints and (not waypoints or [_stem(six) for six in poses] != [_stem(six) for six in joints]):
        message = f"holds {len(poses)} poses and {len(joints)} times axis angles that are not pairs"
        raise FileError(message, file=file, remedy="Say with --use joints or --use poses which are meant, or name them as Waypoint_1_p and _q.")
    pose_numbers = np.array([six.numbers for six in poses])
    kinds = [f"{len(group)} {kind}" for kind, group in (("poses", poses), ("times axis angles", joints)) if group]
    return PoseList(
        file=str(file),
        kind="ur",
        labels=tuple(PoseLabel(f"line {six.line}", name=_stem(six)) for six in joints or poses),
        joints=np.array([six.numbers for six in joints]) if joints else None,
        joint_unit="rad",
        positions=pose_numbers[:, :3] if poses else None,
        position_unit="m",
        rotations=RotationNumbers(pose_numbers[:, 3:], convention="rotation-vector", unit="rad") if poses else None,
        described=(f"URScript: {' and '.join(kinds)}",),
    )


def _six(match: re.Match[str], text: str) -> _Six:
    numbers = tuple(float(word) for word in match["numbers"].split(","))
    return _Six(bool(match["pose"]), match["name"], match["call"], text.count("\n", 0, match.start("numbers")) + 1, numbers)


def _stem(six: _Six) -> str | None:
    match = None if six.name is None else _POINT.fullmatch(six.name)
    return None if match is None else match[1]


def _without_remarks(text: str) -> str:
    return re.sub(r"#.*", "", text)
