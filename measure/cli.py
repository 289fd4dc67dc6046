"""`spherecal`, the one command.

Each verb lives in a `cli_*` module beside this one and imports what it needs when it runs, so that `spherecal --help`
is instant.
"""

from __future__ import annotations

import sys

import typer

from measure.cli_run import run_app

app = typer.Typer(
    name="spherecal",
    help="Calibrate robot, hand-eye and 3D camera together on certified spheres, prove the accuracy, measure workpieces.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Entry point of the `spherecal` script."""
    sys.exit(run_app(app, sys.argv[1:]))


if __name__ == "__main__":
    main()
