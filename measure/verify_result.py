"""What `verify` found: data only, and the object that `--json` prints."""

from __future__ import annotations

from dataclasses import dataclass, field

from acquire.cell import Limits
from calibrate.observations import Observations, RejectedShot
from measure.decision import GUARD_FACTOR, RULE, Judgement, Verdict
from measure.sphere_figures import Figures, SphereFigures

SHAPED_ON = "shaped on the sphere tests of VDI/VDE 2634 (probing error, sphere spacing error); no conformity is claimed"


@dataclass(frozen=True, slots=True)
class LengthResult:
    """One certified length, measured between centres fitted on all views of each sphere together."""

    between: tuple[str, str]
    measured_mm: float
    reference_mm: float
    expanded_uncertainty_mm: float
    """Of the measured value, k = 2: calibration, scatter between the views, reference."""
    test_standard_uncertainty_mm: float
    """Reference and scatter alone: what the decision is charged with."""
    not_judged: str | None = None
    """Why this length says nothing about the system; None where it does."""

    @property
    def error_mm(self) -> float:
        """Measured minus reference."""
        return self.measured_mm - self.reference_mm

    @property
    def label(self) -> str:
        """For people."""
        return "-".join(self.between)

    def to_json_dict(self) -> dict[str, object]:
        """As in DESIGN 4, and whether it was judged."""
        return {
            "between": list(self.between),
            "measured_mm": self.measured_mm,
            "reference_mm": self.reference_mm,
            "error_mm": self.error_mm,
            "expanded_uncertainty_mm": self.expanded_uncertainty_mm,
            "not_judged": self.not_judged,
        }


@dataclass(frozen=True, slots=True)
class SessionName:
    """A session as results name it."""

    name: str
    digest: str


@dataclass(frozen=True, slots=True, eq=False)
class VerifyResult:
    """A verification on shots that the calibration never saw."""

    calibration_id: str
    sessions: tuple[SessionName, ...]
    observations: Observations = field(repr=False)
    figures: Figures
    """Of the calibrated system."""
    before: Figures | None
    """Of the nominal robot with the first guess of the hand-eye; None where the cell gives no guess."""
    lengths: tuple[LengthResult, ...]
    before_length_errors_mm: dict[str, float]
    """By the label of the length."""
    limits: Limits | None
    judgements: tuple[Judgement, ...]
    verdict: Verdict
    reasons: tuple[str, ...]
    held_out: bool
    """False where training data were allowed: then the figures flatter."""
    seconds: float

    @property
    def n_shots(self) -> int:
        """Used and rejected."""
        return self.observations.n_shots

    @property
    def used(self) -> int:
        """Shots that the figures stand on."""
        return len(self.observations.shots)

    @property
    def rejected(self) -> tuple[RejectedShot, ...]:
        """Shots without a findable sphere."""
        return self.observations.rejected

    def session_name(self, digest: str) -> str:
        """Folder name of a session."""
        return next((s.name for s in self.sessions if s.digest == digest), digest[:12])

    def to_json_dict(self) -> dict[str, object]:
        """The object that `--json` prints (DESIGN 4), with further keys."""
        return {
            "n_shots": self.n_shots,
            "used": self.used,
            "rejected": [{"session": self.session_name(r.session), "index": r.index, "reason": r.reason} for r in self.rejected],
            "centre_rms_mm": self.figures.centre_rms_mm,
            "centre_max_mm": self.figures.centre_max_mm,
            "radial_rms_mm": self.figures.radial_rms_mm,
            "lengths": [length.to_json_dict() for length in self.lengths],
            "spheres": {name: _sphere_json(sphere) for name, sphere in self.figures.spheres.items()},
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "before": None if self.before is None else _before_json(self.before, self.before_length_errors_mm),
            "limits": None if self.limits is None else self.limits.model_dump(mode="json"),
            "judgements": [_judgement_json(j) for j in self.judgements],
            "decision_rule": RULE,
            "procedure": SHAPED_ON,
            "held_out": self.held_out,
            "calibration": self.calibration_id,
            "sessions": [{"name": s.name, "digest": s.digest} for s in self.sessions],
            "seconds": self.seconds,
        }


def _sphere_json(sphere: SphereFigures) -> dict[str, object]:
    return {
        "diameter_error_mm": sphere.diameter_error_mm,
        "diameter_error_less_offset_mm": sphere.diameter_error_less_offset_mm,
        "form_mm": sphere.form_mm,
        "form_all_mm": sphere.form_all_mm,
        "centre_in_base_mm": sphere.centre_in_base_mm.tolist(),
        "n_views": sphere.n_views,
        "n_points": sphere.n_points,
    }


def _before_json(figures: Figures, length_errors_mm: dict[str, float]) -> dict[str, object]:
    return {
        "centre_rms_mm": figures.centre_rms_mm,
        "centre_max_mm": figures.centre_max_mm,
        "radial_rms_mm": figures.radial_rms_mm,
        "length_errors_mm": length_errors_mm,
        "spheres": {name: {"diameter_error_mm": s.diameter_error_mm, "form_mm": s.form_mm} for name, s in figures.spheres.items()},
    }


def _judgement_json(judgement: Judgement) -> dict[str, object]:
    return {
        "quantity": judgement.quantity,
        "value_mm": judgement.value_mm,
        "limit_mm": judgement.limit_mm,
        "guard_mm": GUARD_FACTOR * judgement.standard_uncertainty_mm,
        "verdict": judgement.verdict,
    }
