"""`spherecal report` and `spherecal show`: a page for people, and a recording to look round in."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_measure import CalibrationFile
from measure.cli_run import AsJson, Debug, Quiet, command
from measure.console import LOCAL_ONLY, viewer_command

if TYPE_CHECKING:
    from calibrate import Calibration
    from drivers.files.session import Session

_SCANS = "Name a session with scans of spheres or of a workpiece; `spherecal report` makes a page of any calibration."
AnySessions = Annotated[list[Path] | None, typer.Argument(help="Session folders.")]


def report(
    calibration: CalibrationFile,
    sessions: AnySessions = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="The page to write; the same as JSON goes beside it.")] = Path("report.html"),
    pdf: Annotated[Path | None, typer.Option("--pdf", help="Write the page as PDF too.")] = None,
    beside: Annotated[
        list[Path] | None, typer.Option("--beside", help="Another calibration (e.g. by --method stepwise) to judge on the same unseen shots. Repeat.")
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Write report.html: the calibration and, where unseen sessions are named, its proof on them."""
    with command(as_json, debug, quiet) as run:
        from acquire.cell import cell_of_session
        from calibrate import Calibration
        from drivers.files.session import read_session
        from measure.files import require_writable
        from measure.report import write_report
        from measure.verify import verify

        for path in (out, *([] if pdf is None else [pdf])):
            require_writable(path)
        loaded = Calibration.load(calibration)
        read = [read_session(folder) for folder in sessions or []]
        unseen = [session for session in read if not is_training(loaded, session)]
        result = verify(loaded, unseen) if unseen else None
        cell = cell_of_session(read[0]) if read else None
        named = [(name_of(path, other), verify(other, unseen)) for path, other in ((p, Calibration.load(p)) for p in beside or [])] if unseen else []
        names = {session.digest: session.folder.name for session in read}
        write_report(out, loaded, result, cell=cell, session_names=names, others=named, pdf=pdf)
        run.console.say(f"{out} written" if pdf is None else f"{out} and {pdf} written")
        verdict = loaded.verdict if result is None else result.verdict
        run.finish({"out": out, "json": out.with_suffix(".json"), "pdf": pdf, "verdict": verdict, "verified": result is not None})


def name_of(path: Path, calibration: Calibration) -> str:
    """What a calibration is called beside others."""
    return f"{path.stem} ({calibration.method}, {calibration.camera_error.name})"


def show(
    calibration: CalibrationFile,
    sessions: Annotated[list[Path], typer.Argument(help="Session folders: of the calibration, unseen ones, a workpiece.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The recording to write.")] = Path("run.rrd"),
    view: Annotated[bool, typer.Option("--view", help="Open it in the Rerun viewer.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Write a Rerun recording: robot, camera and clouds of every shot, before and after."""
    with command(as_json, debug, quiet) as run:
        from calibrate import Calibration
        from drivers.files.session import read_session
        from measure.files import require_writable

        require_writable(out)
        loaded = Calibration.load(calibration)
        record(out, loaded, [read_session(folder) for folder in sessions])
        run.console.say(f"{out} written; look at it with: {viewer_command(out)}")
        if view:
            open_viewer(out)
        run.finish({"out": out})


def is_training(calibration: Calibration, session: Session) -> bool:
    """Whether a calibration was made from shots of this session."""
    known = {shot.scan_sha256 for shot in calibration.shots}
    external = () if calibration.external is None else calibration.external.shots
    return any(shot.sha256 in known for shot in session.shots) or any(shot.session == session.digest for shot in external)


def record(out: Path, calibration: Calibration, sessions: list[Session]) -> None:
    """Write a recording of sessions of all kinds; at most one of them of a workpiece.

    Raises:
        SettingsError: two workpieces.
        DataError: no shot can be shown.
        FileError: a session is broken, or the file cannot be written.
    """
    from acquire.cell import cell_of_session, robot_model_of
    from calibrate.second_look import see_sessions
    from drivers.errors import DataError, SettingsError
    from measure.run_scene import scene_of
    from measure.verify import verify
    from measure.viewer import write_recording

    cell = cell_of_session(sessions[0])
    workpieces = [session for session in sessions if session.purpose == "workpiece"]
    if len(workpieces) > 1:
        raise SettingsError("two workpieces do not fit one recording", file=workpieces[1].folder, remedy="Name one workpiece session.")
    of_spheres = [session for session in sessions if session.purpose != "workpiece"]
    trained = [session for session in of_spheres if is_training(calibration, session)]
    unseen = [session for session in of_spheres if not is_training(calibration, session)]
    shots = see_sessions(trained, cell=cell, model=robot_model_of(cell, trained[0])).shots if trained else ()
    verification = verify(calibration, unseen) if unseen else None
    scene = scene_of(calibration, cell, shots, verification=verification, workpiece=workpieces[0] if workpieces else None)
    if not scene.steps:
        message = "no clouds to show: no scan shows a sphere or a workpiece, and external reference points have none"
        raise DataError(message, file=sessions[0].folder, remedy=_SCANS)
    write_recording(out, scene)


def open_viewer(path: Path) -> None:
    """Start the viewer on a recording, for this computer alone, and go on.

    Raises:
        SettingsError: it cannot be started.
    """
    import subprocess
    import sys

    from drivers.errors import SettingsError

    try:
        words = [sys.executable, "-m", "rerun", *LOCAL_ONLY, str(path)]
        subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except OSError as error:
        raise SettingsError(f"the viewer cannot be started ({error})", remedy=f"Start it by hand: {viewer_command(path)}") from error
