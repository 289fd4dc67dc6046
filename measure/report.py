"""report.html: one self-contained page for people, on a screen, a phone or paper; no script, no outside resource."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from acquire.cell import Cell
from calibrate.observations import SphereShot
from calibrate.result import Calibration
from drivers.files.disk import write_text_atomic
from drivers.kinematics.se3 import FloatArray
from measure import plots
from measure.console import json_text
from measure.plots import AFTER_COLOUR, LengthBar, ShotSeries
from measure.proof.tables import proof_tables
from measure.report_facts import facts_of, folders_of
from measure.report_insight import budget_pictures, budget_tables, field_pictures, field_tables, identifiability_tables
from measure.report_page import CalibrationFacts, Page, Picture, ShotResidual, Table
from measure.report_pdf import write_pdf
from measure.report_residual import centre_shifts_mm, residual_pictures
from measure.report_tables import beside_table, report_data, shots_table
from measure.report_text import (
    calibration_rows,
    decision_text,
    headline_of,
    identity_of,
    next_steps_of,
    remarks_of,
    result_lead,
    result_rows,
    tables_of,
)
from measure.verify_result import TRAINING_REMARK, VerifyResult

_CHECK_COLOUR = "#7a3e9d"


def write_report(
    path: str | Path,
    calibration: Calibration,
    verification: VerifyResult | None = None,
    *,
    cell: Cell | None = None,
    session_names: Mapping[str, str] | None = None,
    others: Sequence[tuple[str, VerifyResult]] = (),
    pdf: str | Path | None = None,
) -> Path:
    """Write the report of a calibration, with or without a verification, and the same for machines (.json) beside it; returns the path.

    Args:
        path: the HTML file; it appears whole or not at all.
        calibration: what is reported on.
        verification: on shots that it never saw.
        cell: for the camera's working range, and whether the cell is simulated.
        session_names: names of the calibration's sessions by their digest, instead of their folders.
        others: name and verification of other calibrations, on the same shots.
        pdf: write the page as PDF too.

    Raises:
        FileError: the folder is missing or not writable.
    """
    names = {**folders_of(calibration.inputs), **(session_names or {})}
    more = (*beside_table(verification, others), *shots_table(calibration.shots, names))
    facts = facts_of(calibration, cell, session_names)
    data = {**report_data(calibration, verification, others), "remarks": list(remarks_of(facts, verification))}
    write_text_atomic(Path(path).with_suffix(".json"), json_text(data) + "\n")
    return write_page(path, facts, verification, more=more, pdf=pdf)


def write_page(
    path: str | Path,
    facts: CalibrationFacts,
    verification: VerifyResult | None = None,
    *,
    more: tuple[Table, ...] = (),
    pdf: str | Path | None = None,
    now: datetime.datetime | None = None,
) -> Path:
    """Write a report from plain facts; returns the path.

    Args:
        path: the HTML file; it appears whole or not at all.
        facts: what to say of the calibration.
        verification: on shots that it never saw.
        more: further tables.
        pdf: write the page as PDF too.
        now: date printed on the page; the present if None.

    Raises:
        FileError: the folder is missing or not writable.
    """
    moment = now or datetime.datetime.now(datetime.UTC)
    page = page_of(facts, verification, moment)
    page = replace(page, tables=(*page.tables, *more))
    write_text_atomic(path, render(page))
    if pdf is not None:
        write_pdf(pdf, page)
    return Path(path)


def render(page: Page) -> str:
    """The HTML text of a page; every text on it is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(loader=PackageLoader("measure"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.get_template("report.html.j2").render(page=page)


def page_of(facts: CalibrationFacts, verification: VerifyResult | None, moment: datetime.datetime) -> Page:
    """All texts and pictures of a report."""
    headline, sentence, tone = headline_of(facts, verification)
    return Page(
        title=f"{facts.cell_name}: {'verification' if verification else 'calibration'} report",
        headline=headline,
        sentence=sentence,
        tone=tone,
        remarks=remarks_of(facts, verification),
        result_lead=result_lead(verification),
        rows=result_rows(facts, verification),
        reasons=facts.reasons if verification is None else verification.reasons,
        next_steps=next_steps_of(facts, verification),
        tables=(*tables_of(facts, verification), *(() if verification is None else proof_tables(verification)), *_insight_tables(facts)),
        pictures=tuple(_pictures(facts, verification)),
        calibration_rows=calibration_rows(facts),
        identity=identity_of(facts, verification),
        created_utc=moment.strftime("%Y-%m-%d %H:%M UTC"),
        software=_software(),
        decision_rule=decision_text(verification),
        on_every_page="" if verification is None or verification.held_out else TRAINING_REMARK,
    )


def _insight_tables(facts: CalibrationFacts) -> tuple[Table, ...]:
    field = field_tables(facts.camera_field, facts.seen_cells)
    return (*budget_tables(facts.error_budget), *field, *identifiability_tables(facts.identifiability))


def _pictures(facts: CalibrationFacts, verification: VerifyResult | None) -> list[Picture]:
    found: list[Picture] = []
    if verification is not None:
        found += _centre_pictures(verification)
        found += _length_picture(verification)
        found += residual_pictures(verification.figures, verification.maps)
    found += _shot_picture(facts, verification)
    found += _coverage_pictures(facts, verification)
    found += field_pictures(facts.camera_field, facts.seen_cells, facts.working_range_mm, facts.field_of_view_deg)
    found += budget_pictures(facts.error_budget)
    return found


def _centre_pictures(verification: VerifyResult) -> list[Picture]:
    after = centre_shifts_mm(verification.figures)[1]
    before = None if verification.before is None else centre_shifts_mm(verification.before)[1]
    if not len(after):
        return []
    caption = "Centre of each shot about the mean of its sphere; the circle is the rms distance in space. Mind the two scales: blue is in both."
    views = (("from above", (0, 1)), ("from the side", (0, 2)))
    return [Picture(f"Sphere centres, {name}", caption, plots.centres_svg(before, after, axes=axes)) for name, axes in views]


def _length_picture(verification: VerifyResult) -> list[Picture]:
    bars = [LengthBar(x.label, x.error_mm, x.expanded_uncertainty_mm) for x in verification.lengths]
    if not bars:
        return []
    limit = None if verification.limits is None else verification.limits.length_error_mm
    caption = "Measured minus certified distance between sphere places. A bar that misses zero says that its uncertainty is too small."
    return [Picture("Lengths", caption, plots.lengths_svg(bars, verification.before_length_errors_mm, limit_mm=limit))]


def _shot_picture(facts: CalibrationFacts, verification: VerifyResult | None) -> list[Picture]:
    series: list[ShotSeries] = []
    if facts.shots:
        series.append(_series("calibration", 0, [shot.residual_mm for shot in facts.shots], AFTER_COLOUR))
    if verification is not None:
        values = [v.radial_rms_mm if v.deviation_mm is None else v.deviation_mm for v in verification.figures.views]
        series.append(_series("verification", len(facts.shots), values, _CHECK_COLOUR))
    if not series:
        return []
    limit = None if facts.limits is None else facts.limits.centre_rms_mm
    caption = "One stem per shot, calibration first. A single tall stem is a bad shot, a slope a drift, a step a moved sphere."
    return [Picture("Residual of each shot", caption, plots.shots_svg(series, rejected=np.zeros(0), ylabel=facts.residual_name, limit_mm=limit))]


def _series(label: str, start: int, values: Sequence[float], colour: str) -> ShotSeries:
    return ShotSeries(label, start + np.arange(len(values), dtype=np.float64), np.asarray(values, dtype=np.float64), colour)


def _coverage_pictures(facts: CalibrationFacts, verification: VerifyResult | None) -> list[Picture]:
    groups = {"calibration": (_camera_places(facts.shots), AFTER_COLOUR)}
    if verification is not None:
        groups["verification"] = (_camera_places(verification.observations.shots), _CHECK_COLOUR)
    groups = {label: group for label, group in groups.items() if len(group[0])}
    if not groups:
        return []
    caption = "Where the camera saw the spheres; dotted lines are its working range. Scale and camera error are known only where there are dots."
    return [
        Picture(
            f"Coverage of the camera volume, {'xy'[axis]}-z",
            caption,
            plots.coverage_svg(groups, axis=axis, working_range_mm=facts.working_range_mm, seen_mm=facts.seen_mm),
        )
        for axis in (0, 1)
    ]


def _camera_places(shots: Sequence[ShotResidual] | Sequence[SphereShot]) -> FloatArray:
    found = [shot.centre_in_camera_mm for shot in shots if shot.centre_in_camera_mm is not None]
    return np.stack(found) if found else np.empty((0, 3))


def _software() -> str:
    try:
        return f"spherecal {version('spherecal')}"
    except PackageNotFoundError:
        return "spherecal"
