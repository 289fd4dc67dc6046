"""`spherecal history`, `activate`, `rollback` and `diff`: what a cell was calibrated with, and which calibration it uses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_run import AsJson, Debug, Quiet, command

if TYPE_CHECKING:
    from calibrate import Calibration
    from measure.console import Console
    from measure.history.displacement import DisplacementField
    from measure.history.rows import ActivationRow, ResultRow
    from measure.history.store import History

HistoryPlace = Annotated[
    str | None,
    typer.Option(
        "--history", metavar="PLACE", help="A file or a postgresql:// URL; none keeps nothing. Else $SPHERECAL_HISTORY, or history.sqlite beside."
    ),
]
CellFile = Annotated[Path, typer.Argument(help="The cell file.")]
_SHOWN = 12


def history(
    cell: CellFile,
    place: HistoryPlace = None,
    init: Annotated[bool, typer.Option("--init", help="Make a history where there is none.")] = False,
    check_every: Annotated[float | None, typer.Option("--check-every", metavar="HOURS", help="Rule: check this often; 0 for no rule.")] = None,
    table: Annotated[Path | None, typer.Option("--csv", help="Write the control chart of the checks as a table.")] = None,
    chart: Annotated[Path | None, typer.Option("--chart", help="Write the control chart as a page.")] = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """List a cell's calibrations, checks and verifications, and which calibration it uses."""
    with command(as_json, debug, quiet) as run:
        from acquire.cell import load_cell
        from drivers.files.disk import write_text_atomic
        from measure.history.chart import chart_csv, chart_page, points_of
        from measure.history.recording import software
        from measure.history.store import History

        name = load_cell(cell).name
        with History.open(_required_place(place, cell, init)) as opened:
            if check_every is not None:
                opened.set_check_every(name, check_every or None)
            rule = opened.check_every_h(name)
            points = points_of(opened.results(name, "check"))
            if table is not None:
                write_text_atomic(table, chart_csv(points))
            if chart is not None:
                write_text_atomic(chart, chart_page(name, points, opened.calibrations(name), opened.activations(name), rule, software()))
            run.finish({**_told_history(run.console, opened, name, rule), "csv": table, "chart": chart})


def _result_json(row: ResultRow) -> dict[str, object]:
    told: dict[str, object] = {
        "kind": row.kind,
        "calibration": row.calibration,
        "taken_utc": row.taken_utc,
        "verdict": row.verdict,
        "changed": row.changed,
    }
    return told | ({"remark": row.remark} if row.remark else {})


def _told_history(console: Console, opened: History, name: str, rule: float | None) -> dict[str, object]:
    calibrations, results, activations = opened.calibrations(name), opened.results(name), opened.activations(name)
    active = activations[-1].calibration if activations else None
    rows = [[c.created_utc[:16], c.id[:_SHOWN], c.verdict, "in use" if c.id == active else "", (c.parent or "")[:_SHOWN]] for c in calibrations]
    console.table(f"cell {name}: calibrations", ["made", "id", "verdict", "", "of"], rows)
    console.table(
        "results",
        ["taken", "what", "calibration", "verdict", "changed, remark"],
        [[r.taken_utc[:16], r.kind, r.calibration[:_SHOWN], r.verdict, r.changed or r.remark] for r in results],
    )
    rows = [[a.at_utc[:16], a.calibration[:_SHOWN], a.who, "forced: " + a.why if a.forced else a.why] for a in activations]
    console.table("put to use", ["at", "calibration", "who", "why"], rows)
    console.say("no rule for checks" if rule is None else f"a quick check is due every {rule:g} h")
    return {
        "cell": name,
        "history": opened.name,
        "active": active,
        "check_every_h": rule,
        "calibrations": [
            {"id": c.id, "created_utc": c.created_utc, "recorded_utc": c.recorded_utc, "verdict": c.verdict, "parent": c.parent, "file": c.file}
            for c in calibrations
        ],
        "results": [_result_json(r) for r in results],
        "activations": [_activation_json(a) for a in activations],
    }


def activate(
    calibration: Annotated[str, typer.Argument(help="A calibration file, or the id (or its beginning) of one in the history.")],
    place: HistoryPlace = None,
    force: Annotated[bool, typer.Option("--force", help="Take one that failed, knowingly.")] = False,
    why: Annotated[str, typer.Option("--why", help="A reason for the log.")] = "",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the calibration here too, for programs with a fixed path.")] = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Put a calibration to use in its cell. The log of this can only grow."""
    with command(as_json, debug, quiet) as run:
        from calibrate import Calibration
        from measure.history.store import History

        file = Path(calibration)
        beside = file if file.is_file() else Path("calibration.yaml")
        loaded = Calibration.load(file) if file.is_file() else None
        with History.open(_required_place(place, beside, init=loaded is not None and place is not None)) as opened:
            if loaded is not None:
                opened.add_calibration(loaded, file)
            row = opened.activate(loaded.id if loaded is not None else calibration, why=why, forced=force)
            _written(opened, row, out)
        _tell_activation(run.console, row, out)
        run.finish({**_activation_json(row), "out": out})


def rollback(
    cell: CellFile,
    place: HistoryPlace = None,
    why: Annotated[str, typer.Option("--why", help="A reason for the log.")] = "rollback",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the calibration here too.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Take one that failed, knowingly.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Go back to the calibration that the cell used before."""
    with command(as_json, debug, quiet) as run:
        from acquire.cell import load_cell
        from measure.history.store import History

        name = load_cell(cell).name
        with History.open(_required_place(place, cell, init=False)) as opened:
            row = opened.activate(opened.previous(name), why=why, forced=force)
            _written(opened, row, out)
        _tell_activation(run.console, row, out)
        run.finish({**_activation_json(row), "out": out})


def diff(
    first: Annotated[str, typer.Argument(help="A calibration file, or an id of the history.")],
    second: Annotated[str, typer.Argument(help="Another.")],
    place: HistoryPlace = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the field as a CSV table.")] = None,
    recording: Annotated[Path | None, typer.Option("--rrd", help="Write it as a Rerun recording.")] = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """How far two calibrations put the same points from each other, over the work volume."""
    with command(as_json, debug, quiet) as run:
        from drivers.files.disk import write_text_atomic
        from measure.history.displacement import displacement_field

        field = displacement_field(_loaded(first, place), _loaded(second, place))
        if out is not None:
            write_text_atomic(out, field.to_csv())
        if recording is not None:
            from measure.viewer_diff import write_difference

            factor = write_difference(recording, field)
            run.console.say(f"{recording} written; its arrows are {factor:.0f} times as long as the displacement")
        _tell_field(run.console, field)
        run.finish({**field.to_json_dict(), "out": out, "rrd": recording})


def _tell_field(console: Console, field: DisplacementField) -> None:
    told = field.to_json_dict()
    shift = " ".join(f"{value:+.3f}" for value in field.shift_mm)
    turn = " ".join(f"{1e3 * value:+.3f}" for value in field.turn_rad)
    console.table(
        f"from {field.first[:_SHOWN]} to {field.second[:_SHOWN]}, {field.region}, {len(field.size_mm)} points",
        ["", ""],
        [
            ["displacement, rms mm", told["rms_mm"]],
            ["largest, mm", told["max_mm"]],
            ["its U (k = 2, median), mm", told["expanded_uncertainty_mm"]],
            ["share within U", told["within_u"]],
            ["rigid part: shift x y z, mm", shift],
            ["rigid part: turn x y z, mrad", turn],
            ["what that leaves, rms mm", told["rest_rms_mm"]],
            ["what that leaves, largest mm", told["rest_max_mm"]],
            ["hand-eye moved by, mm", field.hand_eye_mm],
            ["hand-eye turned by, mrad", 1e3 * field.hand_eye_rad],
        ],
    )


def _loaded(file_or_id: str, place: str | None) -> Calibration:
    """A calibration of a file, or of the history."""
    from tempfile import TemporaryDirectory

    from calibrate import Calibration
    from drivers.files.disk import write_text_atomic
    from measure.history.store import History

    if Path(file_or_id).is_file():
        return Calibration.load(file_or_id)
    with History.open(_required_place(place, Path(file_or_id), init=False)) as opened, TemporaryDirectory() as folder:
        copy = Path(folder) / "calibration.yaml"
        write_text_atomic(copy, opened.yaml_of(file_or_id))
        return Calibration.load(copy)


def marked(console: Console, place: str | None, calibration: Calibration, taken_utc: str | None) -> list[str]:
    """Reasons of the history to doubt a measurement, told as they are found; for the key `marked` of its JSON."""
    from measure.history.marks import marks_of

    found = marks_of(place, calibration, taken_utc)
    for reason in found:
        console.note(f"marked: {reason}")
    return found


def _required_place(option: str | None, beside: Path, init: bool) -> str:
    from drivers.errors import SettingsError
    from measure.history.database import exists
    from measure.history.recording import default_place, place_of

    found = place_of(option, beside)
    if found is not None and (init or exists(found)):
        return found
    if init:
        return default_place(beside)
    where = found or default_place(beside)
    raise SettingsError("there is no history", file=where, remedy="`spherecal history CELL --init` makes one; --history names another place.")


def _written(opened: History, row: ActivationRow, out: Path | None) -> None:
    if out is not None:
        from drivers.files.disk import write_text_atomic

        write_text_atomic(out, opened.yaml_of(row.calibration))


def _tell_activation(console: Console, row: ActivationRow, out: Path | None) -> None:
    console.say(f"cell {row.cell} uses calibration {row.calibration[:_SHOWN]} from now on{', forced: it failed' if row.forced else ''}")
    if out is not None:
        console.say(f"written to {out}")


def _activation_json(row: ActivationRow) -> dict[str, object]:
    return {"cell": row.cell, "calibration": row.calibration, "at_utc": row.at_utc, "who": row.who, "why": row.why, "forced": row.forced}
