"""`spherecal verify`: what a calibration is worth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_history import HistoryPlace, marked
from measure.cli_run import AsJson, Debug, Quiet, command

if TYPE_CHECKING:
    from measure.console import Console
    from measure.verify_result import VerifyResult

CalibrationFile = Annotated[Path, typer.Argument(help="calibration.yaml, as `calibrate` writes it.")]
SessionFolders = Annotated[list[Path], typer.Argument(help="Session folders.")]


def verify(
    calibration: CalibrationFile,
    sessions: SessionFolders,
    allow_training_data: Annotated[bool, typer.Option("--allow-training-data", help="Take shots of the calibration itself too.")] = False,
    history: HistoryPlace = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Prove a calibration on shots that it never saw. Exit code 3 when the verdict is reject."""
    with command(as_json, debug, quiet) as run:
        from calibrate import Calibration
        from drivers.files.session import read_session
        from measure.history.recording import last_taken_utc, place_of, record_result
        from measure.verify import verify as verify_sessions

        loaded, place = Calibration.load(calibration), place_of(history, calibration)
        read = [read_session(folder) for folder in sessions]
        result = verify_sessions(loaded, read, allow_training_data=allow_training_data)
        tell_verification(run.console, result)
        taken_utc = last_taken_utc(read)
        told = {**result.to_json_dict(), "marked": marked(run.console, place, loaded, taken_utc)}
        kept = record_result(place, "verification", loaded, calibration, told, run.console.note, taken_utc=taken_utc)
        run.finish({**told, "history": kept}, verdict=result.verdict)


def tell_verification(console: Console, result: VerifyResult) -> None:
    """Figures before and after, lengths, verdict and reasons, for a person."""
    from measure.verify_result import TRAINING_REMARK

    if not result.held_out:
        console.say(TRAINING_REMARK)
    console.table("", ["on unseen shots, mm", "uncalibrated", "calibrated"], comparison_rows(result))
    rows = [
        [length.label, length.measured_mm, length.reference_mm, f"{length.error_mm:+.3f}", length.expanded_uncertainty_mm, length.not_judged or ""]
        for length in result.lengths
    ]
    if rows:
        console.table("lengths, mm", ["between", "measured", "certified", "error", "U (k=2)", "not judged"], rows)
    tell_spheres(console, result)
    tell_probing(console, result)
    tell_slides(console, result)
    if result.external is not None:
        found = result.external
        row: list[object] = [len(found.points), found.rms_mm, found.expected_rms_mm, found.max_mm]
        console.table("external reference points: robot less reference, mm", ["points", "rms", "rms expected", "largest"], [row])
    tell_rejected(console, [(result.session_name(shot.session), shot.index, shot.reason) for shot in result.rejected])
    for warning in result.warnings:
        console.note(f"warning: {warning}")
    tell_verdict(console, result.verdict, result.reasons)


def tell_spheres(console: Console, result: VerifyResult) -> None:
    """Diameter and form (95 %) of every sphere stitched from all its views, each with its U."""
    rows: list[list[object]] = []
    for name, sphere in result.figures.spheres.items():
        u = result.sphere_uncertainties[name]
        rows.append([name, str(sphere.n_views), f"{sphere.diameter_error_mm:+.3f}", u.diameter_expanded_mm, sphere.form_mm, u.form_expanded_mm])
    if rows:
        heads = ["sphere", "views", "diameter error", "U (k=2)", "form 95 %", "U (k=2)"]
        console.table("spheres stitched from all views, mm", heads, rows)


def tell_probing(console: Console, result: VerifyResult) -> None:
    """Form and size of every sphere over all its views, and of the worst single view."""
    rows: list[list[object]] = []
    for name in result.figures.spheres:
        members = [p for p in result.probing if p.sphere == name and p.probing is not None]
        together = next((p.probing for p in members if p.session is None), None)
        single = [p.probing for p in members if p.session is not None and p.probing is not None]
        if together is not None:
            rows.append([name, "all views", *together.form_mm, *(f"{size:+.3f}" for size in together.size_error_mm)])
        if single:
            worst = max(single, key=lambda p: p.form_mm[2])
            rows.append([name, "worst view", *worst.form_mm, *(f"{size:+.3f}" for size in worst.size_error_mm)])
    if rows:
        heads = ["sphere", "of", "form, all", "99.7 %", "95 %", "size, all", "99.7 %", "95 %"]
        console.table("probing error of form and size (free radius), mm", heads, rows)


def tell_slides(console: Console, result: VerifyResult) -> None:
    """The paper's slide test, view by view, with what the paper prints beside it."""
    from measure.proof.slide import CAUTION, slide_rows

    rows = slide_rows(result.slides)
    if rows:
        heads = ["slide", "pairs", "mean", "max", "std", "signed mean", "refused"]
        console.table("slide: | |P1 - P2| - L | view by view, mm", heads, rows)
        console.say(f"  {CAUTION}")


def comparison_rows(result: VerifyResult) -> list[list[object]]:
    """The before/after table: what changed by calibrating, in plain words."""
    after, before = result.figures, result.before
    lengths_after = [length.error_mm for length in result.lengths]
    lengths_before = list(result.before_length_errors_mm.values())
    rows: list[list[object]] = [
        ["scatter of a sphere's centre between views (rms)", before and before.centre_rms_mm, after.centre_rms_mm],
        ["worst single view", before and before.centre_max_mm, after.centre_max_mm],
        ["distance of all points from the sphere (rms)", before and before.radial_rms_mm, after.radial_rms_mm],
    ]
    if lengths_after:
        rows.append(
            [
                f"error of {len(lengths_after)} lengths {'between targets' if result.of_points_alone else 'between spheres'} (rms)",
                _rms(lengths_before),
                _rms(lengths_after),
            ]
        )
        rows.append(["worst length", _worst(lengths_before), _worst(lengths_after)])
    if after.spheres:
        diameters_before = [sphere.diameter_error_mm for sphere in before.spheres.values()] if before else []
        rows.append(["error of a sphere's diameter (worst)", _worst(diameters_before), _worst([s.diameter_error_mm for s in after.spheres.values()])])
    return [row for row in rows if row[1] is not None or row[2] is not None]


def tell_rejected(console: Console, rejected: list[tuple[str, int, str]]) -> None:
    """Shots that were not used, and why."""
    if rejected:
        console.table("not used", ["session", "shot", "reason"], [list(row) for row in rejected])


def tell_verdict(console: Console, verdict: str, reasons: tuple[str, ...]) -> None:
    """The verdict, and a line for each reason."""
    console.say(f"verdict: {verdict}")
    for reason in reasons:
        console.say(f"  {reason}")


def _rms(values: list[float]) -> float | None:
    return (sum(value * value for value in values) / len(values)) ** 0.5 if values else None


def _worst(values: list[float]) -> float | None:
    return max((abs(value) for value in values), default=None)
