"""A plan that somebody has driven step by step before."""

from __future__ import annotations

from pathlib import Path

from acquire.cell import load_cell
from acquire.plan import load_plan
from measure.running_record import RunRecord, append_run, motion_digest, now_utc, runs_path


def mark_driven(cell: Path, *plans: Path) -> None:
    """Put the first runs of plans on a cell's record."""
    loaded = load_cell(cell)
    for path in plans:
        plan = load_plan(path)
        driven = tuple(pose.id for pose in plan.poses)
        append_run(runs_path(loaded), RunRecord(now_utc(), motion_digest(plan), loaded.sha256, "-", True, 0.1, driven, "done"))
