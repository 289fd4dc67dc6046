"""`spherecal`, the one command.

Each verb lives in a `cli_*` module beside this one and imports what it needs when it runs, so that `spherecal --help`
is instant.
"""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from measure.cli_cell import doctor, new_cell
from measure.cli_plan import plan
from measure.cli_run import run_app
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

app.add_typer(new, name="new")
app.command("doctor")(doctor)
app.command("plan")(plan)


@app.callback(invoke_without_command=True)
def common(version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False) -> None:
    """Calibrate robot, hand-eye and 3D camera together on certified spheres, prove the accuracy, measure workpieces."""
    if version:
        from importlib.metadata import version as installed_version

        Console().say(f"spherecal {installed_version('spherecal')}")
        raise typer.Exit


def main() -> None:
    """Entry point of the `spherecal` script."""
    sys.exit(run_app(app, sys.argv[1:]))


if __name__ == "__main__":
    main()
