"""A check against an earlier check at the same poses: what has changed between the two, whatever the calibration leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrate.drift_causes import Diagnosis, causes_of, diagnose, named
from calibrate.drift_pairs import Together, two_causes
from calibrate.observations import SphereShot
from calibrate.quick_check import changes_since, known_state
from calibrate.result import Calibration
from drivers.errors import DataError

_MANY = float(np.log(1000.0))
LEAST_MATCHED = 5
"""Shots of both checks from one pose: fewer tell no causes apart."""


@dataclass(frozen=True, slots=True, eq=False)
class SinceEarlier:
    """What has changed since an earlier check."""

    earlier: str
    """Name of its session."""
    n_matched: int
    """Shots of the same sphere from the same pose in both."""
    rms_mm: float
    """Distance between the two checks' centres, root mean square."""
    expected_rms_mm: float
    """What it is on average where nothing changed."""
    diagnosis: Diagnosis
    named: tuple[str, ...]
    together: Together | None

    @property
    def reason(self) -> str:
        """In a sentence."""
        off = f"{self.rms_mm:.3f} mm rms apart, {self.expected_rms_mm:.3f} mm expected, at {self.n_matched} poses that both hold"
        if not self.diagnosis.changed:
            return f"since the check {self.earlier}: no change that these shots could show ({off})"
        return f"changed since the check {self.earlier}: {told_causes(self.named, self.together)} ({off})"

    def to_json_dict(self) -> dict[str, object]:
        """For `--json`."""
        return {
            "earlier": self.earlier,
            "n_matched": self.n_matched,
            "rms_mm": self.rms_mm,
            "expected_rms_mm": self.expected_rms_mm,
            "changed": self.diagnosis.changed,
            "named": list(self.named),
            "p_value": self.diagnosis.p_value,
            "together": together_json(self.together),
        }


def since_earlier(calibration: Calibration, name: str, earlier: Sequence[SphereShot], shots: Sequence[SphereShot]) -> SinceEarlier:
    """Compare a check's shots with those of an earlier one of this name.

    Raises:
        DataError: too few shots of both are of one sphere from one pose.
    """
    residuals = changes_since(calibration, earlier, shots)
    n_matched = 0 if residuals is None else residuals.n_shots
    if residuals is None or n_matched < LEAST_MATCHED:
        raise DataError(
            f"{n_matched} of {len(shots)} shots repeat a pose of the earlier check {name}; {LEAST_MATCHED} are needed",
            remedy="Drive the plan of the earlier check again.",
        )
    causes = causes_of(residuals, known_state(calibration, residuals.problem.n_scans), tuple(calibration.sphere_centres_in_base_mm))
    diagnosis = diagnose(residuals, causes)
    told = named(diagnosis, 0 if calibration.model is None else calibration.model.n_joints)
    return SinceEarlier(name, n_matched, residuals.rms_mm, residuals.expected_rms_mm, diagnosis, told, two_causes(residuals, causes, diagnosis))


def told_causes(names: Sequence[str], together: Together | None) -> str:
    """What has changed, in words: one cause, several that cannot be told apart, or two at once."""
    if together is not None:
        pairs = " or ".join(" together with ".join(pair.causes) for pair in together.pairs)
        odds = f"{np.exp(together.log_odds):.0f}" if together.log_odds < _MANY else "thousands of"
        return f"more than one thing, likeliest {pairs}: two causes explain these shots {odds} times better than one"
    what = " or ".join(names)
    return f"{what} (these shots cannot tell which)" if len(names) > 1 else what


def together_json(together: Together | None) -> dict[str, object] | None:
    """For `--json`; null where one cause explains what changed well enough."""
    if together is None:
        return None
    return {"log_odds": together.log_odds, "pairs": [{"causes": list(p.causes), "probability": p.probability} for p in together.pairs]}
