"""`spherecal check`: a few shots of a sphere that stands still tell whether anything has changed, and what."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_history import HistoryPlace
from measure.cli_measure import CalibrationFile, SessionFolders, tell_rejected, tell_verdict
from measure.cli_run import AsJson, Debug, Quiet, command

if TYPE_CHECKING:
    from calibrate import Calibration
    from calibrate.few_parameters import Resolved
    from measure.cli_run import Run
    from measure.console import Console
    from measure.quick.check import CheckResult

_SHOWN_CAUSES = 5


def check(
    calibration: CalibrationFile,
    sessions: SessionFolders,
    resolve: Annotated[
        bool, typer.Option("--resolve", help="Solve what changed anew, as a new calibration; refused where left-out shots do not improve.")
    ] = False,
    cause: Annotated[
        str | None, typer.Option("--cause", help="What to solve anew: hand-eye, 'axis N' or 'sphere moved'; what was named if left out.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="The new calibration, with --resolve.")] = Path("resolved.yaml"),
    since: Annotated[
        Path | None, typer.Option("--since", help="Session of an earlier check at the same poses: what has changed between the two is told too.")
    ] = None,
    history: HistoryPlace = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Has anything changed since the calibration, and what? Exit code 3 when something has (reject)."""
    with command(as_json, debug, quiet) as run:
        from calibrate import Calibration
        from drivers.files.session import read_session
        from measure.history.recording import place_of, record_result
        from measure.quick.check import check as check_sessions

        loaded, place = Calibration.load(calibration), place_of(history, calibration)
        result = check_sessions(loaded, [read_session(folder) for folder in sessions], None if since is None else read_session(since))
        told = result.to_json_dict()
        _tell(run.console, result)
        kept = record_result(place, "check", loaded, calibration, told, run.console.note, taken_utc=result.taken_utc)
        solved = _resolved(run, loaded, result, cause, out, place) if resolve else None
        run.finish({**told, "history": kept, "resolved": solved}, verdict=result.verdict)


def _tell(console: Console, result: CheckResult) -> None:
    told = result.to_json_dict()
    console.table(
        f"{len(result.shots)} shots against the calibration, mm",
        ["shot", "sphere", "off by", "expected"],
        [[str(s.index), s.sphere, s.off_mm, s.expected_mm] for s in result.shots],
    )
    rows: list[list[object]] = [
        ["all shots off by, rms mm", result.rms_mm],
        ["expected where nothing changed, rms mm", result.expected_rms_mm],
        ["chi-square / freedom", f"{result.diagnosis.chi_square:.1f} / {result.diagnosis.freedom}"],
        ["chance that nothing changed gives this (at most)", f"{result.diagnosis.p_value:.2g}"],
    ]
    console.table("", ["", ""], rows)
    if result.diagnosis.changed:
        likeliest = result.diagnosis.explanations[:_SHOWN_CAUSES]
        console.table("causes", ["cause", "probability", "chi-square left"], [[e.name, f"{e.probability:.2g}", f"{e.left:.1f}"] for e in likeliest])
    tell_rejected(console, [(result.figures.session_name(r.session), r.index, r.reason) for r in result.figures.rejected])
    tell_verdict(console, result.verdict, tuple(str(reason) for reason in told["reasons"]) if isinstance(told["reasons"], list) else ())


def _resolved(run: Run, parent: Calibration, result: CheckResult, cause: str | None, out: Path, place: str | None) -> dict[str, object]:
    from measure.cli_solve import save_calibration
    from measure.files import require_writable
    from measure.history.recording import record_calibration
    from measure.quick.resolving import resolved

    require_writable(out)
    solved = resolved(parent, result, cause)
    _tell_resolved(run.console, solved, out)
    told: dict[str, object] = {
        "accepted": solved.accepted,
        "cause": solved.cause,
        "changes": {name: {"value": value, "standard_uncertainty": sigma} for name, (value, sigma) in solved.amplitudes.items()},
        "left_out_rms_before_mm": solved.left_out_before_mm,
        "left_out_rms_after_mm": solved.left_out_after_mm,
        "n_better": solved.n_better,
        "p_value_after": solved.p_value_after,
        "id": solved.calibration.id if solved.accepted else None,
        "parent": parent.id,
        "out": out if solved.accepted else None,
    }
    if solved.accepted:
        former = save_calibration(solved.calibration, out)
        if former is not None:
            run.console.note(f"the earlier {out} was kept as {former}")
        told["history"] = record_calibration(place, solved.calibration, out, run.console.note)
    return told


def _tell_resolved(console: Console, solved: Resolved, out: Path) -> None:
    rows = [[name, f"{value:+.3g}", f"{sigma:.2g}"] for name, (value, sigma) in solved.amplitudes.items()]
    console.table(f"{solved.cause}, solved anew", ["change", "value", "standard uncertainty"], rows)
    figures = f"shots left out are off by {solved.left_out_after_mm:.3f} mm rms instead of {solved.left_out_before_mm:.3f} mm"
    if solved.accepted:
        console.say(f"{figures}: a new calibration is in {out}; prove it with `spherecal verify` before it is put to use")
    else:
        console.say(f"{figures}, {solved.n_better} of {solved.n_shots} are nearer: no new calibration was written")
