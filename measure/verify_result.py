"""What `verify` found: data only, and the object that `--json` prints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from acquire.cell import Limits
from calibrate.observations import Observations, RejectedShot
from measure.decision import GUARD_FACTOR, Judgement, Verdict, rule_of
from measure.proof.external import ExternalFigures
from measure.proof.judging import SphereUncertainty
from measure.proof.lengths import LengthResult
from measure.proof.probing import Probing, ProbingResult
from measure.proof.reach import OutsideShot
from measure.proof.residual_maps import ResidualMaps
from measure.proof.volume import VolumeFigures
from measure.sphere_figures import Figures, SphereFigures, ViewFigures

SHAPED_ON = "shaped on VDI/VDE 2634-3 and ISO 10360-13 (probing error, sphere spacing error); no conformity to either is claimed"
TRAINING_REMARK = "TRAINING DATA USED (--allow-training-data): this proves nothing"
"""Printed on every page of a verification that took shots or poses of the calibration itself."""


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
    probing: tuple[ProbingResult, ...] = ()
    """Form and size: every sphere over all its views, then every view; empty for line profiles."""
    volume: VolumeFigures | None = None
    """All judged lengths together; None without any."""
    outside: tuple[OutsideShot, ...] = ()
    """Shots beyond the camera volume or axis ranges that the calibration saw."""
    warnings: tuple[str, ...] = ()
    """What a reader must know of these figures besides the verdict's reasons."""
    external: ExternalFigures | None = None
    """External reference points, told beside the spheres; judged by the lengths between them where no sphere was seen."""
    sphere_uncertainties: Mapping[str, SphereUncertainty] = field(default_factory=dict)
    """Of diameter and form, by the sphere's name; empty where only the views' own figures are wanted."""
    conditions: tuple[tuple[str, str], ...] = ()
    """When and how warm it was, and the certified values with their U, in words; empty for shots in memory."""
    maps: ResidualMaps | None = field(default=None, repr=False)
    """What the report draws of the points."""

    @property
    def slides(self) -> tuple[LengthResult, ...]:
        """Lengths along which one sphere was moved on a slide."""
        return tuple(length for length in self.lengths if length.is_slide)

    @property
    def n_shots(self) -> int:
        """Used and rejected."""
        return self.observations.n_shots

    @property
    def used(self) -> int:
        """Shots and external points that the figures stand on."""
        return len(self.observations.shots) + len(self.observations.external)

    @property
    def of_points_alone(self) -> bool:
        """Whether external reference points alone were judged: lengths are then between them."""
        return not self.figures.spheres

    @property
    def rejected(self) -> tuple[RejectedShot, ...]:
        """Shots without a findable sphere."""
        return self.observations.rejected

    @property
    def decision_rule(self) -> str:
        """In words."""
        return rule_of(None if self.limits is None else self.limits.guard)

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
            "spheres": {name: self._sphere_json(sphere) for name, sphere in self.figures.spheres.items()},
            "views": [_figures_json(self.session_name(view.session), view) for view in self.figures.views],
            "volume": None if self.volume is None else self.volume.to_json_dict(),
            "probing": [self._view_json(p) for p in self.probing if p.session is not None],
            "external": None if self.external is None else self.external.to_json_dict(self.session_name),
            "outside": [{"session": self.session_name(s.session), "index": s.index, "sphere": s.sphere, "what": list(s.what)} for s in self.outside],
            "warnings": list(self.warnings),
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "before": _before_json(self.before, self.before_length_errors_mm),
            "limits": None if self.limits is None else self.limits.model_dump(mode="json"),
            "judgements": [_judgement_json(j) for j in self.judgements],
            "decision_rule": self.decision_rule,
            "procedure": SHAPED_ON,
            "conditions": dict(self.conditions),
            "held_out": self.held_out,
            **({} if self.held_out else {"remark": TRAINING_REMARK}),
            "calibration": self.calibration_id,
            "sessions": [{"name": s.name, "digest": s.digest} for s in self.sessions],
            "seconds": self.seconds,
        }

    def _probing_of(self, sphere: str) -> Probing | None:
        return next((p.probing for p in self.probing if p.sphere == sphere and p.session is None), None)

    def _sphere_json(self, sphere: SphereFigures) -> dict[str, object]:
        u = self.sphere_uncertainties.get(sphere.name)
        return {
            **_sphere_json(sphere, self._probing_of(sphere.name)),
            "diameter_expanded_uncertainty_mm": None if u is None else u.diameter_expanded_mm,
            "form_expanded_uncertainty_mm": None if u is None else u.form_expanded_mm,
            "uncertainty": None if u is None else asdict(u),
        }

    def _view_json(self, view: ProbingResult) -> dict[str, object]:
        probing = None if view.probing is None else view.probing.to_json_dict()
        return {"session": self.session_name(str(view.session)), "index": view.index, "sphere": view.sphere, "probing": probing}


def _sphere_json(sphere: SphereFigures, probing: Probing | None) -> dict[str, object]:
    return {
        "diameter_error_mm": sphere.diameter_error_mm,
        "diameter_standard_uncertainty_mm": sphere.diameter_standard_uncertainty_mm,
        "form_standard_uncertainty_mm": sphere.form_standard_uncertainty_mm,
        "probing": None if probing is None else probing.to_json_dict(),
        "diameter_error_less_offset_mm": sphere.diameter_error_less_offset_mm,
        "form_mm": sphere.form_mm,
        "form_all_mm": sphere.form_all_mm,
        "centre_in_base_mm": sphere.centre_in_base_mm.tolist(),
        "n_views": sphere.n_views,
        "n_points": sphere.n_points,
    }


def _figures_json(session: str, view: ViewFigures) -> dict[str, object]:
    return {
        "session": session,
        "index": view.index,
        "sphere": view.sphere,
        "n_points": view.n_points,
        "radial_rms_mm": view.radial_rms_mm,
        "centre_in_base_mm": None if view.centre_in_base_mm is None else view.centre_in_base_mm.tolist(),
        "deviation_mm": view.deviation_mm,
    }


def _before_json(figures: Figures | None, length_errors_mm: dict[str, float]) -> dict[str, object] | None:
    if figures is None:
        return {"length_errors_mm": length_errors_mm} if length_errors_mm else None
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
