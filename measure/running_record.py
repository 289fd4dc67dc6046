"""Which plans a robot has driven in a cell, attended and step by step: a file beside the cell, a line a run.

A plan's first run on a cell goes step by step at reduced speed. Only when every pose of it was reached in that way may the
plan run without anybody being asked. Any change of the cell file or of the plan's poses makes it a new plan: what was
seen to be clear before says nothing about it.
"""

from __future__ import annotations

import datetime
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from acquire.cell import Cell
from acquire.plan import Plan
from drivers.errors import FileError

RUN_FORMAT = "spherecal-run/1"


@dataclass(frozen=True, slots=True)
class RunRecord:
    """One run of a real robot."""

    time_utc: str
    plan_sha256: str
    """`motion_digest`."""
    cell_sha256: str
    session: str
    stepped: bool
    """Whether somebody let it go to every single pose."""
    speed_rad_s: float
    driven: tuple[str, ...]
    """Poses that were reached."""
    state: str
    """How it ended: done, aborted or failed."""


def runs_path(cell: Cell) -> Path:
    """`cell.yaml` has its runs in `cell.runs.jsonl`."""
    return cell.path.with_suffix(".runs.jsonl")


def motion_digest(plan: Plan) -> str:
    """Of everything in a plan that moves the robot: the poses, their order and the ways between them."""
    way = [[pose.id, pose.joints_rad.tolist(), [via.tolist() for via in pose.via_rad]] for pose in plan.poses]
    return hashlib.sha256(json.dumps(way).encode()).hexdigest()


def read_runs(path: Path) -> tuple[RunRecord, ...]:
    """The runs of a cell; a line that cannot be read proves nothing and is left out.

    Raises:
        FileError: the file is there and cannot be read.
    """
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
    except OSError as error:
        raise FileError(f"cannot be read ({error.strerror})", file=path, remedy="Check its permissions.") from error
    return tuple(record for record in map(_parsed, lines) if record is not None)


def append_run(path: Path, record: RunRecord) -> None:
    """Add a line.

    Raises:
        FileError: it cannot be written.
    """
    try:
        with path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"format": RUN_FORMAT} | asdict(record)) + "\n")
    except OSError as error:
        remedy = "The folder of the cell file must be writable: the runs of its robot are recorded there."
        raise FileError(f"cannot be written ({error.strerror})", file=path, remedy=remedy) from error


def never_driven(cell: Cell, plan: Plan, runs: Iterable[RunRecord], most_speed_rad_s: float) -> tuple[str, ...]:
    """Poses of a plan that nobody has let the robot go to, step by step and no faster than so much, in this very cell."""
    digest = motion_digest(plan)
    counted = [r for r in runs if r.stepped and r.speed_rad_s <= most_speed_rad_s and (r.plan_sha256, r.cell_sha256) == (digest, cell.sha256)]
    driven = {name for run in counted for name in run.driven}
    return tuple(pose.id for pose in plan.poses if pose.id not in driven)


def now_utc() -> str:
    """ISO 8601."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def _parsed(line: str) -> RunRecord | None:
    try:
        data = json.loads(line)
        if not isinstance(data, Mapping) or data.get("format") != RUN_FORMAT:
            return None
        return RunRecord(
            time_utc=str(data["time_utc"]),
            plan_sha256=str(data["plan_sha256"]),
            cell_sha256=str(data["cell_sha256"]),
            session=str(data["session"]),
            stepped=data["stepped"] is True,
            speed_rad_s=float(data["speed_rad_s"]),
            driven=tuple(str(name) for name in data["driven"]),
            state=str(data["state"]),
        )
    except (ValueError, KeyError, TypeError):
        return None
