"""Which cloud belongs to which pose: by a column of file names, by names, by numbers, or in natural order."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from drivers.errors import DataError, FileError
from drivers.files.clouds import SUFFIXES
from drivers.files.pose_list import PoseLabel

By = Literal["auto", "file", "name", "number", "order"]
_Way = Literal["file", "name", "number"]


_Match = Callable[[Sequence[PoseLabel], Sequence[Path]], "list[Path | None] | None"]


@dataclass(frozen=True, slots=True)
class Matching:
    """The cloud of every pose."""

    clouds: tuple[Path | None, ...]
    """None where a pose has none."""
    by: Literal["file", "name", "number", "order"]
    unused: tuple[Path, ...]
    """Clouds that belong to no pose."""


def find_clouds(where: str | Path) -> tuple[Path, ...]:
    """The clouds in a folder, or those that a pattern names, in natural order.

    Raises:
        FileError: there is no such folder, or nothing in it that is read.
    """
    place = Path(where)
    if place.is_dir():
        found = [path for path in place.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file()]
        stems = [path.stem for path in found]
        if twice := next((stem for stem in stems if stems.count(stem) > 1), None):
            message = f"{twice} is there in several formats"
            raise FileError(message, file=place, remedy=f"Name one kind with a pattern, as '{place}/*.ply'.")
    else:
        folder = place.parent
        if not folder.is_dir():
            raise FileError("no such folder", file=folder, remedy="Name the folder of the clouds, or a pattern in quotes.")
        found = [path for path in folder.glob(place.name) if path.is_file()]
    if not found:
        raise FileError("holds no clouds", file=place, remedy=f"Give a folder or a pattern of {', '.join(SUFFIXES)} files.")
    return tuple(sorted(found, key=lambda path: natural_key(path.name)))


def natural_key(text: str) -> tuple[tuple[int, int, str], ...]:
    """A key that sorts numbers in names by their size: scan_2 before scan_10."""
    parts = re.split(r"([0-9]+)", text.lower())
    return tuple((0, int(part), part) if part.isdigit() and part.isascii() else (1, 0, part) for part in parts if part)


def match_clouds(labels: Sequence[PoseLabel], clouds: Sequence[Path], by: By = "auto", *, file: str | Path, allow_missing: bool = False) -> Matching:
    """The cloud of every pose.

    Args:
        labels: of the poses.
        clouds: in natural order.
        by: the way, or `auto`: the first of file, name, number and order that applies.
        file: of the poses, for messages.
        allow_missing: whether poses may be without a cloud and clouds without a pose, where names or numbers tell.

    Raises:
        DataError: something is missing, or nothing tells what belongs to what.
    """
    tries: dict[_Way, _Match] = {"file": _by_file, "name": _by_name, "number": _by_number}
    for way, match in tries.items():
        if by in {"auto", way}:
            found = match(labels, clouds)
            if found is not None:
                return _whole(labels, clouds, found, way, allow_missing, file)
            if by == way:
                message = f"poses and clouds cannot be matched by {way}"
                raise DataError(message, file=file, remedy="The poses need a column file, name or number, and the clouds names that tell it.")
    if len(labels) != len(clouds):
        message = f"{len(labels)} poses and {len(clouds)} clouds, and no names or numbers that tell what belongs to what"
        raise DataError(message, file=file, remedy="Add a column with the file name of each cloud, or take out what has no partner.")
    return Matching(tuple(clouds), "order", ())


def _by_file(labels: Sequence[PoseLabel], clouds: Sequence[Path]) -> list[Path | None] | None:
    if all(label.cloud is None for label in labels):
        return None
    names = {key: path for path in clouds for key in (path.stem.lower(), path.name.lower())}
    return [None if label.cloud is None else names.get(re.split(r"[/\\]", label.cloud)[-1].lower()) for label in labels]


def _by_name(labels: Sequence[PoseLabel], clouds: Sequence[Path]) -> list[Path | None] | None:
    """By names that are the same as those of the clouds, where at least half of them are."""
    stems = {path.stem.lower(): path for path in clouds}
    found = [None if label.name is None else stems.get(Path(label.name.lower()).name) for label in labels]
    return found if 2 * sum(path is not None for path in found) > len(labels) else None


def _by_number(labels: Sequence[PoseLabel], clouds: Sequence[Path]) -> list[Path | None] | None:
    numbers = [label.number for label in labels]
    if None in numbers:
        numbers = _varying_numbers([label.name or "" for label in labels])
    of_clouds = _varying_numbers([path.stem for path in clouds])
    if None in numbers or None in of_clouds or len(set(numbers)) < len(numbers) or not numbers:
        return None
    by_number = dict(zip(of_clouds, clouds, strict=True))
    return [by_number.get(number) for number in numbers]


def _varying_numbers(names: Sequence[str]) -> list[int | None]:
    """The number in each name that is another in every one; all None where there is no such, or several."""
    nothing: list[int | None] = [None] * len(names)
    numbers = [[int(word) for word in re.findall(r"[0-9]{1,12}", name)] for name in names]
    if len({len(found) for found in numbers}) != 1:
        return nothing
    columns: list[tuple[int, ...]] = [column for column in zip(*numbers, strict=True) if len(set(column)) == len(names)]
    return list(columns[0]) if len(columns) == 1 else nothing


def _whole(
    labels: Sequence[PoseLabel],
    clouds: Sequence[Path],
    found: list[Path | None],
    by: _Way,
    allow_missing: bool,
    file: str | Path,
) -> Matching:
    taken = [path for path in found if path is not None]
    if twice := next((path for path in taken if taken.count(path) > 1), None):
        places = ", ".join(label.where for label, path in zip(labels, found, strict=True) if path == twice)
        raise DataError(f"{twice.name} is claimed by several poses ({places})", file=file, remedy="Correct names or numbers.")
    missing = [label for label, path in zip(labels, found, strict=True) if path is None]
    unused = tuple(path for path in clouds if path not in set(taken))
    if (missing or unused) and not allow_missing:
        parts = [f"no cloud for {_few([_told(label) for label in missing])}"] if missing else []
        parts += [f"no pose for {_few([path.name for path in unused])}"] if unused else []
        remedy = "Correct them; or give --match order where both are in one order, or --allow-missing to leave out what has no partner."
        raise DataError(f"matched by {by}: {' and '.join(parts)}", file=file, remedy=remedy)
    if not taken:
        raise DataError(f"matched by {by}, no pose has a cloud", file=file, remedy="Name the right folder with --clouds, or give --match order.")
    return Matching(tuple(found), by, unused)


def _told(label: PoseLabel) -> str:
    what = label.cloud or label.name or (None if label.number is None else str(label.number))
    return label.where if what is None else f"{what} ({label.where})"


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
