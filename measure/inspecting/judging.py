"""Judging an inspection: figures of features, tolerances one by one, the verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.decision import Verdict, judge
from measure.gauge.correlation import Correlation
from measure.inspecting.features import shape_of
from measure.inspecting.geometry import nominal_element
from measure.inspecting.quantities import Measured, Model, own_quantities, quantity_of_check
from measure.inspecting.result import ZONES, CheckResult, Corrected, DeviationMap, FeatureResult, Value
from measure.inspecting.spec import InspectionSpec, PairCheck, PlaneFeature, ProfileCheck, SizeCheck, ZoneCheck
from measure.inspecting.uncertainty import FieldError, JointCovariance, UnknownField


@dataclass(frozen=True, slots=True, eq=False)
class Judging:
    """What checks are judged with."""

    model: Model
    covariance: JointCovariance
    forms: Mapping[str, tuple[float, float]]
    """Form and its standard uncertainty, mm."""
    problems: Mapping[str, str]
    """Features that could not be measured, and why."""
    deviations: DeviationMap | None
    point_sigma_mm: float
    correlation: Correlation | None = None
    judge_corrected: bool = False

    def seen_too_little(self, name: str) -> str | None:
        """Why nothing is judged by a feature; None where enough of it was seen."""
        feature = self.model.features[name]
        coverage = self.model.fits[name].coverage if name in self.model.fits else None
        if coverage is None or isinstance(feature, PlaneFeature) or coverage.arc_deg >= feature.least_seen_deg:
            return None
        return f"{name} is seen over {coverage.arc_deg:.0f} degrees of its circumference, least_seen_deg asks for {feature.least_seen_deg:g}"


def feature_result(name: str, judging: Judging) -> FeatureResult:
    """What is told of one feature."""
    feature = judging.model.features[name]
    if name in judging.problems:
        return FeatureResult(name, feature.kind, judging.problems[name])
    fit = judging.model.fits[name]
    drawn = judging.model.nominal([name])
    values = []
    for quantity in own_quantities(name, drawn[name]):
        found = judging.model.measure(quantity, judging.covariance)
        values.append(Value(quantity.name, quantity.unit, quantity.value(drawn), found.value, 2 * found.standard_uncertainty))
    form_mm, sigma_mm = judging.forms[name]
    return FeatureResult(name, feature.kind, None, len(fit.rows), fit.n_rejected, fit.rms_mm, form_mm, 2 * sigma_mm, tuple(values), fit.coverage)


def check_result(number: int, spec: InspectionSpec, judging: Judging) -> CheckResult:
    """One tolerance of the spec, judged."""
    check = spec.checks[number]
    features = _features_of(check)
    shapes = {name: shape_of(spec.features[name]) for name in features}
    drawn = {name: nominal_element(spec.features[name], shape) for name, shape in shapes.items()}
    name = check.name or " ".join([check.kind.replace("_", " "), *(f"{a}" for a in ([" - ".join(features)] if features else []))])
    unit, nominal = "mm", 0.0
    quantity = None
    if isinstance(check, SizeCheck | PairCheck) or (isinstance(check, ZoneCheck) and check.kind == "position"):
        quantity = quantity_of_check(check, drawn)
        unit = quantity.unit
    if quantity is not None and isinstance(check, SizeCheck | PairCheck):
        nominal = quantity.value(drawn) if check.nominal is None else check.nominal
    lower, upper = _limits(check, nominal)
    result = CheckResult(name, check.kind, features, unit, nominal, lower, upper, None, float("nan"), "not_proven")
    missing = [feature for feature in features if feature in judging.problems]
    if missing:
        return replace(result, problem=f"{missing[0]}: {judging.problems[missing[0]]}")
    if quantity is not None:
        found = judging.model.measure(quantity, judging.covariance)
    elif isinstance(check, ProfileCheck):
        found = _profile(check, judging)
    else:
        found = Measured(*judging.forms[features[0]])
    doubts = [doubt for doubt in map(judging.seen_too_little, features) if doubt is not None]
    return _judged(_corrected(result, found, judging), found, doubts[0] if doubts else None)


def _corrected(result: CheckResult, found: Measured, judging: Judging) -> CheckResult:
    """With what the correlation makes of a value, where it names the check."""
    offset = judging.correlation.offsets.get(result.name) if judging.correlation is not None else None
    if offset is None or result.unit != "mm":
        return result
    value = found.value + offset.offset_mm
    width = float(np.hypot(2 * found.standard_uncertainty, offset.expanded_uncertainty_mm))
    corrected = Corrected(
        max(value, 0.0) if result.kind in ZONES else value, width, offset.offset_mm, offset.expanded_uncertainty_mm, offset.slope_is_one
    )
    return replace(result, corrected=corrected, judged_corrected=judging.judge_corrected)


def _features_of(check: SizeCheck | ZoneCheck | PairCheck | ProfileCheck) -> tuple[str, ...]:
    if isinstance(check, PairCheck):
        return check.between
    return () if isinstance(check, ProfileCheck) else (check.feature,)


def _limits(check: SizeCheck | ZoneCheck | PairCheck | ProfileCheck, nominal: float) -> tuple[float, float]:
    if isinstance(check, ZoneCheck | ProfileCheck):
        return 0.0, check.tolerance or 0.0
    if check.tolerance is not None:
        return nominal - check.tolerance, nominal + check.tolerance
    return nominal + (check.lower or 0.0), nominal + (check.upper or 0.0)


def _profile(check: ProfileCheck, judging: Judging) -> Measured:
    deviations = judging.deviations
    if deviations is None:  # made before whenever a check asks for it
        raise ValueError(check.kind)
    return Measured(float(np.quantile(np.abs(deviations.signed_mm), check.quantile)), judging.point_sigma_mm)


def _judged(result: CheckResult, found: Measured, doubt: str | None) -> CheckResult:
    result = replace(result, measured=found.value, expanded_uncertainty=2 * found.standard_uncertainty, doubt=doubt)
    if doubt is not None:
        return result
    value, width = result.judged
    zone = result.lower == 0.0 and result.kind in ZONES
    middle = 0.0 if zone else (result.lower + result.upper) / 2
    half = result.upper if zone else (result.upper - result.lower) / 2
    return replace(result, verdict=judge(result.name, value - middle, half, width / 2).verdict)


def verdict_of(checks: Sequence[CheckResult], spec: InspectionSpec, field: FieldError, judging: Judging) -> tuple[Verdict, tuple[str, ...]]:
    """As `measure.decision.overall`, on checks with units of their own."""
    gaps = [] if checks else ["no tolerances given"]
    gaps += [
        f"{name} could not be measured: {text}" for name, text in judging.problems.items() if not any(name in check.features for check in checks)
    ]
    if isinstance(field, UnknownField) and checks:
        gaps.append(f"{field.words}: name the calibration and the session, or state point_expanded_uncertainty_mm")
    gaps += [f"datum {doubt}" for doubt in map(judging.seen_too_little, judging.model.datums) if doubt is not None]
    reasons = [check.reason for check in checks if check.verdict != "conform"]
    if any(check.verdict == "reject" for check in checks):
        return "reject", (*reasons, *gaps)
    if reasons or gaps:
        return "not_proven", (*reasons, *gaps)
    tightest = max(checks, key=lambda check: check.share)
    return "conform", (f"all {len(checks)} tolerances of {spec.name} are kept; the tightest is {tightest.reason}",)
