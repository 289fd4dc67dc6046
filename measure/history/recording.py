"""When commands keep what they did, and where: a rule that surprises nobody (docs/history.md).

Kept is in the history that `--history` names (made where it is not there), else in that of the variable SPHERECAL_HISTORY, else in
`history.sqlite` beside the cell or calibration file, if there is one. Otherwise nothing is kept; `--history none` says so
by force. A history that cannot be written spoils no result: it is told, and `history.recorded` of the JSON is false.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.errors import SpherecalError
from measure.history.database import ENVIRONMENT, FILE_NAME, exists

if TYPE_CHECKING:
    from calibrate import Calibration
    from drivers.files.session import Session
    from measure.history.rows import ResultKind
    from measure.history.store import History

NONE = "none"


def place_of(option: str | None, beside: Path) -> str | None:
    """Where the history of a command is, or None where it has none.

    Args:
        option: what `--history` says.
        beside: the cell or calibration file that the command was given.
    """
    if option is not None:
        return None if option.lower() == NONE else option
    if os.environ.get(ENVIRONMENT):
        return os.environ[ENVIRONMENT]
    found = default_place(beside)
    return found if exists(found) else None


def default_place(beside: Path) -> str:
    """The history beside a file."""
    return str(beside.absolute().parent / FILE_NAME)


def record_calibration(place: str | None, calibration: Calibration, file: Path, tell: Callable[[str], None]) -> Mapping[str, object] | None:
    """Keep a calibration; what the JSON says of it under `history`."""
    return _kept(place, lambda history: history.add_calibration(calibration, file), tell)


def record_result(
    place: str | None,
    kind: ResultKind,
    calibration: Calibration,
    file: Path,
    content: Mapping[str, object],
    tell: Callable[[str], None],
    *,
    taken_utc: str | None = None,
) -> Mapping[str, object] | None:
    """Keep what a command printed, and the calibration that it was made with; what the JSON says of it under `history`."""

    def keep(history: History) -> None:
        history.add_calibration(calibration, file)
        verdict = str(content.get("verdict", ""))
        history.add_result(kind, calibration, content, verdict=verdict, taken_utc=taken_utc, software=software())

    return _kept(place, keep, tell)


def last_taken_utc(sessions: Sequence[Session]) -> str | None:
    """When the last shot of some sessions was taken; None where none tells."""
    times = [shot.time_utc for session in sessions for shot in session.shots if shot.time_utc is not None]
    return max(times) if times else None


def software() -> str:
    """Name and version of this program."""
    with suppress(PackageNotFoundError):
        return f"spherecal {version('spherecal')}"
    return "spherecal"


def _kept(place: str | None, keep: Callable[[History], None], tell: Callable[[str], None]) -> Mapping[str, object] | None:
    if place is None:
        return None
    from measure.history.store import History

    try:
        with History.open(place) as history:
            keep(history)
            tell(f"kept in the history {history.name}")
            return {"place": history.name, "recorded": True, "problem": None}
    except SpherecalError as error:
        tell(f"warning: not kept in the history: {error}")
        return {"place": None, "recorded": False, "problem": str(error)}
