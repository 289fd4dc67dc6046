"""`spherecal new cell` and `spherecal doctor`: a cell file, and whether it, the robot and the camera are fit to work."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from measure.cli_run import EXIT_NOT_GOOD, AsJson, Debug, Quiet, command

SphereFlags = Annotated[list[str] | None, typer.Option("--sphere", metavar="NAME:DIAMETER:U", help="Certified sphere, mm, U with k = 2. Repeat.")]
LengthFlags = Annotated[list[str] | None, typer.Option("--length", metavar="A:B:LENGTH:U", help="Certified length between two, mm. Repeat.")]


def new_cell(
    out: Annotated[Path, typer.Option("--out", "-o", help="The file to write.")] = Path("cell.yaml"),
    name: Annotated[str | None, typer.Option(help="Name of the cell.")] = None,
    robot: Annotated[str | None, typer.Option(help="Robot driver, e.g. simulated.")] = None,
    model: Annotated[str | None, typer.Option(help="Robot model: shipped name or file; none: flange poses only.")] = None,
    camera: Annotated[str | None, typer.Option(help="Camera driver, e.g. simulated.")] = None,
    kind: Annotated[str, typer.Option(help="area or line_profile.")] = "area",
    sphere: SphereFlags = None,
    length: LengthFlags = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Write a cell file, by flags or, on a terminal, by questions."""
    with command(as_json, debug, quiet) as run:
        from acquire.cell import Cell
        from drivers.files.disk import write_text_atomic
        from drivers.files.schema import check
        from drivers.files.yaml import parse_yaml
        from measure.cell_text import CellAnswers, cell_text

        _require_new(out, force)
        ask = run.console.shows_results and sys.stdin.isatty() and sys.stdout.isatty()
        answers = CellAnswers(
            name=name or _asked(ask, "Name of the cell", "cell"),
            robot=robot or _asked(ask, "Robot driver", "simulated"),
            model=model or _asked(ask, "Robot model (shipped name, file, or none)", "none"),
            camera=camera or _asked(ask, "Camera driver", "simulated"),
            kind=kind,
            spheres=sphere or _asked_list(ask, "Sphere NAME:DIAMETER:U in mm (empty: no more)"),
            lengths=length or _asked_list(ask, "Length A:B:LENGTH:U in mm (empty: no more)"),
        )
        text = cell_text(answers)
        check(Cell, parse_yaml(text, file=out), file=str(out), text=text)  # what is written can be read
        write_text_atomic(out, text)
        run.console.say(f"{out} written. Fill in the drivers' settings, then: spherecal doctor {out} --offline")
        run.finish({"out": str(out)})


def new_truth(
    cell: Annotated[Path, typer.Argument(help="The cell file: robot model, spheres with their places, lengths, boxes.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The file to write.")] = Path("truth.yaml"),
    seed: Annotated[int, typer.Option(min=0, help="Another seed is another robot and another camera.")] = 0,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Draw what a simulated cell truly is, for `driver: simulated` and `simulate-controller --cell`."""
    with command(as_json, debug, quiet) as run:
        from acquire.cell import load_cell
        from drivers.simulated.truth_file import write_truth
        from measure.new_truth import truth_of_cell

        _require_new(out, force)
        truth = truth_of_cell(load_cell(cell), seed)
        write_truth(truth, out)
        run.console.say(f"{out} written: a robot and a camera with errors that nobody but the simulation may read")
        run.finish({"out": str(out), "spheres": list(truth.spheres)})


def _require_new(out: Path, force: bool) -> None:
    from drivers.errors import SettingsError

    if out.exists() and not force:
        raise SettingsError("exists already", file=out, remedy="Name another file with -o, or replace it with --force.")


def _asked(ask: bool, question: str, default: str) -> str:
    return str(typer.prompt(question, default=default, err=True)) if ask else default


def _asked_list(ask: bool, question: str) -> list[str]:
    answers: list[str] = []
    while ask and (answer := str(typer.prompt(question, default="", show_default=False, err=True))):
        answers.append(answer)
    return answers


def doctor(
    cell: Annotated[Path, typer.Argument(help="The cell file.")],
    offline: Annotated[bool, typer.Option("--offline", help="Files alone: open neither robot nor camera.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Examine a cell: its files, then robot and camera. Moves nothing. Exit code 3 when something must be mended."""
    with command(as_json, debug, quiet) as run:
        from acquire.cell import load_cell
        from measure.doctor import examine

        diagnosis = examine(load_cell(cell), offline=offline)
        for name, facts in (("robot", diagnosis.robot), ("camera", diagnosis.camera)):
            run.console.table(name, ["", ""], [[key, _short(value)] for key, value in facts.items()])
        for problem in diagnosis.problems:
            run.console.say(f"problem: {problem}")
        for hint in diagnosis.hints:
            run.console.say(f"hint: {hint}")
        run.console.say("nothing stands in the way" if not diagnosis.problems else f"{len(diagnosis.problems)} to mend")
        run.finish(diagnosis.to_json_dict())
        run.exit_code = EXIT_NOT_GOOD if diagnosis.problems else 0


def _short(value: object) -> str:
    import numpy as np

    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, np.ndarray):
        rows = np.atleast_2d(value)
        return "\n".join("  ".join(f"{number:.4g}" for number in row) for row in rows)
    return "-" if value is None else str(value)
