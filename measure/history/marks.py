"""Reasons to doubt a measurement that the history of its cell knows: failed and overdue checks, another calibration in use."""

from __future__ import annotations

import datetime
from typing import TYPE_CHECKING

from drivers.errors import SpherecalError

if TYPE_CHECKING:
    from calibrate import Calibration
    from measure.history.rows import ResultRow
    from measure.history.store import History

_DECIDES = ("conform", "reject")


def marks_of(place: str | None, calibration: Calibration, taken_utc: str | None = None) -> list[str]:
    """What is to be said beside a measurement, in sentences; nothing where there is no history.

    Args:
        place: of the history, or None.
        calibration: that the measurement was made with.
        taken_utc: when its last shot was taken; now if None.
    """
    if place is None:
        return []
    from measure.history.store import History, now_utc

    try:
        with History.open(place) as history:
            return marks_in(history, calibration, taken_utc or now_utc())
    except SpherecalError as error:
        return [f"the history could not be read: {error}"]


def marks_in(history: History, calibration: Calibration, taken_utc: str) -> list[str]:
    """The same of an open history."""
    cell, found = calibration.cell_name, []
    used = [row for row in history.activations(cell) if moment(row.at_utc) <= moment(taken_utc)]
    if used and used[-1].calibration != calibration.id:
        found.append(f"the cell has used calibration {used[-1].calibration[:12]} since {used[-1].at_utc[:16]}Z, this one is {calibration.id[:12]}")
    checks = [row for row in history.results(cell, "check") if row.calibration == calibration.id and row.verdict in _DECIDES]
    before = [row for row in checks if moment(row.taken_utc) <= moment(taken_utc)]
    after = [row for row in checks if moment(row.taken_utc) > moment(taken_utc)]
    if before and before[-1].verdict == "reject":
        found.append(f"the last quick check before it failed ({_what(before[-1])})")
    if after and after[0].verdict == "reject":
        found.append(f"the first quick check after it failed ({_what(after[0])})")
    found += _overdue(history, calibration, before, taken_utc)
    verifications = [row for row in history.results(cell, "verification") if row.calibration == calibration.id]
    if verifications and verifications[-1].verdict == "reject":
        found.append(f"the last verification of the calibration was rejected ({verifications[-1].taken_utc[:16]}Z)")
    return found


def moment(utc: str) -> datetime.datetime:
    """A time of a file; without an offset it is taken as UTC."""
    try:
        found = datetime.datetime.fromisoformat(utc.replace("Z", "+00:00"))
    except ValueError:
        return datetime.datetime.min.replace(tzinfo=datetime.UTC)
    return found if found.tzinfo else found.replace(tzinfo=datetime.UTC)


def _overdue(history: History, calibration: Calibration, before: list[ResultRow], taken_utc: str) -> list[str]:
    every_h = history.check_every_h(calibration.cell_name)
    if every_h is None:
        return []
    good = [row.taken_utc for row in before if row.verdict == "conform"]
    last, what = (good[-1], "last passed quick check") if good else (calibration.created_utc, "calibration, never checked since,")
    hours = (moment(taken_utc) - moment(last)).total_seconds() / 3600
    return [f"the quick check is overdue: the {what} is {hours:.0f} h old, every {every_h:g} h is the rule"] if hours > every_h else []


def _what(row: ResultRow) -> str:
    return f"{row.taken_utc[:16]}Z, {row.changed or 'something changed'}"
