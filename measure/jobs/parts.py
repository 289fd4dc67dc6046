"""What is a part, and when is it complete: a session that is being written, copied or was cut short is left alone.

A folder is looked at, never opened for writing. It is complete when

1. no process holds the lock that a capture keeps on its `shots.jsonl` (`acquire.session_folder.open_locked`),
2. nothing in it changed for some seconds (copies hold no lock),
3. a session ends with a whole line, and every pose of its plan has a line; every pose of a pose list has its cloud.

An empty file `COMPLETE` in the folder stands for rule 3: a person says that this is all there will be.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from drivers.errors import FileError, SpherecalError
from drivers.files.disk import read_bytes, read_text, sha256_hex
from drivers.files.session import session_digest
from measure.jobs.model import PartKind

MARKER = "COMPLETE"
CLOUD_FOLDERS = ("clouds", "scans")
_POSE_FILES = re.compile(r"poses\.(csv|tsv|txt|json|mod|prg|script|urscript)", re.IGNORECASE)
_COPYING = re.compile(r".*\.(part|partial|filepart|crdownload)", re.IGNORECASE)
_LONGEST_NAME = 80


@dataclass(frozen=True, slots=True)
class Contents:
    """The files below a folder, as `stat` tells them."""

    fingerprint: str
    """sha256 over names, sizes and modification times."""
    changed_s: float
    """When the youngest file, or an entry of a folder, last changed on this disk (Unix time)."""
    scan_bytes: tuple[int, ...]
    """Sizes of the clouds."""
    copying: str | None
    """A file that a copying program has not finished."""


@dataclass(frozen=True, slots=True)
class Look:
    """What a folder looked like."""

    state: Literal["ready", "settling", "held"]
    """settling ends by itself within seconds; held waits for somebody."""
    kind: PartKind
    contents: Contents
    reason: str = ""
    """Why not ready."""


def part_name(folder: Path) -> str:
    """The folder's name in characters that suit every disk and web page."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", folder.name).strip("._")[:_LONGEST_NAME] or "part"


def kind_of(folder: Path) -> PartKind | None:
    """Whether a folder is a session, scans with poses, or neither."""
    if (folder / "session.yaml").is_file():
        return "session"
    return None if pose_file(folder) is None else "scans"


def pose_file(folder: Path) -> Path | None:
    """The pose list of a folder of scans: `poses.csv`, `poses.mod`, `poses.script`, ..."""
    with suppress(OSError):
        return next((path for path in sorted(folder.iterdir()) if _POSE_FILES.fullmatch(path.name)), None)
    return None


def cloud_folder(folder: Path) -> Path:
    """Where the clouds of a folder of scans lie: in `clouds/` or `scans/` where there is one, else beside the poses."""
    return next((folder / name for name in CLOUD_FOLDERS if (folder / name).is_dir()), folder)


def parts_in(folder: Path) -> Iterator[Path]:
    """Every folder right below that is a part, by name; hidden ones are still being made.

    Raises:
        OSError: the folder is gone, or may not be read.
    """
    with os.scandir(folder) as entries:
        names = sorted(entry.name for entry in entries if not entry.name.startswith(".") and entry.is_dir())
    return (folder / name for name in names if kind_of(folder / name) is not None)


def parts_of_list(path: Path) -> tuple[Path, ...]:
    """The folders that a text file names, one a line, relative to it; `#` begins a comment.

    Raises:
        FileError: it is missing, no text, or names nothing.
    """
    lines = [line.split("#", 1)[0].strip() for line in read_text(path).splitlines()]
    found = tuple(dict.fromkeys((path.parent / line).absolute() for line in lines if line))
    if not found:
        raise FileError("names no part", file=path, remedy="Write one session folder a line.")
    return found


def contents_of(folder: Path) -> Contents:
    """Look at every file below a folder, without opening one.

    Raises:
        OSError: something vanished meanwhile, or may not be read.
    """
    digest, changed_s = hashlib.sha256(), folder.stat().st_ctime
    scans: list[int] = []
    copying: str | None = None
    for root, folders, names in os.walk(folder, onerror=_raise):
        folders.sort()
        changed_s = max(changed_s, os.stat(root).st_ctime)
        for name in sorted(names):
            path = os.path.join(root, name)
            found = os.stat(path)
            # a file's mtime may be that of its original; its ctime is when it came to this disk
            changed_s = max(changed_s, found.st_ctime)
            digest.update(f"{os.path.relpath(path, folder)}\0{found.st_size}\0{found.st_mtime_ns}\n".encode(errors="surrogateescape"))
            if name.lower().endswith((".ply", ".pcd", ".npz")):
                scans.append(found.st_size)
            if _COPYING.fullmatch(name):
                copying = name
    return Contents(digest.hexdigest(), changed_s, tuple(scans), copying)


def look_at(folder: Path, kind: PartKind, contents: Contents, settle_s: float) -> Look:
    """Decide whether a part is complete.

    Args:
        folder: the part.
        kind: what `kind_of` says.
        contents: what `contents_of` says.
        settle_s: for how long nothing must have changed.

    Raises:
        OSError: it vanished meanwhile, or may not be read.
    """
    if contents.copying is not None:
        return Look("held", kind, contents, f"{contents.copying} is still being copied")
    # a share whose clock runs ahead gives times to come: such a folder is settled when its time has come
    if time.time() - contents.changed_s < settle_s:
        return Look("settling", kind, contents, "it changed a moment ago")
    lacking = None
    if not (folder / MARKER).exists():
        lacking = _lacking_in_session(folder) if kind == "session" else _lacking_in_scans(folder)
    # last, since asking for the lock holds it for a moment, in which a capture that begins would find it taken
    if lacking is None and kind == "session" and _is_being_written(folder):
        lacking = "a capture is writing to it"
    return Look("ready", kind, contents) if lacking is None else Look("held", kind, contents, lacking)


def input_digest(folder: Path, kind: PartKind, cell_sha256: str | None) -> str:
    """What the inputs are: `Session.digest` of a session, whole or broken; of scans, over the bytes of all files.

    Raises:
        OSError: something vanished meanwhile, or may not be read.
    """
    if kind == "session":
        with suppress(FileError):
            return session_digest(folder, folder / "cell.yaml")
        names = [name for name in ("session.yaml", "cell.yaml", "shots.jsonl", "plan.yaml", "robot_model.yaml") if (folder / name).exists()]
        return sha256_hex("".join(f"broken {name} {sha256_hex((folder / name).read_bytes())}\n" for name in names).encode())
    poses, clouds = pose_file(folder), cloud_folder(folder)
    digest = hashlib.sha256(f"cell {cell_sha256}\n".encode())
    for path in sorted({*([poses] if poses else []), *(path for path in clouds.iterdir() if path.is_file())}):
        with path.open("rb") as stream:
            digest.update(f"{path.name} {hashlib.file_digest(stream, 'sha256').hexdigest()}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()


def _is_being_written(folder: Path) -> bool:
    try:
        with (folder / "shots.jsonl").open("rb") as stream:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # no such file yet, or a share without locks: the other rules judge
        return False
    return False


def _lacking_in_session(folder: Path) -> str | None:
    """What a session still lacks; broken ones lack nothing, their job tells what is broken."""
    try:
        data = read_bytes(folder / "shots.jsonl")
    except FileError:
        return "there is no shots.jsonl yet"
    last = data.rsplit(b"\n", 1)[-1]
    if last.strip() and _parsed(last) is None:
        return "its last line is half written: a run was killed in this shot (`spherecal capture --resume`)"
    if not (folder / "plan.yaml").exists():
        return None
    try:
        from acquire.plan import load_plan

        planned = [pose.id for pose in load_plan(folder / "plan.yaml").poses]
    except SpherecalError:
        return None
    lines = [_parsed(line) for line in data.split(b"\n") if line.strip()]
    taken = {str(line.get("pose_id")) for line in lines if line is not None}
    n_open = sum(pose not in taken for pose in planned)
    return f"{n_open} of the {len(planned)} poses of its plan have no shot yet" if n_open else None


def _lacking_in_scans(folder: Path) -> str | None:
    from acquire.import_clouds import find_clouds, match_clouds
    from drivers.files.poses import read_poses

    path = pose_file(folder)
    if path is None:
        return "there is no list of poses"
    try:
        labels = read_poses(path).labels
    except SpherecalError:
        return None
    try:
        clouds = match_clouds(labels, find_clouds(cloud_folder(folder)), file=path, allow_missing=True).clouds
    except SpherecalError as error:
        # more clouds than can be told apart is for the job to say, none or too few may still come
        return f"its clouds and poses do not belong together yet ({error.message})"
    n_open = clouds.count(None)
    return f"{n_open} of its {len(clouds)} poses have no cloud yet" if n_open else None


def _parsed(line: bytes) -> dict[str, object] | None:
    try:
        value = json.loads(line)
    except ValueError:
        return None
    return value if isinstance(value, dict) else None


def _raise(error: OSError) -> None:
    raise error
