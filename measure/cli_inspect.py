"""`spherecal inspect`: a stitched cloud against its nominal, with a verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_history import HistoryPlace
from measure.cli_run import AsJson, Debug, Quiet, command

if TYPE_CHECKING:
    from calibrate import Calibration
    from drivers.files.session import Session
    from measure.console import Console
    from measure.inspecting.cloud import MeasuredCloud
    from measure.inspecting.result import Inspection
    from measure.part import Drawing, MeasuredPart


def inspect(
    cloud: Annotated[Path, typer.Argument(help="The stitched cloud, mm, robot base (PLY, PCD, NPZ); or a session, stitched on the way.")],
    nominal: Annotated[Path, typer.Argument(help="The part as drawn, mm (STL, PLY, OBJ).")],
    spec: Annotated[Path | None, typer.Option("--spec", help="inspection.yaml: features, alignment, tolerances.")] = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="The folder of results.")] = Path("inspection"),
    calibration: Annotated[Path | None, typer.Option("--calibration", help="What the cloud was stitched with: for uncertainties.")] = None,
    session: Annotated[Path | None, typer.Option("--session", help="What was stitched: goes with --calibration.")] = None,
    voxel: Annotated[float | None, typer.Option("--voxel", metavar="MM", help="Of a session: edge of the voxels [default: 0.5].")] = None,
    correlation: Annotated[
        Path | None, typer.Option("--correlation", help="Offsets of `gauge correlation`: corrected values beside the raw.")
    ] = None,
    judge_corrected: Annotated[bool, typer.Option("--judge-corrected", help="Judge what the correlation names by the corrected value.")] = False,
    no_map: Annotated[bool, typer.Option("--no-map", help="Verdict and tables alone, sooner: no deviations, no pictures.")] = False,
    no_recording: Annotated[bool, typer.Option("--no-recording", help="Leave the Rerun recording out.")] = False,
    history: HistoryPlace = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Compare a cloud with its nominal: deviations, features, tolerances. Exit code 3 when the verdict is reject."""
    with command(as_json, debug, quiet) as run:
        from measure.inspecting.inspection import with_deviations
        from measure.inspecting.outputs import require_replaceable, write_outputs

        require_replaceable(out)
        drawing = _drawing(nominal, spec, correlation, judge_corrected)
        sources = _sources(cloud, calibration, session, voxel)
        part = None
        if sources is not None and sources.stitches:
            part = _measured_part(run.console, sources, drawing, out, 0.5 if voxel is None else voxel)
            result, whole = part.inspection, part.cloud
        else:
            result, whole = _inspected(cloud, sources, drawing)
        tell_inspection(run.console, result)
        if not no_map:
            result = with_deviations(result, whole(), drawing.nominal, drawing.spec)
            tell_deviations(run.console, result)
        write_outputs(out, result, recording=not no_recording, add=None if part is None else part.write_cloud)
        run.console.say(f"{out / 'inspection.html'} written")
        stitched = {} if part is None else {"stitch": part.stitched.to_json_dict()}
        told = {**result.to_json_dict(), **stitched, "out": out}
        run.finish({**told, **_kept(run.console, sources, history, told)}, verdict=result.verdict)


@dataclass(frozen=True, slots=True, eq=False)
class _Sources:
    """What a cloud comes from."""

    calibration: Calibration
    file: Path
    """Of the calibration."""
    session: Session
    stitches: bool
    """Whether the cloud is still to be made of it."""


def _drawing(nominal: Path, spec: Path | None, correlation: Path | None, judge_corrected: bool) -> Drawing:
    """What the part is compared with.

    Raises:
        FileError: a file is missing or broken.
        SettingsError: --judge-corrected without --correlation.
    """
    from drivers.errors import SettingsError
    from measure.gauge.correlation import load_correlation
    from measure.inspecting.nominal import load_nominal
    from measure.inspecting.spec import InspectionSpec, load_spec
    from measure.part import Drawing

    if judge_corrected and correlation is None:
        raise SettingsError("--judge-corrected without --correlation", remedy="Name the correlation file.")
    offsets = None if correlation is None else load_correlation(correlation)
    wanted = InspectionSpec(format="spherecal-inspection/1") if spec is None else load_spec(spec)
    return Drawing(load_nominal(nominal), wanted, offsets, judge_corrected)


def _sources(cloud: Path, calibration: Path | None, session: Path | None, voxel_mm: float | None) -> _Sources | None:
    """What the command names of the cloud's origin; None where nothing.

    Raises:
        SettingsError: calibration and session do not go with what is to be inspected.
        FileError: one of them is missing or broken.
    """
    from drivers.errors import SettingsError

    stitches = cloud.is_dir()
    if stitches and session is not None:
        raise SettingsError("--session with a session to be stitched", remedy="Name the session once.")
    if stitches and calibration is None:
        raise SettingsError("a session without --calibration", file=cloud, remedy="Name the calibration that its scans are to be stitched with.")
    if voxel_mm is not None and not stitches:
        raise SettingsError("--voxel with a cloud that is stitched already", remedy="Name its session instead of the cloud.")
    if calibration is None and session is None:
        return None
    folder = cloud if stitches else session
    if calibration is None or folder is None:
        raise SettingsError("--calibration and --session belong together", remedy="Name what the cloud was stitched from, both of it.")
    from calibrate import Calibration
    from drivers.files.session import read_session

    return _Sources(Calibration.load(calibration), calibration, read_session(folder), stitches)


def _measured_part(console: Console, sources: _Sources, drawing: Drawing, out: Path, voxel_mm: float) -> MeasuredPart:
    """The session's cloud and its verdict, in memory."""
    from measure.cli_stitch import tell_stitched
    from measure.part import measure_part
    from measure.stitch import StitchSettings

    with console.progress("stitching") as advance:
        part = measure_part(
            sources.calibration,
            sources.session,
            drawing,
            out,
            StitchSettings(voxel_mm),
            spill_folder=out.absolute().parent,
            on_progress=advance,
        )
    tell_stitched(console, part.stitched)
    return part


def _inspected(cloud: Path, sources: _Sources | None, drawing: Drawing) -> tuple[Inspection, Callable[[], MeasuredCloud]]:
    """The verdict on a cloud that somebody stitched, and what gives that cloud.

    Raises:
        SettingsError: another calibration than the cloud's.
    """
    from drivers.errors import SettingsError
    from measure.inspecting.cloud import load_cloud
    from measure.inspecting.inspection import inspect_cloud
    from measure.inspecting.views import field_of, views_of

    measured = load_cloud(cloud)
    if sources is not None and measured.calibration_id not in {None, sources.calibration.id}:
        raise SettingsError(
            f"is not the calibration {str(measured.calibration_id)[:12]} that the cloud was stitched with",
            file=sources.file,
            remedy="Name that one.",
        )
    field = None if sources is None else field_of(sources.calibration, views_of(sources.calibration, sources.session))
    found = inspect_cloud(
        measured,
        drawing.nominal,
        drawing.spec,
        field_source=field,
        with_map=False,
        correlation=drawing.correlation,
        judge_corrected=drawing.judge_corrected,
    )
    return found, lambda: measured


def _kept(console: Console, sources: _Sources | None, history: str | None, told: Mapping[str, object]) -> dict[str, object]:
    """What the history says of the calibration at the time of the session, and whether the inspection was kept there.

    Without calibration and session nothing is asked and nothing kept: a result hangs on the calibration that it was made with.
    """
    if sources is None:
        return {"marked": [], "history": None}
    from measure.cli_history import marked
    from measure.history.recording import last_taken_utc, place_of, record_result

    place, taken_utc = place_of(history, sources.file), last_taken_utc([sources.session])
    doubts = marked(console, place, sources.calibration, taken_utc)
    content = {**told, "out": str(told["out"]), "marked": doubts}
    kept = record_result(place, "inspection", sources.calibration, sources.file, content, console.note, taken_utc=taken_utc)
    return {"marked": doubts, "history": kept}


def tell_inspection(console: Console, result: Inspection) -> None:
    """Features and tolerances, verdict and reasons, for a person."""
    from measure.cli_measure import tell_verdict

    rows = [[c.name, c.measured, c.expanded_uncertainty, f"{c.lower:.3f} {c.upper:.3f}", c.verdict.replace("_", " ")] for c in result.checks]
    if rows:
        console.table("tolerances, mm and degrees", ["what", "measured", "U (k=2)", "least, most", "verdict"], rows)
    corrected = [[c.name, c.measured, c.corrected.value_mm, c.corrected.expanded_uncertainty_mm] for c in result.checks if c.corrected is not None]
    if corrected:
        console.table("by the correlation, mm", ["what", "measured", "corrected", "U (k=2)"], corrected)
    for feature in result.features:
        if feature.problem is not None:
            console.say(f"{feature.name}: {feature.problem}")
    for note in result.notes:
        console.say(note)
    tell_verdict(console, result.verdict, result.reasons)


def tell_deviations(console: Console, result: Inspection) -> None:
    """The map in two lines, for a person."""
    if result.deviations is not None:
        s = result.deviations.statistics()
        console.say(f"deviations of {len(result.deviations.signed_mm)} points, mm: mean {s['mean_mm']:+.3f}, rms {s['rms_mm']:.3f},")
        console.say(f"  98 % between {s['q01_mm']:+.3f} and {s['q99_mm']:+.3f}")
