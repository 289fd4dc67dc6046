"""What a result says of the trust in it: the calibration's own verdict, its last quick check, what the history doubts."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from drivers.errors import SpherecalError

if TYPE_CHECKING:
    from calibrate.result import Calibration
    from drivers.files.session import Session


@dataclass(frozen=True, slots=True)
class LastCheck:
    """The last quick check of a calibration, as the history tells it."""

    taken_utc: str
    verdict: str
    """conform, not_proven or reject."""


@dataclass(frozen=True, slots=True)
class Trust:
    """What speaks for and against a result before its points are looked at."""

    last_check: LastCheck | None
    """None where there is no history, or no check of this calibration in it."""
    marks: tuple[str, ...]

    def last_check_data(self) -> dict[str, object] | None:
        """For JSON."""
        return None if self.last_check is None else asdict(self.last_check)


def trust_in(history: str | None, calibration: Calibration, session: Session) -> Trust:
    """Ask the history of the cell about a calibration at the time of a session.

    A history that cannot be read marks the result and does not stop the work.

    Args:
        history: its place (`measure.history.recording.place_of`), or None.
        calibration: that the session is measured with.
        session: of the part.
    """
    own = [] if calibration.verdict != "fail" else ["the calibration's own verdict is fail"]
    if history is None:
        return Trust(None, tuple(own))
    from measure.history.marks import marks_in
    from measure.history.recording import last_taken_utc
    from measure.history.store import History, now_utc

    try:
        with History.open(history) as opened:
            checks = [row for row in opened.results(calibration.cell_name, "check") if row.calibration == calibration.id]
            doubts = marks_in(opened, calibration, last_taken_utc([session]) or now_utc())
    except SpherecalError as error:
        return Trust(None, (*own, f"the history could not be read: {error}"))
    last = max(checks, key=lambda row: row.taken_utc, default=None)
    return Trust(None if last is None else LastCheck(last.taken_utc, last.verdict), (*own, *doubts))
