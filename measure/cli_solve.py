"""`spherecal centres` and `spherecal calibrate`: from a session to centres, and to a calibration."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_history import HistoryPlace
from measure.cli_measure import SessionFolders, tell_rejected, tell_verdict
from measure.cli_run import AsJson, Debug, Quiet, command

if TYPE_CHECKING:
    from acquire.centres import CentreRow
    from calibrate import Calibration
    from calibrate.datum_choice import DatumChoice
    from measure.console import Console


class CameraErrorChoice(StrEnum):
    """Camera error models; auto takes the simplest that held-out shots do not tell from the best."""

    auto = "auto"
    none = "none"
    affine = "affine"
    pillow = "pillow"
    pillow_free = "pillow-free"
    pillow_full = "pillow-full"
    pillow_full_free = "pillow-full-free"
    field = "field"


class ArmTerms(StrEnum):
    """Whether compliance, transmission and linkage errors of the arm may be estimated."""

    auto = "auto"
    none = "none"


class Method(StrEnum):
    """Solvers: every point at once, one fitted centre a shot, or the paper's Algorithm 1 on sphere centres."""

    clouds = "clouds"
    centres = "centres"
    stepwise = "stepwise"


def centres(
    session: Annotated[Path, typer.Argument(help="The session folder.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The table to write.")] = Path("centres.csv"),
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Find the sphere in every shot: its centre with covariance, or the reason why there is none."""
    with command(as_json, debug, quiet) as run:
        from acquire.cell import cell_of_session, robot_model_of
        from acquire.centres import centres_of_session, write_centres_csv
        from acquire.check import check_session
        from drivers.files.session import read_session

        read = read_session(session)
        cell = cell_of_session(read)
        model = robot_model_of(cell, read)
        check_session(read, cell, model)
        rows: list[CentreRow] = []
        with run.console.progress("finding spheres") as advance:
            for row in centres_of_session(read, cell, model=model):
                rows.append(row)
                advance(len(rows), len(read.shots))
        write_centres_csv(rows, out)
        run.finish(_tell_centres(run.console, session.name, rows, out))


def _tell_centres(console: Console, session: str, rows: list[CentreRow], out: Path) -> dict[str, object]:
    refused = [row for row in rows if not row.used]
    console.table(
        "",
        ["sphere", "shots", "points (median)", "rms mm (median)"],
        [
            [name, len(found), _median([float(row.n_points) for row in found]), _median([row.rms_mm for row in found if row.rms_mm is not None])]
            for name in sorted({row.sphere or "-" for row in rows})
            if (found := [row for row in rows if row.used and (row.sphere or "-") == name])
        ],
    )
    tell_rejected(console, [(session, row.index, f"{row.reason}: {row.message}") for row in refused])
    console.say(f"{len(rows) - len(refused)} of {len(rows)} shots usable, in {out}")
    return {
        "n_shots": len(rows),
        "used": len(rows) - len(refused),
        "rejected": [{"index": row.index, "sphere": row.sphere, "reason": row.reason, "message": row.message} for row in refused],
        "out": out,
    }


def _median(values: list[float]) -> float | None:
    return sorted(values)[len(values) // 2] if values else None


def calibrate(
    sessions: SessionFolders,
    out: Annotated[Path, typer.Option("--out", "-o", help="The calibration to write.")] = Path("calibration.yaml"),
    method: Annotated[Method, typer.Option(help="The solver.")] = Method.clouds,
    camera_error: Annotated[
        CameraErrorChoice, typer.Option("--camera-error", metavar="MODEL", help=f"Of the camera's error: {', '.join(CameraErrorChoice)}.")
    ] = CameraErrorChoice.auto,
    robot_terms: Annotated[
        ArmTerms, typer.Option("--robot-terms", help="Terms of the arm beyond link twists: those that held-out shots want, or none.")
    ] = ArmTerms.auto,
    datum: Annotated[
        Path | None, typer.Option("--datum", metavar="CALIBRATION", help="State results in this earlier calibration's base, robot laid on robot.")
    ] = None,
    datum_spheres: Annotated[
        str, typer.Option("--datum-spheres", metavar="A,B,C", help="With --datum: three or more spheres that have not moved hold the base instead.")
    ] = "",
    history: HistoryPlace = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate robot, hand-eye and camera together. Exit code 3 when the verdict is fail."""
    with command(as_json, debug, quiet) as run:
        from calibrate.solve import CalibrationSettings
        from calibrate.solve import calibrate as calibrate_sessions
        from drivers.files.session import read_session
        from measure.files import require_writable
        from measure.history.recording import place_of, record_calibration

        require_writable(out)
        read = [read_session(folder) for folder in sessions]
        with run.console.progress("calibrating"):
            settings = CalibrationSettings(
                camera_error=camera_error.value, method=method.value, robot_terms=robot_terms.value, datum=_datum_choice(datum, datum_spheres)
            )
            calibration = calibrate_sessions(read, settings)
        former = save_calibration(calibration, out)
        if former is not None:
            run.console.note(f"the earlier {out} was kept as {former}")
        tell_calibration(run.console, calibration, {session.digest: session.folder.name for session in read})
        if calibration.next_best_poses:
            run.console.say(f"to take the next best poses: copy the entries of next_best_poses in {out} to poses: of a plan for `spherecal capture`,")
            run.console.say("and calibrate the old and the new session together")
        run.console.say(f"written to {out}; prove it on other shots: spherecal verify {out} SESSION")
        kept = record_calibration(place_of(history, out), calibration, out, run.console.note)
        run.finish({"method": method.value, **calibration.to_json_dict(), "out": out, "history": kept}, verdict=calibration.verdict)


def _datum_choice(earlier: Path | None, spheres: str) -> DatumChoice | None:
    from calibrate import Calibration
    from calibrate.datum_choice import DatumChoice
    from drivers.errors import SettingsError

    if earlier is not None:
        return DatumChoice(Calibration.load(earlier), tuple(name.strip() for name in spheres.split(",") if name.strip()))
    if spheres:
        remedy = "Add --datum CALIBRATION, which tells where they stood."
        raise SettingsError("spheres alone do not tell where the base is", where="--datum-spheres", remedy=remedy)
    return None


def save_calibration(calibration: Calibration, out: Path) -> Path | None:
    """Write a calibration; an earlier one is never lost but moved aside. Returns where it lies now, if there was another."""
    from measure.files import replacing

    with replacing(out, "spherecal-calibration/1") as former:
        calibration.save(out)
    return former if former is not None and former.exists() else None


def tell_calibration(console: Console, calibration: Calibration, names: dict[str, str]) -> None:
    """What a solve says of itself, for a person."""
    statistics = calibration.statistics
    rows: list[list[object]] = [
        ["shots used", f"{statistics.used} of {statistics.n_shots}"],
        ["camera error model", calibration.camera_error.name],
        ["parameters determined by the data", f"{statistics.rank} of {statistics.n_parameters}"],
        ["residual on the shots used, rms mm", statistics.train_rms_mm],
        ["error on shots left out, rms mm", statistics.cross_validated_rms_mm],
        ["spheres read larger in radius by, mm", calibration.radius_offset_mm],
        ["time, s", f"{statistics.seconds:.1f}"],
    ]
    console.table("", ["", ""], rows)
    tell_rejected(console, [(names.get(shot.session, shot.session[:12]), shot.index, shot.reason) for shot in calibration.rejected])
    tell_verdict(console, calibration.verdict, calibration.reasons)
