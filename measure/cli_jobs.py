"""`spherecal jobs`: parts measured unattended, one job each, and what became of them."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_history import HistoryPlace
from measure.cli_run import EXIT_INTERRUPTED, EXIT_NOT_GOOD, AsJson, Debug, Quiet, command

if TYPE_CHECKING:
    from measure.console import Console
    from measure.jobs.model import Files, Recipe
    from measure.jobs.pool import Executor
    from measure.jobs.runner import Runner, RunSettings, Summary

_MOST_TOLD = 20
jobs = typer.Typer(help="Measure parts unattended, one job a part.", no_args_is_help=True, rich_markup_mode=None)


@jobs.command("run", short_help="Watch a folder and measure every part in it.")
def run_jobs(
    parts: Annotated[Path, typer.Argument(help="Folder with a folder for every part, or a text file that names them.")],
    calibration: Annotated[Path, typer.Option("--calibration", help="calibration.yaml, as `calibrate` writes it.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of results, journal and dead letters.")],
    once: Annotated[bool, typer.Option("--once", help="End when nothing is left to do.")] = False,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes.")] = 2,
    scheduler: Annotated[str | None, typer.Option("--scheduler", help="Dask scheduler on this computer instead: tcp://127.0.0.1:PORT.")] = None,
    cell: Annotated[Path | None, typer.Option("--cell", help="Cell file, for folders of scans and poses.")] = None,
    nominal: Annotated[Path | None, typer.Option("--nominal", help="Mesh of the part, mm: every cloud is inspected.")] = None,
    spec: Annotated[Path | None, typer.Option("--spec", help="inspection.yaml: features, alignment, tolerances.")] = None,
    correlation: Annotated[
        Path | None, typer.Option("--correlation", help="Offsets of `gauge correlation`: corrected values beside the raw.")
    ] = None,
    judge_corrected: Annotated[bool, typer.Option("--judge-corrected", help="Judge what the correlation names by the corrected value.")] = False,
    history: HistoryPlace = None,
    voxel: Annotated[float, typer.Option("--voxel", help="Edge of the voxels, mm.")] = 0.5,
    keep_edges: Annotated[bool, typer.Option("--keep-edges", help="Keep flying pixels.")] = False,
    memory: Annotated[float | None, typer.Option("--memory", min=1, help="MB for all jobs at work; 70 % of what is free if left out.")] = None,
    retries: Annotated[int, typer.Option("--retries", min=0, help="Further attempts after a failure that may pass.")] = 3,
    back_off: Annotated[float, typer.Option("--back-off", min=0, help="Seconds before the first of them, doubled each time.")] = 2.0,
    timeout: Annotated[float, typer.Option("--timeout", min=1, help="Seconds after which a job is ended.")] = 900.0,
    settle: Annotated[float, typer.Option("--settle", min=0, help="Seconds for which a folder must not change.")] = 5.0,
    poll: Annotated[float, typer.Option("--poll", min=0.05, help="Seconds between two looks at the folder.")] = 2.0,
    give_up_after: Annotated[float, typer.Option("--give-up-after", min=0, help="Hours for which an incomplete part is waited for.")] = 24.0,
    retry_dead: Annotated[bool, typer.Option("--retry-dead", help="Try dead letters again.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Measure every part of a folder or list, each once, until Ctrl-C or, with --once, until nothing is left to do.

    Exit code 3 where a part is given up or rejected.
    """
    with command(as_json, debug, quiet) as run:
        from measure.jobs.runner import RunSettings

        wanted = _Wanted(calibration, cell, nominal, spec, correlation, judge_corrected)
        recipe, files = _recipe(out, wanted, voxel, not keep_edges)
        settings = RunSettings(
            once=once,
            finite=not parts.is_dir(),
            retries=retries,
            back_off_s=back_off,
            settle_s=settle,
            poll_s=poll,
            give_up_after_s=give_up_after * 3600.0,
            memory_mb=memory,
            n_threads=1 if scheduler is not None else max(1, (os.cpu_count() or 1) // workers),
            history=_history(history, calibration),
            retry_dead=retry_dead,
        )
        summary = _worked(run.console, out, recipe, files, _lister(parts), settings, workers, scheduler, timeout)
        _tell(run.console, summary, out)
        run.finish(summary.to_json_dict())
        run.exit_code = EXIT_NOT_GOOD if summary.dead_letters or summary.rejected else 0
        if summary.interrupted:
            run.exit_code = EXIT_INTERRUPTED


@jobs.command("status", short_help="Tell what became of the parts; write throughput.html.")
def status(
    out: Annotated[Path, typer.Argument(help="Folder of results, as `jobs run -o` named it.")],
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Tell what became of the parts, whether or not a runner is at work, and write throughput.html."""
    with command(as_json, debug, quiet) as run:
        import datetime

        from measure.jobs.journal import is_running, read_state
        from measure.jobs.page import duration_text, throughput, write_page

        state = read_state(out)
        running = is_running(out)
        figures = throughput(state, datetime.datetime.now(datetime.UTC))
        page = write_page(out, state, is_running=running)
        dead = [{"job": r.id, "part": r.part, "category": r.category, "reason": r.reason} for r in state.jobs.values() if r.state == "dead"]
        rows: list[list[object]] = [
            ["measured", str(figures.n_done)],
            ["given up", str(figures.n_dead)],
            ["waiting", str(figures.n_waiting)],
            ["at work", str(figures.n_running)],
            ["not complete", str(figures.n_held)],
            ["in the last hour", str(figures.last_hour)],
            ["seconds a part, median", duration_text(figures.median_s)],
            ["oldest waiting", duration_text(figures.oldest_waiting_s)],
        ]
        run.console.table("", ["parts, a runner is at work" if running else "parts, no runner is at work", ""], rows)
        _tell_dead(run.console, dead)
        run.console.say(f"page: {page}")
        run.finish({**figures.to_json_dict(), "is_running": running, "dead_letters": dead, "out": page})


def _history(option: str | None, calibration: Path) -> str | None:
    """Its place, as workers elsewhere find it too."""
    from measure.history.database import is_url
    from measure.history.recording import place_of

    place = place_of(option, calibration)
    return place if place is None or is_url(place) else str(Path(place).absolute())


@dataclass(frozen=True, slots=True)
class _Wanted:
    """Files as the command names them."""

    calibration: Path
    cell: Path | None
    nominal: Path | None
    spec: Path | None
    correlation: Path | None
    judge_corrected: bool


def _recipe(out: Path, wanted: _Wanted, voxel_mm: float, clean_edges: bool) -> tuple[Recipe, Files]:
    """What is done with every part, its files copied beside the results.

    Raises:
        FileError: one of them is missing or broken, or the folder cannot be written.
        SettingsError: the voxel size is no positive number, a specification without a mesh, or a correlation without one.
    """
    from calibrate.result import Calibration
    from drivers.errors import SettingsError
    from measure.jobs.model import Files, Recipe
    from measure.jobs.outputs import keep_copy, prepare

    if not 0 < voxel_mm < float("inf"):
        raise SettingsError(f"voxel size {voxel_mm} mm is not a positive number", where="--voxel", remedy="Choose for example 0.5.")
    if wanted.spec is not None and wanted.nominal is None:
        raise SettingsError("a specification without a mesh", where="--spec", remedy="Name the mesh with --nominal.")
    if wanted.correlation is not None and wanted.spec is None:
        raise SettingsError("a correlation without tolerances", where="--correlation", remedy="Name what is judged with --spec.")
    if wanted.judge_corrected and wanted.correlation is None:
        raise SettingsError("--judge-corrected without --correlation", remedy="Name the correlation file.")
    loaded = Calibration.load(wanted.calibration)
    _check_readable(wanted)
    prepare(out)
    calibration_copy, _ = keep_copy(out, wanted.calibration)
    (cell_copy, cell_sha256), (mesh, mesh_sha256), (spec_copy, spec_sha256), (offsets, offsets_sha256) = (
        (None, None) if path is None else keep_copy(out, path) for path in (wanted.cell, wanted.nominal, wanted.spec, wanted.correlation)
    )
    recipe = Recipe(loaded.id, voxel_mm, clean_edges, cell_sha256, mesh_sha256, spec_sha256, offsets_sha256, wanted.judge_corrected)
    return recipe, Files(calibration_copy, cell_copy, mesh, spec_copy, offsets, wanted.judge_corrected)


def _check_readable(wanted: _Wanted) -> None:
    """See that the recipe's files are whole before a thousand jobs find out; FileError where one is not."""
    from acquire.cell import load_cell

    if wanted.cell is not None:
        load_cell(wanted.cell)
    if wanted.nominal is not None:
        from measure.inspecting.nominal import load_nominal

        load_nominal(wanted.nominal)
    if wanted.spec is not None:
        from measure.inspecting.spec import load_spec

        load_spec(wanted.spec)
    if wanted.correlation is not None:
        from measure.gauge.correlation import load_correlation

        load_correlation(wanted.correlation)


def _lister(parts: Path) -> Callable[[], Iterable[Path]]:
    """What lists the parts: a folder anew each time, a list as it is now.

    Raises:
        FileError: there is nothing of this name, or the list names nothing.
    """
    from drivers.errors import FileError
    from measure.jobs.parts import parts_in, parts_of_list

    if parts.is_dir():
        folder = parts.absolute()
        return lambda: parts_in(folder)
    if not parts.exists():
        raise FileError("no such folder or list", file=parts, remedy="Name the folder that holds a folder for every part.")
    listed = parts_of_list(parts.absolute())
    return lambda: listed


def _worked(
    console: Console,
    out: Path,
    recipe: Recipe,
    files: Files,
    list_parts: Callable[[], Iterable[Path]],
    settings: RunSettings,
    workers: int,
    scheduler: str | None,
    timeout_s: float,
) -> Summary:
    """Run until it is over, the workers let go afterwards."""
    from measure.jobs.runner import Runner

    recorder = _recorder(settings.history, files.calibration) if settings.history is not None and files.nominal is not None else None
    executor = _executor(workers, scheduler, timeout_s)
    try:
        runner = Runner(out, recipe, files, list_parts, executor, settings, recorder=recorder)
        with _stopped_by_signals(runner, console), console.progress("parts") as advance:

            def on_event(summary: Summary, n_left: int) -> None:
                n_over = summary.done + summary.failed
                advance(n_over, n_over + n_left)

            return runner.run(on_event)
    finally:
        executor.close()


def _recorder(history: str, calibration: Path) -> Callable[[Path], None]:
    from calibrate.result import Calibration
    from measure.jobs.inspection import record_inspection

    loaded = Calibration.load(calibration)
    return lambda folder: record_inspection(history, loaded, calibration, folder)


def _executor(workers: int, scheduler: str | None, timeout_s: float) -> Executor:
    from measure.jobs.work import load_program, measure_part

    if scheduler is not None:
        from measure.jobs.dask_pool import DaskPool

        return DaskPool(scheduler, measure_part, timeout_s=timeout_s)
    from measure.jobs.pool import LocalPool

    return LocalPool(workers, measure_part, on_start=load_program, timeout_s=timeout_s)


@contextmanager
def _stopped_by_signals(runner: Runner, console: Console) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the run after the jobs in flight, the second one at once."""

    def stop(_number: int, _frame: FrameType | None) -> None:
        console.note("stopping after the jobs at work; once more to stop at once")
        runner.stop()

    former = [(number, signal.signal(number, stop)) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        yield
    finally:
        for number, handler in former:
            signal.signal(number, handler)


def _tell(console: Console, summary: Summary, out: Path) -> None:
    """What a run came to, for a person."""
    counts = f"{summary.done} parts measured, {summary.failed} given up, {summary.skipped} left from earlier runs"
    console.say(f"{counts} ({summary.seconds:.1f} s), in {out}")
    _tell_dead(console, summary.dead_letters)
    for part in summary.waiting:
        console.say(f"  not complete: {part['source']}: {part['reason']}")
    if summary.marked:
        console.say(f"{summary.marked} results carry a warning (`marks` in their result.json)")


def _tell_dead(console: Console, letters: Sequence[Mapping[str, object]]) -> None:
    """A line for each part that was given up, the latest ones of many."""
    if len(letters) > _MOST_TOLD:
        console.say(f"  {len(letters)} parts are given up; the last {_MOST_TOLD} are:")
    for letter in letters[-_MOST_TOLD:]:
        console.say(f"  given up: {letter['part']}: {letter['reason']}")
