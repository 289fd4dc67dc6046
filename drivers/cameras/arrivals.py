"""Files that appear in a folder: which are new since a moment, and whether one is whole."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from drivers.errors import CameraError, CameraTimeout, FileError, IncompleteFrame
from drivers.files.clouds import parse_cloud
from drivers.files.ply import PointCloud


@dataclass(frozen=True, slots=True)
class Stamp:
    """What changes when a file is written: one that is written over is another file."""

    size: int
    modified_ns: int
    inode: int


def snapshot(folder: Path, patterns: Sequence[str]) -> dict[str, Stamp]:
    """Names and stamps of the files in a folder that fit one of the patterns; files that vanish meanwhile are left out.

    Raises:
        OSError: the folder cannot be read.
    """
    with os.scandir(folder) as entries:
        names = [entry.name for entry in entries if any(fnmatch(entry.name.lower(), pattern.lower()) for pattern in patterns)]
    stamps = {name: stamp_of(folder / name) for name in names}
    return {name: stamp for name, stamp in stamps.items() if stamp is not None}


def stamp_of(path: Path) -> Stamp | None:
    """The stamp of a plain file, None where there is none."""
    try:
        status = path.stat()
        return Stamp(status.st_size, status.st_mtime_ns, status.st_ino) if path.is_file() else None
    except OSError:
        return None


def new_names(before: Mapping[str, Stamp], now: Mapping[str, Stamp]) -> list[str]:
    """Names that are new or whose files were written over, in order."""
    return sorted(name for name, stamp in now.items() if before.get(name) != stamp)


@dataclass(frozen=True, slots=True, eq=False)
class Arrived:
    """A scan that has come whole."""

    name: str
    cloud: PointCloud
    sha256: str


class Watch:
    """Watches one file until it has not changed for a while and holds a whole cloud."""

    def __init__(self, folder: Path, stable_s: float) -> None:
        self._folder, self._stable_s = folder, stable_s
        self._stamp: Stamp | None = None
        self._since_s = 0.0
        self._refused: Stamp | None = None
        self._name: str | None = None
        self._why = "it was still being written"

    def look(self, name: str | None, now_s: float) -> Arrived | None:
        """The scan, if the file of this name is whole now; call it again until it is."""
        self._name = name
        stamp = None if name is None else stamp_of(self._folder / name)
        if name is None or stamp is None:
            return None
        if stamp != self._stamp:
            self._stamp, self._since_s = stamp, now_s
        if now_s - self._since_s < self._stable_s or stamp == self._refused:
            return None
        return self._read(name, stamp)

    def _read(self, name: str, stamp: Stamp) -> Arrived | None:
        path = self._folder / name
        try:
            data = path.read_bytes()
            if stamp_of(path) != stamp:
                return None
            return Arrived(name, parse_cloud(data, file=path), hashlib.sha256(data).hexdigest())
        except OSError:
            # Windows keeps others out while the camera's software still writes
            self._why = "it cannot be read"
        except FileError as error:
            self._refused, self._why = stamp, error.message
        return None

    def too_late(self, timeout_s: float) -> CameraError:
        """What to raise when time is up."""
        if self._name is None:
            remedy = "Check that the camera's software exports into this folder, the trigger, and `pattern`; or allow more time."
            return CameraTimeout(f"no scan appeared within {timeout_s:g} s", file=self._folder, remedy=remedy)
        remedy = "Export PLY, PCD or NPZ, let one program write the folder, or allow more time."
        return IncompleteFrame(f"the scan was not whole within {timeout_s:g} s: {self._why}", file=self._folder / self._name, remedy=remedy)
