"""Which parameters a check may solve anew, and the new calibration (maths: `calibrate.few_parameters`)."""

from __future__ import annotations

import datetime

from calibrate.drift_causes import HAND_EYE, SPHERE
from calibrate.few_parameters import Resolved, resolve
from calibrate.result import Calibration
from drivers.errors import DataError
from measure.history.recording import software
from measure.quick.check import CheckResult


def resolved(parent: Calibration, result: CheckResult, cause: str | None) -> Resolved:
    """Solve what a check named, or the cause given, anew.

    Raises:
        DataError: nothing changed, several causes that only a person can tell apart, or one that few shots cannot settle.
    """
    names = [session.name for session in result.figures.sessions]
    chosen = cause or _the_cause(result)
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    return resolve(parent, result.sphere_shots, chosen, created_utc=now, software=software(), session_names=names)


def _the_cause(result: CheckResult) -> str:
    told = result.named
    if not told:
        raise DataError("nothing has changed that a check could show, so that there is nothing to solve anew", remedy="Keep the calibration.")
    if result.together is not None:
        likeliest = "' or --cause '".join(result.together.pairs[0].causes)
        message = "more than one thing has changed, and a check solves one at a time"
        raise DataError(message, remedy=f"Calibrate anew; or put one of them right, check again, or choose: --cause '{likeliest}'.")
    if len(told) == 1:
        return told[0]
    if HAND_EYE in told and SPHERE not in told and len(told) == 2 and told[0] != HAND_EYE and _is_last_axis(told, result):
        # the hand-eye holds a turn about the last axis
        return HAND_EYE
    choices = " or ".join(f"--cause '{name}'" for name in told)
    raise DataError(f"these shots cannot tell {' from '.join(told)}", remedy=f"Look at the cell, then say which it is: {choices}.")


def _is_last_axis(told: tuple[str, ...], result: CheckResult) -> bool:
    n = max((int(e.name.split()[1]) for e in result.diagnosis.explanations if e.name.startswith("axis ")), default=0)
    return f"axis {n}" in told
