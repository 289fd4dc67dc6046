"""A list of poses from any file that is read: a table, JSON, RAPID targets, or a URScript; told apart by its content."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from drivers.errors import FileError
from drivers.files.disk import read_bytes
from drivers.files.pose_list import PoseList
from drivers.files.poses_csv import parse_pose_table, poses_of_table
from drivers.files.poses_json import is_json, parse_json_table
from drivers.files.rapid_targets import is_rapid, parse_rapid_poses
from drivers.files.ur_waypoints import is_ur_script, parse_ur_poses

Use = Literal["both", "joints", "poses"]


def read_poses(path: str | Path, *, columns: Sequence[str] | None = None, use: Use = "both") -> PoseList:
    """The poses of a file in UTF-8, UTF-16 with its mark, or Windows' and IRC5's single-byte texts.

    Raises:
        FileError: missing, or as `parse_poses`.
    """
    return parse_poses(_text(read_bytes(path)), file=path, columns=columns, use=use)


def parse_poses(text: str, *, file: str | Path, columns: Sequence[str] | None = None, use: Use = "both") -> PoseList:
    """The poses of a text.

    Args:
        text: of the file.
        file: only named in errors.
        columns: names of a table's columns, instead of its header's.
        use: axis angles alone, poses alone, or both, where both stand there.

    Raises:
        FileError: as the readers of the kinds, or what is to be used is not there.
    """
    if columns is None and is_rapid(text):
        return _finite(parse_rapid_poses(text, file=file, use=use))
    json = is_json(text)
    if columns is None and not json and is_ur_script(text):
        return _finite(parse_ur_poses(text, file=file, use=use))
    if json:
        found = poses_of_table(parse_json_table(text, file=file), file=file, columns=columns)
    else:
        found = parse_pose_table(text, file=file, columns=columns)
    if use == "joints":
        found = replace(found, positions=None, rotations=None)
    if use == "poses":
        found = replace(found, joints=None)
    if found.joints is None and found.positions is None:
        raise FileError(f"holds no {use}", file=file, where="header", remedy="Leave out --use, or name the columns with --columns.")
    return found


def _finite(found: PoseList) -> PoseList:
    """Refuse numbers that a float cannot hold; nothing else is checked here.

    Raises:
        FileError: with the place.
    """
    for values in (found.joints, found.positions, None if found.rotations is None else found.rotations.numbers):
        if values is not None and (bad := np.flatnonzero(~(np.abs(values) < 1e300).all(axis=1))).size:
            raise FileError("a number is not finite", file=found.file, where=found.labels[bad[0]].where, remedy="Correct it.")
    return found


def _text(data: bytes) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        # pendants and older spreadsheets; only names can be wrong then, never numbers
        return data.decode("cp1252", errors="replace")
