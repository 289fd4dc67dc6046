"""Sessions on disk, read strictly and never written: DESIGN section 3.

    session/  session.yaml  cell.yaml  [plan.yaml]  [robot_model.yaml]  shots.jsonl  scans/0000.ply ...

The cell itself is read by `acquire.cell`; whether the spheres and axes of the shots fit it is checked there.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.errors import FileError
from drivers.files.checks import Record, as_mapping
from drivers.files.disk import decode_text, read_bytes, sha256_hex
from drivers.files.ply import PointCloud, parse_ply
from drivers.files.shots import ScanFile, Shot, read_shots
from drivers.files.yaml import parse_yaml

__all__ = ["ScanFile", "Session", "Shot", "read_head", "read_scan", "read_session", "session_digest"]

SESSION_FORMAT = "spherecal-session/1"
PURPOSES = ("calibration", "verification", "workpiece")
_SESSION_KEYS = ("format", "purpose", "cell", "created_utc", "software", "identity")


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A session as it lies on disk."""

    folder: Path
    purpose: str
    created_utc: str
    software: str
    identity: Mapping[str, object]
    shots: tuple[Shot, ...]
    """In order of index, of every status, without those that a later shot replaces."""
    all_shots: tuple[Shot, ...]
    """Every line of shots.jsonl."""
    digest: str
    """sha256 over session.yaml, shots.jsonl (which holds the digests of the scans) and the copies beside them."""
    cell_path: Path
    robot_model_path: Path | None = None
    plan_path: Path | None = None

    @property
    def n_joints(self) -> int | None:
        """Number of axes in the shots, None where no shot has any."""
        return next((len(shot.joints_rad) for shot in self.all_shots if shot.joints_rad is not None), None)


def read_session(folder: str | Path) -> Session:
    """Read a session, strictly; scans are only looked for (`read_scan` reads one and checks its digest).

    A session without shots is valid: a run that was stopped before its first shot.

    Raises:
        FileError: a file is missing or broken, a key is unknown, wrong or inconsistent; with file, line, key and remedy.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileError("no such folder" if not folder.exists() else "is a file, not a session folder", file=folder, remedy="Name a session folder.")
    head = read_head(folder)
    cell_path = folder / str(head.relative_path("cell"))
    shots = read_shots(folder)
    replaced = {shot.replaces for shot in shots}
    return Session(
        folder=folder,
        purpose=str(head.choice("purpose", PURPOSES)),
        created_utc=str(head.time_utc("created_utc")),
        software=str(head.text("software")),
        identity=as_mapping(head.get("identity") or {}, file=head.file, where="identity"),
        shots=tuple(shot for shot in shots if shot.index not in replaced),
        all_shots=shots,
        digest=session_digest(folder, cell_path),
        cell_path=cell_path,
        robot_model_path=_optional(folder / "robot_model.yaml"),
        plan_path=_optional(folder / "plan.yaml"),
    )


def read_head(folder: Path) -> Record:
    """The checked contents of session.yaml.

    Raises:
        FileError: as `read_session`.
    """
    path = folder / "session.yaml"
    if not path.exists():
        raise FileError("no session.yaml in this folder", file=folder, remedy="Name a session folder, as `spherecal capture` writes it.")
    head = Record(as_mapping(parse_yaml(decode_text(read_bytes(path), file=path), file=path), file=path, where="top level"), str(path), "top level")
    if head.choice("format", (SESSION_FORMAT,)) is None:
        head.fail("format", "is missing", f"Write `format: {SESSION_FORMAT}`.")
    if unknown := [key for key in head.values if key not in _SESSION_KEYS]:
        head.fail(unknown[0], "unknown key", f"Allowed: {', '.join(_SESSION_KEYS)}.")
    for key in ("purpose", "cell", "created_utc", "software"):
        if head.values.get(key) is None:
            head.fail(key, "is missing", f"Needed: {', '.join(_SESSION_KEYS[:5])}.")
    return head


def read_scan(session: Session, shot: Shot) -> PointCloud:
    """The cloud of a shot, its digest checked.

    Raises:
        FileError: the shot has no scan, or its file is missing, cut off, broken or changed since the capture.
    """
    if shot.scan is None or shot.sha256 is None:
        raise FileError("the shot has no scan", file=session.folder / "shots.jsonl", where=f"line {shot.line}", remedy="Leave this shot out.")
    path = session.folder / shot.scan
    with_place = f"shot {shot.index}"
    try:
        data = np.memmap(path, dtype=np.uint8, mode="r").data if path.stat().st_size else memoryview(b"")
    except (OSError, ValueError) as error:
        raise FileError(f"the scan of {with_place} cannot be read ({error})", file=path, remedy=_SCAN_REMEDY) from error
    found = hashlib.sha256(data).hexdigest()
    cloud = parse_ply(data, file=path)
    if found != shot.sha256:
        raise FileError(
            f"the scan of {with_place} has the sha256 {found[:12]}... and not {shot.sha256[:12]}... as recorded", file=path, remedy=_SCAN_REMEDY
        )
    return cloud


_SCAN_REMEDY = 'It was changed after the capture: restore it, or set the "status" of its shot in shots.jsonl to "failed".'


def _optional(path: Path) -> Path | None:
    return path if path.exists() else None


def session_digest(folder: Path, cell_path: Path) -> str:
    """What `Session.digest` says, from the bytes alone; FileError where one of the files is missing."""
    files = {"session.yaml": folder / "session.yaml", "cell.yaml": cell_path, "shots.jsonl": folder / "shots.jsonl"}
    files |= {name: folder / name for name in ("plan.yaml", "robot_model.yaml") if (folder / name).exists()}
    return sha256_hex("".join(f"{name} {sha256_hex(read_bytes(path))}\n" for name, path in sorted(files.items())).encode())
