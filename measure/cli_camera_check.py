"""`spherecal camera-check`: is the camera right over its volume, before anything is calibrated?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_run import AsJson, Debug, Quiet, command, stopped_by_signals

if TYPE_CHECKING:
    from measure.cli_run import Run
    from measure.console import Console
    from measure.proof.camera_check import CameraCheck


def camera_check(
    what: Annotated[list[Path], typer.Argument(help="Sessions, or one cell file: then pictures are taken.")],
    page: Annotated[Path | None, typer.Option("--page", help="Write an HTML page here.")] = None,
    diameter_limit: Annotated[float | None, typer.Option("--diameter-limit", metavar="MM", help="Instead of the cell's.")] = None,
    form_limit: Annotated[float | None, typer.Option("--form-limit", metavar="MM", help="Instead of the cell's.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="With a cell: the session to record.")] = None,
    sphere: Annotated[str | None, typer.Option(help="With a cell: the sphere that is swept.")] = None,
    count: Annotated[int, typer.Option("-n", min=1, help="With a cell: places to see.")] = 20,
    every: Annotated[float, typer.Option(min=0.0, metavar="S", help="With a cell: seconds between pictures.")] = 1.0,
    give_up: Annotated[float, typer.Option("--give-up", min=0.0, metavar="S", help="With a cell: end after so long.")] = 600.0,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Fit a sphere that was swept through the view, with robot or camera at rest: diameter and form over the camera's volume.

    With sessions nothing is opened. With a cell file pictures are taken while somebody moves the sphere (or jogs the robot);
    nothing is moved by spherecal. Exit code 3 when the verdict is reject.
    """
    with command(as_json, debug, quiet) as run, stopped_by_signals():
        from drivers.files.session import read_session
        from measure.files import require_writable
        from measure.proof.camera_check import camera_check as check_sessions
        from measure.proof.camera_page import write_camera_page

        if page is not None:
            require_writable(page)
        folders = what
        if len(what) == 1 and what[0].is_file():
            folders = [_recorded(run, what[0], out, sphere, count, every, give_up)]
        found = check_sessions([read_session(folder) for folder in folders], limits=_limits(diameter_limit, form_limit))
        tell_check(run.console, found)
        if page is not None:
            write_camera_page(page, found)
            run.console.say(f"{page} written")
        run.finish(found.to_json_dict() | {"page": page}, verdict=found.verdict)


def _limits(diameter_mm: float | None, form_mm: float | None) -> tuple[float, float] | None:
    from drivers.errors import SettingsError

    if diameter_mm is None and form_mm is None:
        return None
    if diameter_mm is None or form_mm is None or min(diameter_mm, form_mm) <= 0:
        raise SettingsError("both limits are wanted, above zero", where="--diameter-limit, --form-limit", remedy="Give both, or neither.")
    return diameter_mm, form_mm


def _recorded(run: Run, path: Path, out: Path | None, sphere: str | None, count: int, every_s: float, give_up_s: float) -> Path:
    """Take the pictures of a sweep; the session's folder."""
    from acquire.cell import devices_of, load_cell
    from acquire.session import SessionWriter
    from drivers.errors import SettingsError
    from measure.proof.camera_sweep import SweepSettings, sweep

    cell = load_cell(path)
    if out is None:
        raise SettingsError("no folder for the pictures is named", where="--out", remedy="Name a new session with -o.")
    name = sphere or (next(iter(cell.spheres)) if len(cell.spheres) == 1 else None)
    if name not in cell.spheres:
        known = ", ".join(cell.spheres) or "none"
        raise SettingsError(f"which sphere is swept? {name!r} is none of the cell's", where="--sphere", remedy=f"Choose one of {known}.")
    with SessionWriter.create(out, purpose="verification", cell=cell) as writer, devices_of(cell) as devices:
        settings = SweepSettings(n_places=count, every_s=every_s, give_up_s=give_up_s)
        kept = sweep(devices, cell, str(name), writer, settings, run.console.note)
    run.console.say(f"{kept} pictures in {out}")
    return out


def tell_check(console: Console, found: CameraCheck) -> None:
    """What the places say, for a person."""
    from measure.cli_measure import tell_rejected, tell_verdict
    from measure.proof.camera_page import summary

    for sentence in summary(found):
        console.say(sentence)
    rows: list[list[object]] = [
        [f"{found.session_name(p.session)} {p.index}", *(f"{c:.0f}" for c in p.centre_in_camera_mm), f"{p.diameter_error_mm:+.3f}", p.form_mm]
        for p in found.places
    ]
    console.table("every place, mm in the camera", ["shot", "x", "y", "z", "diameter error", "form (95 %)"], rows)
    tell_rejected(console, [(found.session_name(shot.session), shot.index, shot.reason) for shot in found.rejected])
    tell_verdict(console, found.verdict, found.reasons)
