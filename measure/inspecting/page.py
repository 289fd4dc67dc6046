"""One HTML page of an inspection, whole in itself: verdict, tolerances, features, colour map, where it comes from."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np

from drivers.kinematics.se3 import FloatArray
from measure.decision import GUARD_FACTOR
from measure.inspecting.picture import colour_map_svg, colour_scale_mm, histogram_svg
from measure.inspecting.result import ZONES, CheckResult, DeviationMap, FeatureResult, Inspection, Value
from measure.report_page import Picture

HEADLINES = {
    "conform": ("Conforms", "Every tolerance is kept by more than the uncertainty of its measurement.", "good"),
    "not_proven": ("Not proven", "Nothing is proven wrong, and not everything is proven right.", "unsure"),
    "reject": ("Reject", "At least one tolerance is missed by more than the uncertainty of its measurement.", "bad"),
}
_TONES = {"conform": "good", "not_proven": "unsure", "reject": "bad"}
_WORDS = {"conform": "keeps", "not_proven": "not proven", "reject": "misses"}
_ALIGNED = {
    "none": "as measured, in the robot base",
    "datums": "by datum features",
    "best_fit": "by best fit of all points to the nominal: its place is free, so positions say nothing of where the part stands",
}


@dataclass(frozen=True, slots=True)
class CheckRow:
    """One tolerance."""

    name: str
    measured: str
    uncertainty: str
    nominal: str
    allowed: str
    used: str
    """Share of the tolerance."""
    mark: str
    tone: str
    corrected: str = ""
    """By a correlation, with its U."""
    note: str = ""


@dataclass(frozen=True, slots=True)
class FeatureRow:
    """One feature with its figures."""

    name: str
    kind: str
    points: str
    form: str
    values: tuple[tuple[str, str, str, str, str], ...]
    """Name, measured, nominal, deviation, U."""
    problem: str
    seen: str = ""
    """How much of its circumference."""


@dataclass(frozen=True, slots=True)
class InspectionPage:
    """All that the template puts on the page."""

    title: str
    headline: str
    sentence: str
    tone: str
    reasons: tuple[str, ...]
    remarks: tuple[str, ...]
    checks: tuple[CheckRow, ...]
    has_corrected: bool
    features: tuple[FeatureRow, ...]
    statistics: tuple[tuple[str, str], ...]
    pictures: tuple[Picture, ...]
    identity: tuple[tuple[str, str], ...]
    decision_rule: str
    created_utc: str
    software: str


def page_of(inspection: Inspection, moment: datetime.datetime) -> InspectionPage:
    """Texts and pictures of an inspection."""
    headline, sentence, tone = HEADLINES[inspection.verdict]
    return InspectionPage(
        title=f"Inspection: {inspection.name}",
        headline=headline,
        sentence=sentence,
        tone=tone,
        reasons=inspection.reasons,
        remarks=inspection.notes,
        checks=tuple(_check_row(check) for check in inspection.checks),
        has_corrected=any(check.corrected is not None for check in inspection.checks),
        features=tuple(_feature_row(feature) for feature in inspection.features),
        statistics=_statistics(inspection),
        pictures=_pictures(inspection),
        identity=_identity(inspection),
        decision_rule=f"A tolerance is kept, or missed, where the value keeps or misses its limit by more than {GUARD_FACTOR} u, u = U / 2; "
        "in between nothing is proven.",
        created_utc=moment.strftime("%Y-%m-%d %H:%M UTC"),
        software=f"spherecal {version('spherecal')}",
    )


def render(page: InspectionPage) -> str:
    """The HTML text; every text on it is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(loader=PackageLoader("measure"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.get_template("inspect.html.j2").render(page=page)


def _check_row(check: CheckResult) -> CheckRow:
    allowed = f"at most {check.upper:.3f}" if check.kind in ZONES else f"{check.lower:.3f} to {check.upper:.3f}"
    nominal = "" if check.kind in ZONES else f"{check.nominal:.3f}"
    unit = "°" if check.unit == "deg" else " mm"
    if check.measured is None:
        return CheckRow(check.name, "-", "", nominal, f"{allowed}{unit}", "", "not measured", "unsure")
    return CheckRow(
        check.name,
        f"{check.measured:.3f}",
        f"{check.expanded_uncertainty:.3f}",
        nominal,
        f"{allowed}{unit}",
        f"{100 * check.share:.0f} %",
        _WORDS[check.verdict],
        _TONES[check.verdict],
        "" if check.corrected is None else f"{check.corrected.value_mm:.3f} (U {check.corrected.expanded_uncertainty_mm:.3f})",
        "judged by the corrected value" if check.judged_corrected else check.doubt or "",
    )


def _feature_row(feature: FeatureResult) -> FeatureRow:
    if feature.problem is not None:
        return FeatureRow(feature.name, feature.kind, "", "", (), feature.problem)
    seen = "" if feature.coverage is None else f"{feature.coverage.seen_deg:.0f}°"
    form = f"{feature.form_mm:.3f} (U {feature.form_expanded_uncertainty_mm:.3f})"
    return FeatureRow(feature.name, feature.kind, str(feature.n_points), form, tuple(_value_row(value) for value in feature.values), "", seen)


def _value_row(value: Value) -> tuple[str, str, str, str, str]:
    unit = "°" if value.unit == "deg" else ""
    if value.nominal is None:
        return value.name, f"{value.measured:.3f}{unit}", "", "", f"{value.expanded_uncertainty:.3f}{unit}"
    off = value.measured - value.nominal
    return value.name, f"{value.measured:.3f}{unit}", f"{value.nominal:.3f}{unit}", f"{off:+.3f}{unit}", f"{value.expanded_uncertainty:.3f}{unit}"


def _statistics(inspection: Inspection) -> tuple[tuple[str, str], ...]:
    deviations = inspection.deviations
    if deviations is None:
        return ()
    s = deviations.statistics()
    return (
        ("points compared", f"{len(deviations.signed_mm)} ({deviations.n_left_out} left out: no part of it, or at the rim of a hole in the mesh)"),
        ("mean", f"{s['mean_mm']:+.3f} mm"),
        ("rms", f"{s['rms_mm']:.3f} mm"),
        ("98 % of the points lie between", f"{s['q01_mm']:+.3f} and {s['q99_mm']:+.3f} mm"),
        ("smallest and largest", f"{s['min_mm']:+.3f} and {s['max_mm']:+.3f} mm"),
    )


def _pictures(inspection: Inspection) -> tuple[Picture, ...]:
    deviations = inspection.deviations
    if deviations is None:
        return ()
    profile = next((check.upper for check in inspection.checks if check.kind == "profile"), None)
    scale_mm = colour_scale_mm(deviations, profile)
    marks = _marks({name: points.mean(axis=0) for name, points in inspection.feature_points_in_part_mm.items() if len(points)}, deviations)
    what = "the tolerance of the profile" if profile is not None else "a round figure that 2 % of the points exceed"
    caption = f"Signed distance of every point from the nominal mesh. The strongest colours are ±{scale_mm:g} mm, {what}."
    return (
        Picture("Deviations", caption, colour_map_svg(deviations, scale_mm, marks), wide=True),
        Picture("Distribution", "One bar per step of deviation, in the colours of the map.", histogram_svg(deviations, scale_mm)),
    )


def _marks(places: Mapping[str, FloatArray], deviations: DeviationMap) -> dict[str, FloatArray]:
    """Places of features; one line by one where they stand in each other's way."""
    size = float(np.ptp(deviations.points_in_part_mm, axis=0).max())
    found: dict[str, FloatArray] = {}
    for name, place in places.items():
        flat = place - (place @ deviations.facing) * deviations.facing
        near = next((other for other, there in found.items() if np.linalg.norm(flat - there) < 0.06 * size), None)
        if near is None:
            found[name] = flat
        else:
            found[f"{near}\n{name}"] = found.pop(near)
    return found


def _identity(inspection: Inspection) -> tuple[tuple[str, str], ...]:
    alignment = inspection.alignment
    rows = [(name, str(value)) for name, value in inspection.inputs.items() if value is not None]
    rows.append(("calibration", inspection.calibration_id or "not named by the cloud"))
    rows.append(("uncertainty from", inspection.field_words))
    rows.append(("aligned", _ALIGNED[alignment.method]))
    if alignment.rms_mm is not None:
        rows.append(("rms of the best fit", f"{alignment.rms_mm:.3f} mm"))
    if alignment.expanded_uncertainty_mm is not None and alignment.expanded_uncertainty_rad is not None:
        shift, turn = np.linalg.norm(alignment.expanded_uncertainty_mm), np.degrees(np.linalg.norm(alignment.expanded_uncertainty_rad))
        rows.append(("U of the best fit", f"{shift:.3f} mm and {turn:.4f}°"))
    return tuple(rows)
