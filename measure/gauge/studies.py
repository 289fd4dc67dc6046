"""What each study says: its figures as one JSON object, its table, and its page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from measure.gauge import page as pages
from measure.gauge.approach import drifts, reversals
from measure.gauge.correlation import Offset, correlate
from measure.gauge.page import StudyPage
from measure.gauge.repeatability import RepeatSettings, repeatability
from measure.gauge.reproducibility import reproducibility
from measure.gauge.table import Measured

_INFORMATIVE = "These figures are the gauge's on these parts and days; they are no proof of accuracy, which `spherecal verify` gives."


@dataclass(frozen=True, slots=True)
class StudyResult:
    """One study."""

    figures: list[dict[str, object]]
    """A dict for each feature."""
    page: StudyPage
    capable: bool | None
    """None where nothing was judged."""


def repeat_study(rows: Sequence[Measured], settings: RepeatSettings) -> StudyResult:
    """Repeats of one part. Raises DataError as `repeatability`."""
    found = repeatability(rows, settings)
    judged = [one for one in found if one.capable is not None]
    capable = all(one.capable for one in judged) if judged else None
    notes = (
        f"Cg = {settings.share:g} T / ({settings.spread:g} s), Cgk = ({settings.share:g} T / 2 - |mean - reference|) / ({settings.spread / 2:g} s); "
        f"capable from {settings.limit:g}. T the tolerance, s the standard deviation.",
        "The interval of s is the 95 % one of a normal distribution: 30 repeats know s to about 25 %.",
        *(f"{one.feature}: {one.note}" for one in found if one.note),
        _INFORMATIVE,
    )
    table = tuple(
        (
            one.feature,
            one.n,
            one.mean_mm,
            one.standard_deviation_mm,
            one.standard_deviation_interval_mm[0],
            one.standard_deviation_interval_mm[1],
            one.bias_mm,
            one.bias_is_significant,
            one.cg,
            one.cgk,
            one.least_tolerance_mm,
            "" if one.capable is None else "capable" if one.capable else "not capable",
        )
        for one in found
    )
    columns = ("feature", "n", "mean", "s", "s from", "to", "bias", "by more than chance", "Cg", "Cgk", "smallest tolerance", "")
    headline, tone = _judged(capable, "Capable", "Not capable", "No tolerance given: nothing is judged")
    study = StudyPage(
        "Repeatability (type 1 study)", headline, tone, columns, table, notes, pages.run_svg(rows), "Values in their order; dashed: tolerance."
    )
    figures = [asdict(one) for one in found]
    return StudyResult(figures, study, capable)


def rr_study(rows: Sequence[Measured]) -> StudyResult:
    """Gauge R&R. Raises DataError as `reproducibility`."""
    found = reproducibility(rows)
    capable = all(one.judgement != "not capable" for one in found)
    properties = ("reproducibility_mm", "gauge_mm", "share_of_variation", "share_of_tolerance", "n_categories", "judgement")
    figures = [asdict(one) | {name: getattr(one, name) for name in properties} for one in found]
    columns = ("feature", "repeatability", "reproducibility", "gauge", "parts", "of variation", "of tolerance", "classes", "")
    table = tuple(
        (
            one.feature,
            one.repeatability_mm,
            one.reproducibility_mm,
            one.gauge_mm,
            one.parts_mm,
            f"{100 * one.share_of_variation:.1f} %",
            None if one.share_of_tolerance is None else f"{100 * one.share_of_tolerance:.1f} %",
            one.n_categories,
            one.judgement,
        )
        for one in found
    )
    first = found[0]
    notes = (
        f"Analysis of variance of {first.n_parts} parts x {first.n_operators} operators x {first.n_trials} trials with interaction, all random; the "
        "interaction is pooled with the repeatability where its p is above 0.25. Standard deviations in mm.",
        "Of tolerance: six standard deviations of the gauge. Up to 10 % good, up to 30 % conditional. Classes: 1.41 parts / gauge, 5 are wanted.",
        "An operator is whatever changes between runs: for a robot the set-up, the program or the day.",
        _INFORMATIVE,
    )
    headline, tone = _judged(capable, "Capable or conditionally so", "Not capable", "")
    study = StudyPage("Gauge R&R", headline, tone, columns, table, notes, pages.groups_svg(rows, "operator"), "Values by part; colour: operator.")
    return StudyResult(figures, study, capable)


def approach_study(rows: Sequence[Measured]) -> StudyResult:
    """Direction of approach. Raises DataError as `reversals`."""
    found = reversals(rows)
    figures = [asdict(one) | {"is_significant": one.is_significant} for one in found]
    table = tuple(
        (one.feature, " less ".join(one.directions[::-1]), one.difference_mm, one.expanded_uncertainty_mm, one.is_significant) for one in found
    )
    worst = max(found, key=lambda one: abs(one.difference_mm))
    notes = (
        "Mean from one side minus mean from the other, with its 95 % uncertainty (Welch).",
        "What is significant is play or friction of the axes: approach measuring poses from the same side, as `plan` does where the path allows.",
    )
    headline = f"Largest reversal {worst.difference_mm:+.3f} mm ({worst.feature})"
    columns = ("feature", "directions", "reversal", "U (95 %)", "by more than chance")
    picture = pages.groups_svg(rows, "direction")
    return StudyResult(figures, StudyPage("Approach from both sides", headline, "", columns, table, notes, picture, "Colour: direction."), None)


def drift_study(rows: Sequence[Measured], limit_mm: float) -> StudyResult:
    """Cold to warm. Raises DataError as `drifts`."""
    found = drifts(rows)
    settled = {one.feature: one.settled_after_minutes(limit_mm) for one in found}
    figures = [asdict(one) | {"settled_after_minutes": settled[one.feature]} for one in found]
    table = tuple(
        (
            o.feature,
            o.slope_mm_per_hour,
            o.slope_expanded_uncertainty_mm_per_hour,
            o.span_mm,
            o.time_constant_minutes,
            o.warm_mm,
            settled[o.feature],
        )
        for o in found
    )
    notes = (
        "A line, and an exponential approach to a warm state where that describes the values better by its own measure (Akaike); without one nothing "
        "says when, or whether, it settles.",
        f"Settled: from when on less than {limit_mm:g} mm is still to come.",
    )
    worst = max(found, key=lambda one: one.span_mm)
    columns = ("feature", "mm per hour", "U (95 %)", "span", "time constant, min", "warm state", "settled after, min")
    headline = f"Largest drift {worst.span_mm:.3f} mm ({worst.feature})"
    return StudyResult(
        figures, StudyPage("Cold to warm", headline, "", columns, table, notes, pages.drift_svg(found), "Dotted: the warm state it approaches."), None
    )


def correlation_study(rows: Sequence[Measured]) -> tuple[dict[str, Offset], StudyResult]:
    """Offsets to a reference gauge. Raises DataError as `correlate`."""
    offsets = correlate(rows)
    figures = [{"feature": name} | asdict(offset) for name, offset in offsets.items()]
    table = tuple((n, o.n_parts, o.offset_mm, o.expanded_uncertainty_mm, o.scatter_mm, o.slope, o.slope_is_one) for n, o in offsets.items())
    notes = (
        "Offset: mean over parts of reference minus value, repeats of a part averaged first; U 95 % (Student). Scatter: of single parts after it.",
        "A slope that is not 1 says that the two see differences between parts differently: an offset does not cure that.",
        "Offsets take out what is systematic between two gauges. They prove nothing, and results show the raw value beside the corrected one.",
    )
    columns = ("feature", "parts", "offset", "U (95 %)", "scatter", "slope", "slope is 1")
    worst = max(offsets.items(), key=lambda item: abs(item[1].offset_mm))
    headline = f"Largest offset {worst[1].offset_mm:+.3f} mm ({worst[0]})"
    study = StudyPage(
        "Correlation with a reference", headline, "", columns, table, notes, pages.correlation_svg(rows), "Reference minus value by part."
    )
    return offsets, StudyResult(figures, study, None)


def _judged(capable: bool | None, yes: str, no: str, unknown: str) -> tuple[str, str]:
    if capable is None:
        return unknown, "unsure"
    return (yes, "good") if capable else (no, "bad")
