"""One process of a capture run: goes on with a session where there is one; told on stdout when it is about to move."""

from __future__ import annotations

import sys
from pathlib import Path

from acquire.cell import load_cell, robot_model_of
from acquire.events import Event, RunStarted
from acquire.plan import load_plan
from measure.running import capture_session


def main(cell_path: Path, plan_path: Path, out: Path) -> None:
    cell = load_cell(cell_path)

    def watch(event: Event) -> None:
        if isinstance(event, RunStarted):
            sys.stdout.write("started\n")
            sys.stdout.flush()

    capture_session(cell, load_plan(plan_path, cell, robot_model_of(cell)), out, watcher=watch, resume=out.exists())


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
