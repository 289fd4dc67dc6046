"""`spherecal gauge ...`: studies of the gauge that a plant asks for, from a table of measured values."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_run import AsJson, Debug, Quiet, Run, command

if TYPE_CHECKING:
    from measure.gauge.studies import StudyResult
    from measure.gauge.table import Measured

gauge = typer.Typer(help="Studies: repeats, R&R, approach, drift, correlation.", no_args_is_help=True, rich_markup_mode=None)

Table = Annotated[Path, typer.Argument(help="Values as CSV: feature, value_mm, and what they were measured under.")]
Page = Annotated[Path | None, typer.Option("--page", help="Write the study as one HTML page.")]


@gauge.command("collect", short_help="Make the table from results of verify and inspect.")
def collect(
    results: Annotated[list[Path], typer.Argument(help="Files with what `verify --json` or `inspect --json` printed, in the order of the runs.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The table to write; rows are added to one that is there.")] = Path("values.csv"),
    part: Annotated[str, typer.Option(help="Part of all these runs.")] = "",
    operator: Annotated[str, typer.Option(help="Operator or set-up of all these runs.")] = "",
    direction: Annotated[str, typer.Option(help="Direction of approach of all these runs.")] = "",
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Make the table of a study from the results of many runs."""
    with command(as_json, debug, quiet) as run:
        from measure.gauge.collect import rows_of_results
        from measure.gauge.table import read_table, write_table

        added = rows_of_results(results, part=part, operator=operator, direction=direction)
        rows = [*(read_table(out) if out.exists() else []), *added]
        write_table(rows, out)
        run.console.say(f"{len(added)} values of {len(results)} runs added, {len(rows)} in {out}")
        run.finish({"n_added": len(added), "n_values": len(rows), "out": str(out)})


@gauge.command("repeatability", short_help="Repeats of one part: Cg and Cgk.")
def repeatability(
    table: Table,
    share: Annotated[float, typer.Option(min=0.01, max=1.0, help="Of the tolerance that the gauge may take.")] = 0.2,
    spread: Annotated[float, typer.Option(min=1.0, max=10.0, help="Standard deviations that are the gauge's whole spread.")] = 6.0,
    limit: Annotated[float, typer.Option(min=0.1, max=10.0, help="Cg and Cgk from which it is capable.")] = 1.33,
    page: Page = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Judge the gauge by repeats of one part, 30 as a rule. Exit code 3 when it is not capable."""
    with command(as_json, debug, quiet) as run:
        from measure.gauge.repeatability import RepeatSettings
        from measure.gauge.studies import repeat_study

        settings = RepeatSettings(share, spread, limit)
        _tell(run, table, page, lambda rows: repeat_study(rows, settings))


@gauge.command("rr", short_help="Parts x operators x trials: gauge R&R.")
def rr(table: Table, page: Page = None, as_json: AsJson = False, debug: Debug = False, quiet: Quiet = False) -> None:
    """Judge the gauge by parts, operators and trials (10 x 3 x 3). Exit code 3 when it is not capable."""
    with command(as_json, debug, quiet) as run:
        from measure.gauge.studies import rr_study

        _tell(run, table, page, rr_study)


@gauge.command("approach", short_help="The same from both sides: reversal.")
def approach(table: Table, page: Page = None, as_json: AsJson = False, debug: Debug = False, quiet: Quiet = False) -> None:
    """Compare features measured from two directions of approach."""
    with command(as_json, debug, quiet) as run:
        from measure.gauge.studies import approach_study

        _tell(run, table, page, approach_study)


@gauge.command("drift", short_help="Cold to warm: span and when it settles.")
def drift(
    table: Table,
    limit_mm: Annotated[float, typer.Option(min=1e-4, help="Settled: when less than this is still to come.")] = 0.01,
    page: Page = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Judge a run from cold to warm."""
    with command(as_json, debug, quiet) as run:
        from measure.gauge.studies import drift_study

        _tell(run, table, page, lambda rows: drift_study(rows, limit_mm))


@gauge.command("correlation", short_help="Offsets to a reference gauge, as a file.")
def correlation(
    table: Table,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The correlation to write; one that is there becomes its next version.")] = None,
    note: Annotated[str, typer.Option(help="Kept in the file: who, which gauge, why.")] = "",
    page: Page = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Offsets of features to a reference gauge (a CMM), from parts measured by both."""
    with command(as_json, debug, quiet) as run:
        from measure.gauge.correlation import Correlation, save_correlation
        from measure.gauge.studies import correlation_study
        from measure.gauge.table import read_table

        offsets, study = correlation_study(read_table(table))
        told = _told(run, study, table, page)
        if out is not None:
            created = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
            saved = save_correlation(Correlation(offsets, created_utc=created, note=note), out)
            run.console.say(f"version {saved.version} in {out}")
            told |= {"out": str(out), "version": saved.version, "id": saved.id}
        run.finish(told)


@gauge.command("dfq", short_help="The table as a Q-DAS transfer file.")
def dfq(
    table: Table,
    out: Annotated[Path, typer.Option("--out", "-o", help="The DFQ file to write.")],
    part_number: Annotated[str, typer.Option("--part-number", help="K1001.")],
    part_name: Annotated[str, typer.Option("--part-name", help="K1002.")] = "",
    gauge_name: Annotated[str, typer.Option("--gauge", help="K2402 of every characteristic.")] = "spherecal",
    machine: Annotated[str, typer.Option("--machine", help="K1010: where it was measured.")] = "",
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Write the values as a Q-DAS ASCII transfer file."""
    with command(as_json, debug, quiet) as run:
        from measure.gauge.dfq import dfq_text, write_dfq
        from measure.gauge.table import read_table

        rows = read_table(table)
        write_dfq(dfq_text(rows, part_number=part_number, part_name=part_name, gauge=gauge_name, machine=machine), out)
        run.console.say(f"{len(rows)} values in {out}")
        run.finish({"n_values": len(rows), "out": str(out)})


def _tell(run: Run, table: Path, page: Path | None, study: Callable[[list[Measured]], StudyResult]) -> None:
    from measure.gauge.table import read_table

    result = study(read_table(table))
    run.finish(_told(run, result, table, page))
    if result.capable is False:
        run.exit_code = 3


def _told(run: Run, result: StudyResult, table: Path, page: Path | None) -> dict[str, object]:
    from drivers.files.disk import read_bytes, sha256_hex
    from measure.gauge.page import text_of, write_page

    study = result.page
    run.console.table(study.title, list(study.columns), [[text_of(cell) for cell in row] for row in study.rows])
    run.console.say(study.headline)
    digest = sha256_hex(read_bytes(table))
    if page is not None:
        write_page(study, page, source=f"{table.name} (sha256 {digest[:16]})")
        run.console.say(f"page: {page}")
    return {"features": result.figures, "capable": result.capable, "table_sha256": digest, "page": None if page is None else str(page)}
