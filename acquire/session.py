"""Writing a session: append-only, every shot on disk before the next begins, safe against kill -9 at any moment.

Order of a shot: scan (temporary file, fsync, rename, fsync of the folder), then its line in shots.jsonl (fsync). So a
line never names a scan that is not whole, and a killed run loses at most the shot in hand.
"""

from __future__ import annotations

import datetime
import json
import logging
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from io import FileIO
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquire.cell import Cell, robot_model_of
from acquire.identity import check_resumed
from acquire.session_folder import check_free, check_same_cell, make_folder, open_locked, repair
from drivers.errors import FileError, SettingsError
from drivers.files.checks import as_mapping
from drivers.files.disk import sha256_hex, write_atomic
from drivers.files.ply import encode_ply
from drivers.files.session import PURPOSES, SESSION_FORMAT, read_head
from drivers.files.shots import ScanFile, Shot, check_order, parse_shot, read_shots
from drivers.files.yaml import dump_yaml

_LOG = logging.getLogger(__name__)


class SessionWriter:
    """The one writer of one session; use `create` or `resume`, and `close` (or a with block) at the end."""

    def __init__(self, folder: Path, stream: FileIO, shots: Sequence[Shot], repaired: str | None) -> None:
        self.folder = folder
        self.repaired = repaired
        """What `resume` had to repair, for the user; None where nothing was."""
        self._stream = stream
        self._shots = list(shots)

    @classmethod
    def create(
        cls,
        folder: str | Path,
        *,
        purpose: str,
        cell: Cell,
        plan_text: str | None = None,
        robot_model_text: str | None = None,
        identity: Mapping[str, object] | None = None,
    ) -> Self:
        """Begin a session in a new or empty folder; where that fails, nothing is left behind.

        Args:
            folder: the session's folder.
            purpose: calibration, verification or workpiece.
            cell: copied verbatim.
            plan_text: text of the plan, copied verbatim.
            robot_model_text: text of the robot model; the cell's model if None.
            identity: serial numbers and the like; the cell's if None.

        Raises:
            SettingsError: the purpose is not known.
            FileError: the folder is not empty or cannot be written, or the cell's robot model is missing or broken.
        """
        target = Path(folder)
        if purpose not in PURPOSES:
            raise SettingsError(f"the purpose {purpose!r} is not known", remedy=f"Choose one of {', '.join(PURPOSES)}.")
        check_free(target)
        if robot_model_text is None and (model := robot_model_of(cell)) is not None:
            robot_model_text = model.text
        head = {
            "format": SESSION_FORMAT,
            "purpose": purpose,
            "cell": "cell.yaml",
            "created_utc": _now_utc(),
            "software": _software(),
            **({"identity": dict(identity or cell.identity)} if identity or cell.identity else {}),
        }
        files = {"cell.yaml": cell.data, "session.yaml": dump_yaml(head).encode(), "shots.jsonl": b""}
        files |= {name: text.encode() for name, text in (("plan.yaml", plan_text), ("robot_model.yaml", robot_model_text)) if text is not None}
        make_folder(target, files)
        try:
            return cls(target, open_locked(target / "shots.jsonl"), [], None)
        except BaseException:
            shutil.rmtree(target, ignore_errors=True)
            raise

    @classmethod
    def resume(cls, folder: str | Path, *, cell: Cell | None = None, told: Mapping[str, str] = MappingProxyType({})) -> Self:
        """Go on with a session; a last line that a killed run left half-written is taken out and told in `repaired`.

        Args:
            folder: the session's folder.
            cell: the cell of the run; it must say the same as the session's copy.
            told: what robot and camera tell of themselves (`Devices.identity`).

        Raises:
            SettingsError: the cell or its robot model is another than the session's, or robot or camera are.
            FileError: the session is broken beyond its last line, or another process writes to it.
        """
        target = Path(folder)
        identity = read_head(target).get("identity") or {}
        if cell is not None:
            check_same_cell(target, cell)
        check_resumed(as_mapping(identity, file=str(target / "session.yaml"), where="identity"), told, file=target / "session.yaml")
        stream = open_locked(target / "shots.jsonl")
        try:
            (target / "scans").mkdir(exist_ok=True)
            repaired = repair(target, stream)
            shots = read_shots(target)
        except BaseException:
            stream.close()
            raise
        if repaired:
            _LOG.warning("%s", repaired)
        return cls(target, stream, shots, repaired)

    @property
    def shots(self) -> tuple[Shot, ...]:
        """All shots so far, of every status, replaced ones included."""
        return tuple(self._shots)

    @property
    def next_index(self) -> int:
        """The index of the next shot."""
        return self._shots[-1].index + 1 if self._shots else 0

    def append(
        self,
        *,
        sphere: str | None = None,
        joints_rad: ArrayLike | None = None,
        base_from_flange: ArrayLike | None = None,
        xyz_mm: NDArray[np.floating] | None = None,
        intensity: NDArray[np.floating] | None = None,
        frames_xyz_mm: Sequence[NDArray[np.floating]] = (),
        same_scan_as: int | None = None,
        status: str = "ok",
        reason: str | None = None,
        pose_id: str | None = None,
        replaces: int | None = None,
        target_joints_rad: ArrayLike | None = None,
        stillness_rad: float | None = None,
        temperatures_c: Mapping[str, float] | None = None,
        approach: object = None,
        reference: str | None = None,
        target: str | None = None,
        point_in_reference_mm: ArrayLike | None = None,
        time_utc: str | None = None,
        extra: Mapping[str, object] | None = None,
    ) -> Shot:
        """Put one shot on disk; when this returns it survives a power cut.

        Args:
            sphere: the sphere in view, None for a workpiece.
            joints_rad: (n,) measured axis angles.
            base_from_flange: (4, 4) as the controller reports it.
            xyz_mm: (n, 3) or (height, width, 3) scan in the camera frame; None for a failed shot or an external point.
            intensity: (n,) or (height, width), written beside the points.
            frames_xyz_mm: single exposures, where `xyz_mm` is their mean.
            same_scan_as: index of the earlier shot whose scan this is (two spheres in one view), instead of `xyz_mm`.
            status: ok, failed or skipped.
            reason: why not ok.
            pose_id: the pose of the plan.
            replaces: index of the earlier shot that this one is taken instead of.
            target_joints_rad: (n,) where the robot was sent.
            stillness_rad: the largest axis movement seen while settling.
            temperatures_c: by sensor name.
            approach: from which side each axis came.
            reference: frame of an external reference.
            target: point on the flange that the reference sees.
            point_in_reference_mm: (3,) that point.
            time_utc: ISO 8601; now if None.
            extra: further keys for the line.

        Raises:
            FileError: a value that the reader would refuse (nothing is written then), or the disk is full.
        """
        index = self.next_index
        scans = self._encode(index, xyz_mm, intensity, frames_xyz_mm)
        first = ScanFile(*scans[0][:2]) if xyz_mm is not None else self._scan_of(same_scan_as)
        frames = scans[1:] if xyz_mm is not None else scans
        values: dict[str, object] = {
            "index": index,
            "sphere": sphere,
            "joints_rad": _listed(joints_rad),
            "base_from_flange": _listed(base_from_flange),
            "scan": None if first is None else first.scan,
            "sha256": None if first is None else first.sha256,
            "time_utc": time_utc or _now_utc(),
            "status": status,
        }
        optional: dict[str, object] = {
            "reason": reason,
            "pose_id": pose_id,
            "replaces": replaces,
            "frames": [{"scan": name, "sha256": digest} for name, digest, _ in frames] or None,
            "target_joints_rad": _listed(target_joints_rad),
            "stillness_rad": None if stillness_rad is None else float(stillness_rad),
            "temperatures_c": {name: float(value) for name, value in (temperatures_c or {}).items()} or None,
            "approach": _listed(approach) if isinstance(approach, np.ndarray) else approach,
            "reference": reference,
            "target": target,
            "point_in_reference_mm": _listed(point_in_reference_mm),
        }
        values |= {key: value for key, value in optional.items() if value is not None}
        return self._commit({**(extra or {}), **values}, [(name, data) for name, _, data in scans])

    def close(self) -> None:
        """Let go of the session; safe to call twice."""
        self._stream.close()

    def __enter__(self) -> Self:
        """The writer itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close."""
        self.close()

    def _encode(
        self, index: int, xyz_mm: NDArray[np.floating] | None, intensity: NDArray[np.floating] | None, frames: Sequence[NDArray[np.floating]]
    ) -> list[tuple[str, str, bytes]]:
        """Name, digest and bytes of every scan of a shot."""
        scans = [] if xyz_mm is None else [(f"scans/{index:04d}.ply", _scan_bytes(xyz_mm, intensity))]
        scans += [(f"scans/{index:04d}_{i}.ply", _scan_bytes(frame, None)) for i, frame in enumerate(frames)]
        return [(name, sha256_hex(data), data) for name, data in scans]

    def _scan_of(self, index: int | None) -> ScanFile | None:
        if index is None:
            return None
        for shot in self._shots:
            if shot.index == index and shot.scan is not None and shot.sha256 is not None:
                return ScanFile(shot.scan, shot.sha256)
        msg = f"there is no earlier shot {index} with a scan"
        raise ValueError(msg)

    def _commit(self, values: Mapping[str, object], scans: Sequence[tuple[str, bytes]]) -> Shot:
        path = self.folder / "shots.jsonl"
        line = json.dumps(values)
        number = self._shots[-1].line + 1 if self._shots else 1
        shot = replace(parse_shot(line, folder=None, file=path, where=f"line {number}"), line=number)
        check_order([*self._shots, shot], path, number)
        for name, data in scans:
            write_atomic(self.folder / name, data)
        self._write_line(line, path)
        self._shots.append(shot)
        return shot

    def _write_line(self, line: str, path: Path) -> None:
        size = self._stream.seek(0, os.SEEK_END)
        data = line.encode() + b"\n"
        try:
            if self._stream.write(data) != len(data):
                raise OSError(28, "No space left on device")
            os.fsync(self._stream.fileno())
        except OSError as error:
            with suppress(OSError):
                self._stream.truncate(size)
            raise FileError(f"cannot be written ({error.strerror})", file=path, remedy="Make room on the disk and continue with --resume.") from error


def _scan_bytes(xyz_mm: NDArray[np.floating], intensity: NDArray[np.floating] | None) -> bytes:
    properties = None if intensity is None else {"intensity": np.asarray(intensity, dtype=np.float32)}
    return encode_ply(xyz_mm, properties=properties, comments=("unit mm", "frame camera"))


def _listed(values: ArrayLike | None) -> object:
    return None if values is None else np.asarray(values, dtype=np.float64).tolist()


def _now_utc() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _software() -> str:
    try:
        return f"spherecal {version('spherecal')}"
    except PackageNotFoundError:
        return "spherecal"
