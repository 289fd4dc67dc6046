"""What a result says of the trust in it: the calibration, and its last quick check."""

from __future__ import annotations

from collections.abc import Callable

from measure.jobs.model import LastCheck

Checks = Callable[[str], LastCheck | None]
"""The last quick check of a calibration by its id; None where the history has none."""


def no_history(_calibration_id: str) -> LastCheck | None:
    """Knows of no quick check."""
    return None


def trust_marks(calibration_verdict: str, last_check: LastCheck | None) -> tuple[str, ...]:
    """What speaks against a result before a part is looked at."""
    marks = [] if calibration_verdict != "fail" else ["the calibration's own verdict is fail"]
    if last_check is not None and last_check.verdict == "reject":
        marks.append(f"the last quick check failed ({last_check.time_utc})")
    elif last_check is not None and last_check.overdue:
        marks.append(f"the quick check is overdue: the last was {last_check.time_utc}")
    return tuple(marks)
