"""What an inspection found, as plain values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from drivers.kinematics.se3 import FloatArray
from measure.decision import GUARD_FACTOR, Verdict
from measure.inspecting.coverage import Coverage

RESULT_FORMAT = "spherecal-inspection-result/1"


@dataclass(frozen=True, slots=True)
class Value:
    """One figure of a feature."""

    name: str
    unit: str
    """mm or deg."""
    nominal: float | None
    measured: float
    expanded_uncertainty: float
    """k = 2."""

    def to_json_dict(self) -> dict[str, object]:
        """Keys carry the unit."""
        unit = self.unit
        return {
            f"nominal_{unit}": self.nominal,
            f"measured_{unit}": self.measured,
            f"deviation_{unit}": None if self.nominal is None else self.measured - self.nominal,
            f"expanded_uncertainty_{unit}": self.expanded_uncertainty,
        }


@dataclass(frozen=True, slots=True)
class FeatureResult:
    """One feature, or why there is none."""

    name: str
    kind: str
    problem: str | None = None
    n_points: int = 0
    n_rejected: int = 0
    rms_mm: float = float("nan")
    form_mm: float = float("nan")
    form_expanded_uncertainty_mm: float = float("nan")
    values: tuple[Value, ...] = ()
    coverage: Coverage | None = None
    """Of a round feature."""

    def to_json_dict(self) -> dict[str, object]:
        """What `--json` holds of it."""
        return {
            "kind": self.kind,
            "problem": self.problem,
            "n_points": self.n_points,
            "n_rejected": self.n_rejected,
            "rms_mm": self.rms_mm,
            "form_mm": self.form_mm,
            "form_expanded_uncertainty_mm": self.form_expanded_uncertainty_mm,
            "circumference_seen_deg": None if self.coverage is None else self.coverage.seen_deg,
            "circumference_largest_gap_deg": None if self.coverage is None else self.coverage.largest_gap_deg,
            "values": {value.name: value.to_json_dict() for value in self.values},
        }


@dataclass(frozen=True, slots=True)
class Corrected:
    """A value brought to a reference gauge by a correlation; never shown without the raw one."""

    value_mm: float
    expanded_uncertainty_mm: float
    """The offset's own part in it."""
    offset_mm: float
    offset_expanded_uncertainty_mm: float
    slope_is_one: bool

    def to_json_dict(self) -> dict[str, object]:
        """What `--json` holds of it."""
        return {
            "value_mm": self.value_mm,
            "expanded_uncertainty_mm": self.expanded_uncertainty_mm,
            "offset_mm": self.offset_mm,
            "offset_expanded_uncertainty_mm": self.offset_expanded_uncertainty_mm,
            "slope_is_one": self.slope_is_one,
        }


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One tolerance judged."""

    name: str
    kind: str
    features: tuple[str, ...]
    unit: str
    nominal: float
    lower: float
    """Least allowed value."""
    upper: float
    """Greatest allowed value."""
    measured: float | None
    """None where it could not be measured."""
    expanded_uncertainty: float
    verdict: Verdict
    problem: str | None = None
    doubt: str | None = None
    """Why it is not judged though there is a value."""
    corrected: Corrected | None = None
    judged_corrected: bool = False
    """Whether the verdict is of the corrected value."""

    @property
    def judged(self) -> tuple[float, float]:
        """The value that the verdict is of, and its U; NaN where there is none."""
        if self.judged_corrected and self.corrected is not None:
            return self.corrected.value_mm, self.corrected.expanded_uncertainty_mm
        return float("nan") if self.measured is None else self.measured, self.expanded_uncertainty

    @property
    def share(self) -> float:
        """How much of the tolerance is used up: 1 at its limit."""
        if self.measured is None:
            return float("nan")
        middle, half = (self.lower + self.upper) / 2, (self.upper - self.lower) / 2
        value = self.judged[0]
        return value / self.upper if self.kind in ZONES else abs(value - middle) / half

    @property
    def reason(self) -> str:
        """In one line: the figure, its limits, and what follows."""
        if self.measured is None:
            return f"{self.name}: not measured ({self.problem})"
        unit = self.unit
        limits = f"at most {self.upper:.3f} {unit}" if self.kind in ZONES else f"allowed {self.lower:.3f} to {self.upper:.3f} {unit}"
        value, width = self.judged
        corrected = f" corrected from {self.measured:.3f}" if self.judged_corrected else ""
        figures = f"{self.name}: {value:.3f} {unit}{corrected} (U {width:.3f}), {limits}"
        if self.doubt is not None:
            return f"{figures}, not judged: {self.doubt}"
        guard = GUARD_FACTOR * width / 2
        if self.verdict == "conform":
            return f"{figures}, kept"
        return f"{figures}, {'missed by more than' if self.verdict == 'reject' else 'within'} the guard band of {guard:.3f} {unit}"

    def to_json_dict(self) -> dict[str, object]:
        """What `--json` holds of it."""
        return {
            "name": self.name,
            "kind": self.kind,
            "features": list(self.features),
            "unit": self.unit,
            "nominal": self.nominal,
            "lower": self.lower,
            "upper": self.upper,
            "measured": self.measured,
            "expanded_uncertainty": self.expanded_uncertainty,
            "verdict": self.verdict,
            "problem": self.problem,
            "doubt": self.doubt,
            "corrected": None if self.corrected is None else self.corrected.to_json_dict(),
            "judged": "corrected" if self.judged_corrected else "measured",
        }


ZONES = ("flatness", "form", "position", "profile")
"""Checks whose value is zero at best."""


@dataclass(frozen=True, slots=True, eq=False)
class DeviationMap:
    """Signed distances of the points from the nominal mesh."""

    points_in_part_mm: FloatArray
    """(n, 3) of those that belong to the part."""
    points_in_base_mm: FloatArray
    """(n, 3) the same as they were measured."""
    signed_mm: FloatArray
    """(n,) positive: material too much."""
    n_left_out: int
    """Farther away than the limit, or nearest to the rim of a hole in the mesh."""
    limit_mm: float
    facing: FloatArray
    """(3,) unit: mean normal of the surface that was seen, frame of the part."""

    def statistics(self) -> dict[str, float]:
        """Over all points."""
        d = self.signed_mm
        low, high = np.quantile(d, [0.01, 0.99])
        return {
            "mean_mm": float(d.mean()),
            "rms_mm": float(np.sqrt(np.mean(d**2))),
            "std_mm": float(d.std()),
            "median_mm": float(np.median(d)),
            "q01_mm": float(low),
            "q99_mm": float(high),
            "min_mm": float(d.min()),
            "max_mm": float(d.max()),
        }


@dataclass(frozen=True, slots=True, eq=False)
class AlignmentResult:
    """Where the part lies."""

    method: str
    part_from_base: FloatArray
    """(4, 4) frame of the nominal from the frame of the cloud."""
    rms_mm: float | None = None
    expanded_uncertainty_mm: FloatArray | None = None
    """(3,) of a best fit's shift at the middle of the part, k = 2."""
    expanded_uncertainty_rad: FloatArray | None = None
    """(3,) of its turn."""

    def to_json_dict(self) -> dict[str, object]:
        """What `--json` holds of it."""
        return {
            "method": self.method,
            "part_from_base": self.part_from_base,
            "rms_mm": self.rms_mm,
            "expanded_uncertainty_mm": self.expanded_uncertainty_mm,
            "expanded_uncertainty_rad": self.expanded_uncertainty_rad,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Inspection:
    """The whole result."""

    name: str
    verdict: Verdict
    reasons: tuple[str, ...]
    alignment: AlignmentResult
    features: tuple[FeatureResult, ...]
    checks: tuple[CheckResult, ...]
    n_points: int
    calibration_id: str | None
    field_words: str
    """Where the uncertainty comes from."""
    inputs: Mapping[str, object]
    notes: tuple[str, ...]
    seconds_to_verdict: float
    deviations: DeviationMap | None = None
    feature_points_in_part_mm: Mapping[str, FloatArray] = field(default_factory=dict)

    def to_json_dict(self) -> dict[str, object]:
        """What `spherecal inspect --json` prints."""
        deviations = self.deviations
        return {
            "format": RESULT_FORMAT,
            "name": self.name,
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "n_points": self.n_points,
            "alignment": self.alignment.to_json_dict(),
            "features": {feature.name: feature.to_json_dict() for feature in self.features},
            "checks": [check.to_json_dict() for check in self.checks],
            "deviations": None
            if deviations is None
            else {"n_points": len(deviations.signed_mm), "n_left_out": deviations.n_left_out, **deviations.statistics()},
            "calibration": self.calibration_id,
            "uncertainty_from": self.field_words,
            "inputs": dict(self.inputs),
            "notes": list(self.notes),
            "seconds_to_verdict": self.seconds_to_verdict,
        }
