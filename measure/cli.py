"""`spherecal`, the one command.

Each verb lives in a `cli_*` module beside this one and imports what it needs when it runs, so that `spherecal --help`
is instant.
"""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from measure.cli_abb import abb_program
from measure.cli_capture import capture
from measure.cli_cell import doctor, new_cell
from measure.cli_controller import simulate_controller
from measure.cli_demo import demo
from measure.cli_export import export
from measure.cli_import import import_session
from measure.cli_measure import stitch, verify
from measure.cli_plan import plan
from measure.cli_predict import predict
from measure.cli_preview import preview
from measure.cli_report import report, show
from measure.cli_run import run_app
from measure.cli_serve import serve_cell
from measure.cli_solve import calibrate, centres
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

app.command("demo")(demo)
app.add_typer(new, name="new")
app.command("doctor")(doctor)
app.command("plan")(plan)
app.command("preview")(preview)
app.command("predict")(predict)
app.command("capture")(capture)
app.command("teach")(teach)
app.command("import")(import_session)
app.command("centres")(centres)
app.command("calibrate")(calibrate)
app.command("verify")(verify)
app.command("stitch")(stitch)
app.command("report")(report)
app.command("show")(show)
app.command("study")(study)
app.command("export")(export)
app.command("simulate-controller")(simulate_controller)
app.command("abb-program")(abb_program)
app.command("serve-cell")(serve_cell)


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
