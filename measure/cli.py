"""`spherecal`, the one command.

Each verb lives in a `cli_*` module beside this one and imports what it needs when it runs, so that `spherecal --help`
is instant.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Annotated

import typer

from measure.cli_abb import abb_program
from measure.cli_camera_check import camera_check
from measure.cli_capture import capture
from measure.cli_cell import doctor, new_cell, new_truth
from measure.cli_check import check
from measure.cli_controller import simulate_controller
from measure.cli_demo import demo
from measure.cli_export import export
from measure.cli_gauge import gauge
from measure.cli_history import activate, diff, history, rollback
from measure.cli_import import import_session
from measure.cli_inspect import inspect
from measure.cli_jobs import jobs
from measure.cli_measure import verify
from measure.cli_plan import plan
from measure.cli_predict import predict
from measure.cli_preview import preview
from measure.cli_report import report, show
from measure.cli_run import run_app
from measure.cli_serve import serve_cell
from measure.cli_solve import calibrate, centres
from measure.cli_stitch import stitch
from measure.cli_study import study
from measure.cli_teach import teach
from measure.console import Console

app = typer.Typer(
    name="spherecal",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

new = typer.Typer(help="Write a new file to start from.", no_args_is_help=True, rich_markup_mode=None)
new.command("cell")(new_cell)
new.command("truth")(new_truth)

VERBS: tuple[tuple[str, Callable[..., None], str], ...] = (
    ("demo", demo, "Go the whole way on a simulated cell."),
    ("doctor", doctor, "Examine a cell: its files, then robot and camera."),
    ("plan", plan, "Plan feasible poses and write them as a plan."),
    ("preview", preview, "Show a plan's poses and the ways between them."),
    ("predict", predict, "Compare artefacts and numbers of shots beforehand."),
    ("capture", capture, "Drive the robot through a plan, record a session."),
    ("teach", teach, "Lead the arm by hand, or jog it, and keep poses."),
    ("import", import_session, "Make a session from others' poses and clouds."),
    ("centres", centres, "Find the sphere's centre in every shot."),
    ("camera-check", camera_check, "See a sphere over the camera's volume, uncalibrated."),
    ("calibrate", calibrate, "Calibrate robot, hand-eye and camera together."),
    ("verify", verify, "Prove a calibration on shots that it never saw."),
    ("check", check, "Tell from a few shots whether something changed, and what."),
    ("history", history, "List a cell's calibrations, checks and verifications."),
    ("activate", activate, "Put a calibration to use in its cell."),
    ("rollback", rollback, "Go back to the calibration that was used before."),
    ("diff", diff, "Compare two calibrations over the work volume."),
    ("stitch", stitch, "Put a session's scans into one cloud in the base."),
    ("inspect", inspect, "Compare a cloud with its nominal: tolerances, verdict."),
    ("report", report, "Write report.html: the calibration and its proof."),
    ("show", show, "Write a Rerun recording of sessions, before and after."),
    ("study", study, "Run the paper's simulation: its tables and figures."),
    ("export", export, "Write hand-eye, robot or targets for other programs."),
    ("simulate-controller", simulate_controller, "Serve a simulated robot controller."),
    ("abb-program", abb_program, "Write the RAPID program for an ABB IRC5."),
    ("serve-cell", serve_cell, "Take a picture when the robot's own program asks."),
)
"""Name, function, and what the list of commands says of it: whole where longer helps would be cut off."""

app.add_typer(new, name="new")
app.add_typer(gauge, name="gauge", short_help="Studies of repeats, R&R, approach, drift.")
app.add_typer(jobs, name="jobs", short_help="Measure parts unattended, one job a part.")
for name, verb, summary in VERBS:
    app.command(name, short_help=summary)(verb)


@app.callback(invoke_without_command=True)
def common(version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False) -> None:
    """Calibrate robot, hand-eye and 3D camera together on certified spheres, prove the accuracy, measure workpieces."""
    if version:
        from importlib.metadata import version as installed_version

        Console().say(f"spherecal {installed_version('spherecal')}")
        raise typer.Exit


def main() -> None:
    """Entry point of the `spherecal` script."""
    # before numpy is imported: on matrices of some ten rows more BLAS threads only wait for each other (73 s against 6 s
    # for the demo's calibration on two busy cores), and one thread gives the same last digit on every machine
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(run_app(app, sys.argv[1:]))


if __name__ == "__main__":
    main()
