"""`spherecal stitch`: the scans of a session as one cloud."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_history import HistoryPlace, marked
from measure.cli_measure import CalibrationFile
from measure.cli_run import AsJson, Debug, Quiet, command

if TYPE_CHECKING:
    from calibrate.part_correction import PartCorrection
    from measure.console import Console
    from measure.stitch import StitchResult
    from measure.stitching.refine import Refinement


def stitch(
    calibration: CalibrationFile,
    session: Annotated[Path, typer.Argument(help="The session whose scans are to be put together.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The cloud to write, robot base: PLY, PCD, E57 or LAZ by its ending.")] = Path("cloud.ply"),
    voxel: Annotated[float, typer.Option("--voxel", metavar="MM", help="Edge of the voxels: one point each.")] = 0.5,
    keep_edges: Annotated[bool, typer.Option("--keep-edges", help="Keep flying pixels, grazing surfaces and specks.")] = False,
    max_incidence: Annotated[float, typer.Option("--max-incidence", metavar="DEG", help="Drop what is seen more grazing.")] = 75.0,
    min_count: Annotated[int, typer.Option("--min-count", help="Leave out voxels with fewer points.")] = 1,
    refine: Annotated[bool, typer.Option("--refine", help="Register the scans to each other too; a second cloud.")] = False,
    spheres_in_view: Annotated[
        bool, typer.Option("--spheres-in-view", help="Correct for this part by the fixture spheres that its session shows too.")
    ] = False,
    means_only: Annotated[bool, typer.Option("--means-only", help="No normals, spread and uncertainty: less memory.")] = False,
    memory: Annotated[float, typer.Option("--memory", metavar="MB", help="Of the voxel table; beyond it on disk.")] = 700.0,
    threads: Annotated[int | None, typer.Option("--threads", help="Scans worked on at a time [default: all processors].")] = None,
    rrd: Annotated[Path | None, typer.Option("--rrd", help="Also a Rerun recording of the cloud.")] = None,
    history: HistoryPlace = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Put the scans of a session together into one cloud in the robot base."""
    with command(as_json, debug, quiet) as run:
        from calibrate import Calibration
        from drivers.files.session import read_session
        from measure.history.recording import last_taken_utc, place_of
        from measure.stitch import StitchSettings
        from measure.stitch import stitch as stitch_session
        from measure.stitching.scan import NO_CLEANING, Cleaning

        cleaning = NO_CLEANING if keep_edges else Cleaning(max_incidence_deg=max_incidence)
        settings = StitchSettings(voxel, cleaning, min_count, not means_only, memory, threads, refine)
        loaded, read = Calibration.load(calibration), read_session(session)
        if rrd is not None:
            _require_ply(out)
        correction = None
        if spheres_in_view:
            from measure.part_view import correct_by_session

            correction = correct_by_session(loaded, read)
            tell_correction(run.console, correction)
        with run.console.progress("stitching") as advance:
            result = stitch_session(loaded if correction is None else correction.calibration, read, out, settings=settings, on_progress=advance)
        if rrd is not None:
            from measure.viewer_cloud import write_cloud_recording

            write_cloud_recording(rrd, result.cloud, title=f"{out.name}: calibration {loaded.id[:12]}")
        tell_stitched(run.console, result)
        doubts = marked(run.console, place_of(history, calibration), loaded, last_taken_utc([read]))
        more = {} if rrd is None else {"rrd": str(rrd)}
        part = {} if correction is None else {"part_correction": correction.to_json_dict()}
        run.finish({**result.to_json_dict(), "marked": doubts, **more, **part})


def tell_correction(console: Console, correction: PartCorrection) -> None:
    """What the spheres in view said, for a person."""
    if correction.accepted:
        console.say(f"corrected for this part by {correction.n_spheres} spheres in {correction.n_shots} shots: {correction.reason}")
    else:
        console.note(f"warning: not corrected by the spheres in view: {correction.reason}")


def tell_stitched(console: Console, result: StitchResult) -> None:
    """What became of the scans, for a person."""
    counts = result.counts
    console.say(f"{result.n_points} points of {result.n_points_in} read, from {result.n_scans} scans, in {result.out} ({result.seconds:.1f} s)")
    dropped = {"at depth edges": counts.n_edge, "seen too grazing": counts.n_grazing, "in specks": counts.n_speck, "out of reach": counts.n_outside}
    if any(dropped.values()):
        console.say("dropped: " + ", ".join(f"{n} {why}" for why, n in dropped.items() if n))
    if counts.empty_shots:
        console.note(f"warning: no valid point in shots {', '.join(map(str, counts.empty_shots))}")
    for mark in result.marks:
        console.note(mark)
    if (found := result.refinement) is not None:
        tell_refinement(console, found, result.refined_out)


def tell_refinement(console: Console, found: Refinement, out: Path | None) -> None:
    """What registration changed, and where its cloud is."""
    if out is None:
        console.say("refinement: no two scans overlap enough to be registered")
        return
    before, after = found.disagreement_before_mm, found.disagreement_after_mm
    moved = max(found.shift_mm.values())
    console.say(f"refinement: scans disagree by {before:.4f} mm before and {after:.4f} mm after; the farthest moved {moved:.4f} mm; in {out}")
    if found.bounded:
        console.note(f"warning: shots {', '.join(map(str, found.bounded))} wanted to move farther than the calibration believes possible")


def _require_ply(out: Path) -> None:
    from drivers.errors import SettingsError

    if out.suffix.lower() not in {"", ".ply"}:
        raise SettingsError("a recording is made from a PLY cloud", where="--rrd", remedy="Let --out end in .ply.")
