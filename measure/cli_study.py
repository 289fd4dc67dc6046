"""`spherecal study`: the paper's simulation run again, its figures beside ours."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_run import AsJson, Debug, Quiet, command

if TYPE_CHECKING:
    from calibrate.study import Study
    from measure.console import Console


def study(
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write.")] = Path("spherecal-study"),
    seed: Annotated[int, typer.Option(min=0, help="Another seed draws other poses and other noise.")] = 2023,
    quick: Annotated[bool, typer.Option("--quick", help="Coarser, in half a minute.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Run the paper's simulation: its tables and figures, computed with its solver and with ours, beside the printed ones."""
    with command(as_json, debug, quiet) as run:
        from dataclasses import replace

        from measure.files import new_folder

        require_replaceable(out)
        with new_folder(out) as folder:
            from calibrate.study import QUICK, StudySettings, run_study
            from measure.study_page import PAGE, tables_as_data, write_study

            settings = replace(QUICK if quick else StudySettings(), seed=seed)
            with run.console.progress("simulating") as advance:
                done = run_study(settings, progress=advance)
            write_study(done, folder)
        tell_study(run.console, done)
        run.console.say(f"written to {out}; look at {out / PAGE} in a browser")
        run.finish({"out": out, "seed": seed, "quick": quick, "seconds": done.seconds, "tables": tables_as_data(done)})


def require_replaceable(out: Path) -> None:
    """See that nothing but an empty folder or a former study is replaced: a study comes back from its seed.

    Raises:
        SettingsError: the folder holds something else.
    """
    from drivers.errors import SettingsError
    from measure.study_page import is_study

    if not out.exists() or (out.is_dir() and (is_study(out) or not any(out.iterdir()))):
        return
    raise SettingsError("exists and is no former study", file=out, remedy="Name another folder with --out.")


def tell_study(console: Console, study: Study) -> None:
    """Table 3 and Table 5, for a person."""
    from measure.study_page import headline

    for name, title, columns in (
        ("table3", "Table 3, simulated centres (mm)", ("method", "paper_e_mean_mm", "e_mean_mm", "paper_std_mm", "std_mm", "rms_about_mean_mm")),
        ("table5", "Table 5, sphere on a slide (mm)", ("method", "paper_d_mean_mm", "d_mean_mm", "paper_d_max_mm", "d_max_mm")),
        ("table3_clouds", "on clouds (mm)", ("method", "rms_about_mean_mm", "length_rms_mm", "length_max_mm")),
    ):
        table = study.table(name)
        heads = ["method", *(column.removesuffix("_mm").replace("_", " ") for column in columns[1:])]
        console.table(title, heads, [[row[table.columns.index(column)] for column in columns] for row in table.rows])
    console.say(headline(study))
