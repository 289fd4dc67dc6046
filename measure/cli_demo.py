"""`spherecal demo`: the whole way, no hardware."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_run import AsJson, Debug, Quiet, command
from measure.console import viewer_command

if TYPE_CHECKING:
    from measure.console import Console
    from measure.demo import DemoResult

FORMER_DEMO = ("cell.yaml", "truth.yaml")
"""What tells a folder that a demo made from any other."""


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write.")] = Path("spherecal-demo"),
    force: Annotated[bool, typer.Option("--force", help="Replace a former demo.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Another seed is another simulated cell.")] = 0,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Run the whole way on a simulated cell: plan, capture, calibrate, verify, stitch, report. Under a minute."""
    with command(as_json, debug, quiet) as run:
        from measure.files import new_folder

        require_replaceable(out, force)
        with new_folder(out) as folder:
            from measure.demo import DemoSettings, run_demo

            result = run_demo(folder, DemoSettings(seed=seed), run.console.note)
        tell_demo(run.console, result, out)
        run.finish(result.to_json_dict(out), verdict=result.verification.verdict)


def require_replaceable(out: Path, force: bool) -> None:
    """See that nothing but an empty folder or, by force, a former demo is replaced.

    Raises:
        SettingsError: the folder holds something.
    """
    from drivers.errors import SettingsError

    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not (out.is_dir() and all((out / name).is_file() for name in FORMER_DEMO)):
        raise SettingsError("exists and is no former demo", file=out, remedy="Name another folder with --out.")
    if not force:
        raise SettingsError("holds a former demo", file=out, remedy="Replace it with --force, or name another folder with --out.")


def tell_demo(console: Console, result: DemoResult, out: Path) -> None:
    """The before/after table and where to look next."""
    from measure.cli_measure import comparison_rows

    check, calibration, stitched = result.verification, result.calibration, result.stitched
    console.say("")
    console.say("A simulated robot with a camera measured spheres that its calibration never saw:")
    console.table("", ["mm", "uncalibrated", "calibrated"], comparison_rows(check))
    console.say(f"calibration: {calibration.verdict} ({calibration.statistics.used} of {calibration.statistics.n_shots} shots)")
    console.say(f"verification: {check.verdict} ({check.used} of {check.n_shots} shots, limits of the cell file)")
    console.say(f"workpiece: {stitched.n_points} points stitched from {stitched.n_scans} scans")
    console.say("")
    console.say(f"Look at {out / 'report.html'} in a browser, {out / 'cloud.ply'} in any point cloud viewer,")
    console.say(f"and walk through every shot with: {viewer_command(out / 'run.rrd')}")
    console.say(f"Everything took {result.seconds:.0f} s. Each step again by hand: spherecal --help")
