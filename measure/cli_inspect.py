"""`spherecal inspect`: a stitched cloud against its nominal, with a verdict."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_history import HistoryPlace
from measure.cli_run import AsJson, Debug, Quiet, command

if TYPE_CHECKING:
    from drivers.kinematics.se3 import FloatArray
    from measure.console import Console
    from measure.inspecting.fitting import Response
    from measure.inspecting.inspection import FieldSource
    from measure.inspecting.result import Inspection
    from measure.inspecting.uncertainty import FieldError


def inspect(
    cloud: Annotated[Path, typer.Argument(help="The stitched cloud, mm, robot base (PLY, PCD, NPZ).")],
    nominal: Annotated[Path, typer.Argument(help="The part as drawn, mm (STL, PLY, OBJ).")],
    spec: Annotated[Path | None, typer.Option("--spec", help="inspection.yaml: features, alignment, tolerances.")] = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="The folder of results.")] = Path("inspection"),
    calibration: Annotated[Path | None, typer.Option("--calibration", help="What the cloud was stitched with: for uncertainties.")] = None,
    session: Annotated[Path | None, typer.Option("--session", help="What was stitched: goes with --calibration.")] = None,
    correlation: Annotated[
        Path | None, typer.Option("--correlation", help="Offsets of `gauge correlation`: corrected values beside the raw.")
    ] = None,
    judge_corrected: Annotated[bool, typer.Option("--judge-corrected", help="Judge what the correlation names by the corrected value.")] = False,
    no_recording: Annotated[bool, typer.Option("--no-recording", help="Leave the Rerun recording out.")] = False,
    history: HistoryPlace = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Compare a cloud with its nominal: deviations, features, tolerances. Exit code 3 when the verdict is reject."""
    with command(as_json, debug, quiet) as run:
        from drivers.errors import SettingsError
        from measure.gauge.correlation import load_correlation
        from measure.inspecting.cloud import load_cloud
        from measure.inspecting.inspection import inspect_cloud
        from measure.inspecting.nominal import load_nominal
        from measure.inspecting.outputs import require_replaceable, write_outputs
        from measure.inspecting.spec import InspectionSpec, load_spec

        require_replaceable(out)
        if judge_corrected and correlation is None:
            raise SettingsError("--judge-corrected without --correlation", remedy="Name the correlation file.")
        offsets = None if correlation is None else load_correlation(correlation)
        wanted = InspectionSpec(format="spherecal-inspection/1") if spec is None else load_spec(spec)
        drawn, measured = load_nominal(nominal), load_cloud(cloud)
        source = _field_source(calibration, session, measured.calibration_id)
        result = inspect_cloud(measured, drawn, wanted, field_source=source, correlation=offsets, judge_corrected=judge_corrected)
        tell_inspection(run.console, result)
        write_outputs(out, result, recording=not no_recording)
        run.console.say(f"{out / 'inspection.html'} written")
        doubts = _doubts(run.console, calibration, session, history)
        run.finish({**result.to_json_dict(), "marked": doubts, "out": out}, verdict=result.verdict)


def _doubts(console: Console, calibration: Path | None, session: Path | None, history: str | None) -> list[str]:
    """What the history says of the calibration at the time of the session; nothing where they are not named."""
    if calibration is None or session is None:
        return []
    from calibrate import Calibration
    from drivers.files.session import read_session
    from measure.cli_history import marked
    from measure.history.recording import last_taken_utc, place_of

    return marked(console, place_of(history, calibration), Calibration.load(calibration), last_taken_utc([read_session(session)]))


def tell_inspection(console: Console, result: Inspection) -> None:
    """Deviations, features and tolerances, verdict and reasons, for a person."""
    from measure.cli_measure import tell_verdict

    if result.deviations is not None:
        s = result.deviations.statistics()
        console.say(f"deviations of {len(result.deviations.signed_mm)} points, mm: mean {s['mean_mm']:+.3f}, rms {s['rms_mm']:.3f}, ")
        console.say(f"  98 % between {s['q01_mm']:+.3f} and {s['q99_mm']:+.3f}")
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


def _field_source(calibration: Path | None, session: Path | None, calibration_id: str | None) -> FieldSource | None:
    """What calibration and session tell of the cloud's errors; None where they are not named.

    Raises:
        SettingsError: one without the other, or another calibration than the cloud's.
    """
    from drivers.errors import SettingsError

    if calibration is None and session is None:
        return None
    if calibration is None or session is None:
        raise SettingsError("--calibration and --session belong together", remedy="Name what the cloud was stitched from, both of it.")
    from calibrate import Calibration
    from drivers.files.session import read_session
    from measure.inspecting.views import seen_field, views_of

    loaded = Calibration.load(calibration)
    if calibration_id is not None and calibration_id != loaded.id:
        raise SettingsError(
            f"is not the calibration {calibration_id[:12]} that the cloud was stitched with", file=calibration, remedy="Name that one."
        )
    views = views_of(loaded, read_session(session))

    def source(responses: Sequence[Response], part_from_base: FloatArray) -> FieldError:
        return seen_field(loaded, views, responses, part_from_base)

    return source
