"""The lines of a session's shots.jsonl, read strictly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from drivers.errors import FileError
from drivers.files.checks import Record, as_mapping, parse_json_object
from drivers.files.disk import decode_text, read_bytes
from drivers.kinematics.se3 import FloatArray

STATUSES = ("ok", "failed", "skipped")


@dataclass(frozen=True, slots=True)
class ScanFile:
    """A scan and its digest."""

    scan: str
    sha256: str


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One line of shots.jsonl."""

    index: int
    sphere: str | None = None
    joints_rad: FloatArray | None = None
    """(n,) as measured."""
    base_from_flange: FloatArray | None = None
    """(4, 4) as the controller reports it; rounding up to 1e-4 is taken out of the rotation."""
    scan: str | None = None
    """Path inside the session's folder."""
    sha256: str | None = None
    time_utc: str | None = None
    status: str = "ok"
    """ok, failed or skipped: `reason` says why."""
    reason: str | None = None
    pose_id: str | None = None
    replaces: int | None = None
    frames: tuple[ScanFile, ...] = ()
    """Single exposures, where the scan is their mean."""
    target_joints_rad: FloatArray | None = None
    stillness_rad: float | None = None
    temperatures_c: Mapping[str, float] = field(default_factory=dict)
    approach: object = None
    reference: str | None = None
    """Name of the frame of an external reference (a laser tracker)."""
    target: str | None = None
    """Name of the point on the flange that the reference sees."""
    point_in_reference_mm: FloatArray | None = None
    """(3,)"""
    extra: Mapping[str, object] = field(default_factory=dict)
    """Keys of the line that spherecal does not know."""
    line: int = 0
    """The line of shots.jsonl that this shot stands in, from 1; 0 for a shot that is not on disk."""

    @property
    def is_reference_point(self) -> bool:
        """Whether this is an external reference point and no scan."""
        return self.point_in_reference_mm is not None


def read_shots(folder: Path) -> tuple[Shot, ...]:
    """The checked lines of shots.jsonl.

    Raises:
        FileError: as `read_session`.
    """
    path = folder / "shots.jsonl"
    lines = read_bytes(path).split(b"\n")
    shots: list[Shot] = []
    for number, line in enumerate(lines, start=1):
        if line.strip():
            shots.append(_shot_of_line(line, path, number, is_last=number == len(lines)))
            check_order(shots, path, number)
    return tuple(shots)


def parse_shot(text: str, *, folder: Path | None, file: Path, where: str) -> Shot:
    """One shot from its JSON text; its scans must exist in the folder, where one is given.

    Raises:
        FileError: as `read_session`.
    """
    record = Record(parse_json_object(text, file=file, where=where), str(file), where)
    index = record.whole("index")
    if index is None:
        record.fail("index", "is missing", "Number the shots 0, 1, 2, ...")
    scan, sha256 = _scan_file(record, folder)
    shot = Shot(
        index=index,
        sphere=record.text("sphere"),
        joints_rad=record.vector("joints_rad"),
        base_from_flange=record.transform("base_from_flange"),
        scan=scan,
        sha256=sha256,
        time_utc=record.time_utc("time_utc"),
        status=record.choice("status", STATUSES) or "ok",
        reason=record.text("reason"),
        pose_id=_identifier(record, "pose_id"),
        replaces=record.whole("replaces"),
        frames=_frames(record, folder),
        target_joints_rad=record.vector("target_joints_rad"),
        stillness_rad=record.number("stillness_rad"),
        temperatures_c=_temperatures(record),
        approach=record.get("approach"),
        reference=record.text("reference"),
        target=record.text("target"),
        point_in_reference_mm=record.vector("point_in_reference_mm", 3),
        extra=record.rest,
    )
    _check_whole(shot, record)
    return shot


def _shot_of_line(line: bytes, path: Path, number: int, *, is_last: bool) -> Shot:
    try:
        shot = parse_shot(decode_text(line, file=path), folder=path.parent, file=path, where=f"line {number}")
        return replace(shot, line=number)
    except FileError as error:
        if is_last and "JSON" in error.message:
            error = FileError(
                "the last line is cut off: the run was killed in this shot",
                file=path,
                where=f"line {number}",
                remedy="Continue the run with `spherecal capture --resume`, or delete the line.",
            )
        elif "UTF-8" in error.message:
            error = FileError(error.message, file=path, where=f"line {number}", remedy=error.remedy)
        raise error from None


def check_order(shots: Sequence[Shot], path: Path, number: int) -> None:
    """Check the last shot against those before: rising indices, `replaces` that exist, one number of axes.

    Raises:
        FileError: with the line number.
    """
    shot, before = shots[-1], shots[:-1]
    record = Record({}, str(path), f"line {number}")
    if before and shot.index <= before[-1].index:
        problem = "is used twice" if any(shot.index == other.index for other in before) else f"falls after {before[-1].index}"
        record.fail("index", f"{shot.index} {problem}", "Indices must be unique and rise from line to line.")
    if shot.replaces is not None and all(other.index != shot.replaces for other in before):
        record.fail("replaces", f"there is no earlier shot {shot.replaces}", "Name the index of an earlier shot.")
    first = next((len(other.joints_rad) for other in shots if other.joints_rad is not None), None)
    for key, joints in (("joints_rad", shot.joints_rad), ("target_joints_rad", shot.target_joints_rad)):
        if joints is not None and first is not None and len(joints) != first:
            record.fail(key, f"{len(joints)} axes, the session's other values have {first}", "Every shot must give all axes of the robot.")


def _check_whole(shot: Shot, record: Record) -> None:
    parts = (shot.reference, shot.target, shot.point_in_reference_mm)
    if any(part is not None for part in parts) and any(part is None for part in parts):
        record.fail("reference", "an external point needs reference, target and point_in_reference_mm together", "Give all three, or none.")
    if shot.reference is not None and shot.scan is not None:
        record.fail("reference", "a shot is a scan or an external point, not both", "Write two lines.")
    if shot.reference is not None and shot.status == "ok" and shot.joints_rad is None:
        record.fail("joints_rad", "an external point needs the axis angles", 'Give "joints_rad", or set "status" to "failed".')
    if shot.scan is not None and shot.status == "ok" and shot.joints_rad is None and shot.base_from_flange is None:
        record.fail("joints_rad", "neither axis angles nor a flange pose", 'Give "joints_rad" or "base_from_flange", or set "status" to "failed".')


def _scan_file(record: Record, folder: Path | None) -> tuple[str | None, str | None]:
    scan, sha256 = record.relative_path("scan"), record.digest("sha256")
    if scan is None:
        return None, sha256
    if sha256 is None:
        record.fail("sha256", f"the digest of {scan} is missing", "Write what `sha256sum` prints for the scan.")
    if folder is not None and not (folder / scan).is_file():
        record.fail("scan", f"{scan} is missing", "Restore the file, or set the line's scan to null and its status to failed.")
    return scan, sha256


def _frames(record: Record, folder: Path | None) -> tuple[ScanFile, ...]:
    value = record.get("frames")
    if value is None:
        return ()
    if not isinstance(value, list):
        record.fail("frames", "is no list", 'Write [{"scan": ..., "sha256": ...}, ...].')
    result = []
    for i, item in enumerate(value):
        where = f"{record.where}, frames[{i}]"
        inner = Record(as_mapping(item, file=record.file, where=where), record.file, where)
        scan, sha256 = _scan_file(inner, folder)
        if scan is None or sha256 is None:
            inner.fail("scan", "is missing", 'Write {"scan": ..., "sha256": ...}.')
        result.append(ScanFile(scan, sha256))
    return tuple(result)


def _temperatures(record: Record) -> dict[str, float]:
    value = record.get("temperatures_c")
    if value is None:
        return {}
    where = f"{record.where}, temperatures_c"
    inner = Record(as_mapping(value, file=record.file, where=where), record.file, where)
    return {key: number for key in inner.values if (number := inner.number(key)) is not None}


def _identifier(record: Record, key: str) -> str | None:
    value = record.get(key)
    return str(record.whole(key)) if isinstance(value, int) else record.text(key)
