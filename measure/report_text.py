"""The words of a report: headline, tables and remarks, and what each figure means to a person."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from acquire.cell import Limits
from drivers.registry import hardware_remark
from measure.proof.lengths import LengthResult
from measure.report_page import CalibrationFacts, Row, Table
from measure.verify_result import SHAPED_ON, TRAINING_REMARK, VerifyResult

NOTHING = "–"

TONES = {"pass": "good", "conform": "good", "marginal": "unsure", "not_proven": "unsure", "fail": "bad", "reject": "bad"}

_HEADLINES = {
    "conform": ("Conform", "On shots the calibration never saw, every limit was kept with room for the test's own uncertainty."),
    "not_proven": ("Not proven", "The shots the calibration never saw do not show that every limit is kept. They do not show the opposite either."),
    "reject": ("Reject", "On shots the calibration never saw, a limit was exceeded by more than the test's own uncertainty."),
    "pass": ("Calibration passed, not yet verified", "Shots left out of the solve were predicted within the limits. Now verify at other places."),
    "marginal": ("Calibration marginal", "The calibration can be used with care; the reasons are below."),
    "fail": ("Calibration failed", "Do not measure with this calibration; the reasons are below."),
}

_NEXT = {
    "conform": ("Measure. Repeat the verification when the arm was touched, the payload changed, or the temperature moved by more than 5 degrees.",),
    "pass": ("Capture a verification session at other poses and places, then run `spherecal verify`.",),
    "marginal": (
        "Read the reasons: most are cured by more poses, more spread in depth and across the view, or a certified bar in three orientations.",
    ),
    "fail": ("Look at the rejected shots and the largest residuals first; check units, axis order and that no sphere moved.", "Capture again."),
    "not_proven": ("Give limits in the cell file where there are none.", "Add views of each sphere, and certified lengths across the work volume."),
    "reject": (
        "Look at the largest residuals: one sphere off means it moved or its certificate is wrong; all off, that the cell has changed.",
        "Calibrate again with more spread in depth, view and place, then verify again.",
    ),
}

_NEXT_OF_ROBOT = "Export the corrected robot or targets (`spherecal export`). To measure with a camera, calibrate it on shots of spheres too."


def headline_of(facts: CalibrationFacts, verification: VerifyResult | None) -> tuple[str, str, str]:
    """Headline, one sentence, and tone."""
    headline, sentence = _HEADLINES[_verdict(facts, verification)]
    return headline, sentence, TONES[_verdict(facts, verification)]


def next_steps_of(facts: CalibrationFacts, verification: VerifyResult | None) -> tuple[str, ...]:
    """What to do now."""
    verdict = _verdict(facts, verification)
    if verdict == "pass" and facts.robot_alone:
        return (_NEXT_OF_ROBOT,)
    if verdict == "not_proven" and verification is not None and verification.limits is not None:
        return _NEXT[verdict][1:]
    return _NEXT[verdict]


def _verdict(facts: CalibrationFacts, verification: VerifyResult | None) -> str:
    return facts.verdict if verification is None else verification.verdict


def remarks_of(facts: CalibrationFacts, verification: VerifyResult | None) -> tuple[str, ...]:
    """What a reader must know before any figure."""
    remarks = []
    if facts.simulated:
        remarks.append("Simulated cell: these figures come from a model of robot and camera, never from hardware.")
    remarks += [hardware_remark(name) for name in facts.untried_drivers]
    if verification is not None and not verification.held_out:
        remarks.append(f"{TRAINING_REMARK}. The figures flatter.")
    if verification is not None:
        remarks += [f"{warning[0].upper()}{warning[1:]}." for warning in verification.warnings]
    return tuple(remarks)


def result_rows(facts: CalibrationFacts, verification: VerifyResult | None) -> tuple[Row, ...]:
    """The before/after table."""
    if verification is not None:
        return (*_scatter_rows(verification), *_length_rows(verification), *_shape_rows(verification))
    help_text = "Each shot predicted by a solve that never saw it: how far its sphere centre lies from the common one, root mean square."
    limit = _limit(facts.limits, "centre_rms_mm")
    if facts.robot_alone:
        help_text = "Each external point predicted by a solve that never saw it: how far it lies from where it was measured, root mean square."
        return (_row("distance of points left out in turn, rms", help_text, None, facts.cross_validated_rms_mm, limit),)
    return (_row("centre rms, shots left out in turn", help_text, None, facts.cross_validated_rms_mm, limit),)


def _scatter_rows(verification: VerifyResult) -> list[Row]:
    after, before = verification.figures, verification.before
    if after.radial_rms_mm is None:
        return []
    radial = _row(
        "radial rms",
        "How far the single points of all shots lie from one common sphere: scatter of the shots and noise of the camera together.",
        None if before is None else before.radial_rms_mm,
        after.radial_rms_mm,
    )
    if after.centre_rms_mm is None:
        return [radial]
    return [
        _row(
            "centre rms",
            "A sphere stands still, so every shot must put its centre at the same place. This is the usual distance between them (repeatability).",
            None if before is None else before.centre_rms_mm,
            after.centre_rms_mm,
            _limit(verification.limits, "centre_rms_mm"),
            _mark(verification, ["centre rms"]),
        ),
        _row("largest centre distance", "The worst single shot.", None if before is None else before.centre_max_mm, after.centre_max_mm),
        radial,
    ]


def _length_rows(verification: VerifyResult) -> list[Row]:
    worst = _worst_length(verification)
    if worst is None:
        return []
    ends = "targets, by the robot less by the reference" if verification.of_points_alone else "spheres"
    help_text = f"Measured minus certified distance of two {ends}: the test that sees a wrong scale or a bent base, which repeatability cannot."
    before = _largest(verification.before_length_errors_mm.values())
    mark = _mark(verification, [f"length {x.label}" for x in verification.lengths])
    limit = _limit(verification.limits, "length_error_mm")
    return [_row(f"largest length error ({worst.label})", help_text, before, worst.error_mm, limit, mark, signed=True)]


def _shape_rows(verification: VerifyResult) -> list[Row]:
    after, before = verification.figures.spheres, {} if verification.before is None else verification.before.spheres
    if not after:
        return []
    sizes = [_largest(s.diameter_error_mm for s in side.values()) for side in (before, after)]
    forms = [_largest(s.form_mm for s in side.values()) for side in (before, after)]
    limits = verification.limits
    size_help = "Diameter of all shots stitched together minus the certified one, worst sphere."
    form_help = "Thickness of the thinnest shell that holds 95 % of all stitched points, worst sphere."
    size_mark = _mark(verification, [f"diameter of sphere {name}" for name in after])
    form_mark = _mark(verification, [f"form of sphere {name}" for name in after])
    return [
        _row("diameter error", size_help, sizes[0], sizes[1], _limit(limits, "diameter_error_mm"), size_mark, signed=True),
        _row("form", form_help, forms[0], forms[1], _limit(limits, "form_mm"), form_mark),
    ]


def result_lead(verification: VerifyResult | None) -> str:
    """One sentence before the table."""
    if verification is None:
        return "No verification was given. The only honest figure of a calibration alone is its prediction of shots that were left out of the solve."
    unseen = " that the calibration never saw" if verification.held_out else ""
    if verification.of_points_alone:
        points = f"{verification.used} of {verification.n_shots} external reference points{unseen}"
        return f"Figures on {points}: the robot alone, no sphere was seen. Uncalibrated: nominal robot, the target where the calibration found it."
    places = len(verification.figures.spheres)
    seen = f"{verification.used} of {verification.n_shots} shots{unseen}, of {places} sphere{'' if places == 1 else 's'}"
    if verification.before is None:
        return f"Figures on {seen}. The cell file has no first guess of the hand-eye, so there is no uncalibrated system to compare with."
    return f"Figures on {seen}. Uncalibrated: nominal robot and first guess of the hand-eye."


def tables_of(facts: CalibrationFacts, verification: VerifyResult | None) -> tuple[Table, ...]:
    """Lengths, spheres and rejected shots."""
    rejected = list(facts.rejected)
    if verification is not None:
        rejected += [(verification.session_name(r.session), r.index, r.reason) for r in verification.rejected]
    last = Table(
        "Rejected shots",
        "Nothing is left out in silence. A shot without a findable sphere, or far from all others, is listed here with its reason.",
        ("session", "shot", "reason"),
        tuple((name, str(index), reason) for name, index, reason in rejected),
        numeric=False,
    )
    if verification is None:
        return (last,)
    return (_length_table(verification), *(() if verification.of_points_alone else (_sphere_table(verification),)), last)


def calibration_rows(facts: CalibrationFacts) -> tuple[Row, ...]:
    """What was solved."""
    share = f"{facts.used} of {facts.n_shots}"
    return (
        Row("verdict of the calibration", "; ".join(facts.reasons), "", facts.verdict),
        Row("method", "clouds: all points of all shots at once; centres: one fitted centre a shot; stepwise: as published.", "", facts.method),
        Row("camera error model", "The simplest model that predicts left-out shots as well as any.", "", facts.camera_error),
        Row("shots used", "The others are listed above with their reasons.", "", share),
        Row(
            "parameters the data determine",
            "Of robot, hand-eye and camera. The others change nothing that any shot can see; they are kept at their nominal values.",
            "",
            f"{facts.rank} of {facts.n_parameters}",
        ),
        Row("radial rms of the training points", "Fit, not accuracy: the shots the solve was made from.", "", mm(facts.train_rms_mm)),
        Row("rms of shots left out in turn", "Each shot predicted by a solve that never saw it.", "", mm(facts.cross_validated_rms_mm)),
        Row("optical radius offset", "By how much the spheres read larger than certified, in radius.", "", mm(facts.radius_offset_mm, signed=True)),
        Row("datum", "Which base frame the results are in: a free calibration moves it by tenths of a mm.", "", facts.datum),
    )


def identity_of(facts: CalibrationFacts, verification: VerifyResult | None) -> tuple[tuple[str, str], ...]:
    """Names and digests."""
    lines = [("cell", facts.cell_name), ("calibration", facts.id), *facts.identity.items()]
    if verification is not None:
        lines += [(f"verification session {s.name}", s.digest) for s in verification.sessions]
        lines += verification.conditions
        lines.append(("procedure", SHAPED_ON))
    return tuple(lines)


def decision_text(verification: VerifyResult | None) -> str:
    """The decision rule, where one was used."""
    return "" if verification is None else f"Decision rule: {verification.decision_rule}."


def mm(value: float | None, *, signed: bool = False) -> str:
    """A length for people: three decimals, a dash for nothing."""
    if value is None or not np.isfinite(value):
        return NOTHING
    return f"{value:+.3f} mm" if signed else f"{value:.3f} mm"


def _row(
    label: str, help_text: str, before: float | None, after: float | None, limit: float | None = None, mark: str = "", *, signed: bool = False
) -> Row:
    shown = "" if limit is None else f"{'±' if signed else ''}{limit:g} mm"
    return Row(label, help_text, mm(before, signed=signed), mm(after, signed=signed), shown, mark.replace("_", " "), TONES.get(mark, ""))


def _limit(limits: Limits | None, name: str) -> float | None:
    return None if limits is None else float(getattr(limits, name))


def _mark(verification: VerifyResult, quantities: Sequence[str]) -> str:
    """The worst verdict among some quantities, empty where none was judged."""
    verdicts = {j.verdict for j in verification.judgements if j.quantity in quantities}
    return next((v for v in ("reject", "not_proven", "conform") if v in verdicts), "")


def _largest(values: Iterable[float]) -> float | None:
    return max(values, key=abs, default=None)


def _worst_length(verification: VerifyResult) -> LengthResult | None:
    return max((x for x in verification.lengths if x.not_judged is None), key=lambda x: abs(x.error_mm), default=None)


def _length_table(verification: VerifyResult) -> Table:
    rows = tuple(
        (
            x.label if x.not_judged is None else f"{x.label} (not judged: {x.not_judged})",
            f"{x.reference_mm:.3f}",
            f"{x.measured_mm:.3f}",
            _signed(verification.before_length_errors_mm.get(x.label)),
            _signed(x.error_mm),
            f"{x.expanded_uncertainty_mm:.3f}",
        )
        for x in verification.lengths
    )
    lead = "Between centres fitted on all views of each sphere together, in mm. U holds calibration, scatter and certificate."
    if verification.of_points_alone:
        lead = (
            "Between external reference points, each in one length, in mm: where the calibrated robot expects the target, against the distance that "
            "the reference measured (certified). U holds calibration, pose noise and noise of the reference. Where it stands does not come in."
        )
    return Table("Lengths between places", lead, ("length", "certified", "measured", "error before", "error", "U (k = 2)"), rows)


def _sphere_table(verification: VerifyResult) -> Table:
    lead = (
        "All shots of a sphere stitched, in mm. The last column is the diameter error that is left when the known radius offset is taken away. "
        "U (k = 2) of the diameter holds calibration, scatter and certificate; that of the form (95 %) scatter and the artefact's own form."
    )
    heads = ("sphere", "views", "points", "form 95 %", "its U", "form all", "diameter error", "its U", "less offset")
    known = verification.sphere_uncertainties
    rows = tuple(
        (
            name,
            str(s.n_views),
            str(s.n_points),
            f"{s.form_mm:.3f}",
            f"{known[name].form_expanded_mm:.3f}" if name in known else NOTHING,
            f"{s.form_all_mm:.3f}",
            _signed(s.diameter_error_mm),
            f"{known[name].diameter_expanded_mm:.3f}" if name in known else NOTHING,
            _signed(s.diameter_error_less_offset_mm),
        )
        for name, s in verification.figures.spheres.items()
    )
    return Table("Spheres", lead, heads, rows)


def _signed(value: float | None) -> str:
    return NOTHING if value is None else f"{value:+.3f}"
