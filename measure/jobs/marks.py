"""What a result says of the trust in it: the part's camera and robot, the calibration, its last quick check."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from drivers.errors import DataError
from drivers.files.session import Session
from measure.jobs.model import LastCheck

Checks = Callable[[str], LastCheck | None]
"""The last quick check of a calibration by its id; None where the history has none."""

_REFUSED = ("camera_serial", "robot_serial", "camera_settings", "camera_correction")
"""Another one of these and the calibration measures something else; other differences mark the result."""


def no_history(_calibration_id: str) -> LastCheck | None:
    """Knows of no quick check."""
    return None


def identity_marks(session: Session, identity: Mapping[str, object]) -> tuple[str, ...]:
    """Compare what a session was recorded with and what the calibration was made with.

    Args:
        session: of the part.
        identity: of the calibration.

    Returns:
        Differences that do not forbid to measure, in words.

    Raises:
        DataError: another camera or robot, or a camera that was set differently.
    """
    marks = []
    for key in sorted(set(session.identity) & set(identity)):
        found, expected = str(session.identity[key]), str(identity[key])
        if found == expected:
            continue
        if key in _REFUSED:
            raise DataError(
                f"recorded with {key} {found}, the calibration is of {expected}",
                file=session.folder / "session.yaml",
                where=f"identity.{key}",
                remedy="Use the calibration of that device, or calibrate anew.",
            )
        marks.append(f"{key} was {found}, the calibration was made with {expected}")
    return tuple(marks)


def trust_marks(calibration_verdict: str, last_check: LastCheck | None) -> tuple[str, ...]:
    """What speaks against a result before a part is looked at."""
    marks = [] if calibration_verdict != "fail" else ["the calibration's own verdict is fail"]
    if last_check is not None and last_check.verdict == "reject":
        marks.append(f"the last quick check failed ({last_check.time_utc})")
    elif last_check is not None and last_check.overdue:
        marks.append(f"the quick check is overdue: the last was {last_check.time_utc}")
    return tuple(marks)
