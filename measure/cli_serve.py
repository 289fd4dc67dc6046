"""`spherecal serve-cell`: the controller's own program owns the motion and asks for pictures."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from measure.cli_history import HistoryPlace
from measure.cli_run import EXIT_INTERRUPTED, EXIT_NOT_GOOD, AsJson, Debug, Quiet, command, stopped_by_signals

if TYPE_CHECKING:
    from acquire.cell import Cell
    from acquire.plan import Plan
    from acquire.session import SessionWriter
    from calibrate.result import Calibration
    from measure.part import Drawing
    from measure.serve import Job, Orders

Purpose = Literal["calibration", "verification", "workpiece"]


def serve_cell(
    cell: Annotated[Path, typer.Argument(help="The cell file; its camera takes the pictures, its robot is not touched.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The session folder to write.")],
    plan: Annotated[Path | None, typer.Option(help="A plan: trigger 1 is its first pose.")] = None,
    sphere: Annotated[str | None, typer.Option(help="Without a plan: the sphere in every picture; none: a workpiece.")] = None,
    purpose: Annotated[Purpose | None, typer.Option(help="Of the session. [default: the plan's, else workpiece or calibration]")] = None,
    host: Annotated[str, typer.Option(help="Address of this computer to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.", min=0, max=65535)] = 5005,
    serial_port: Annotated[str | None, typer.Option(help="A serial port instead of a socket.")] = None,
    baud: Annotated[int, typer.Option(help="Speed of the serial line.", min=9600, max=115200)] = 38400,
    count: Annotated[int | None, typer.Option(help="End after so many good pictures; with --nominal: after so many parts.", min=1)] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a session.")] = False,
    nominal: Annotated[Path | None, typer.Option(help="Mesh of the part, mm: RESULT 0 tells OK or NG of every part.")] = None,
    spec: Annotated[Path | None, typer.Option("--spec", help="With --nominal: inspection.yaml, what OK means.")] = None,
    calibration: Annotated[Path | None, typer.Option("--calibration", help="With --nominal: calibration.yaml.")] = None,
    results: Annotated[Path | None, typer.Option("--results", help="With --nominal: folder of results. [default: OUT-results]")] = None,
    voxel: Annotated[float, typer.Option("--voxel", metavar="MM", help="With --nominal: edge of the voxels.")] = 0.5,
    history: HistoryPlace = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Take a picture when the robot's own program asks (TRIG), keep it, and tell OK or NG. Ctrl-C ends it.

    With --nominal, --spec and --calibration parts are inspected: the pictures are fused as they come, RESULT 0 tells OK or NG of the part.
    """
    with command(as_json, debug, quiet) as run, stopped_by_signals():
        from acquire.cell import devices_of, load_cell, robot_model_of
        from acquire.plan import load_plan
        from measure.history.recording import place_of
        from measure.serve import CellDesk, CellWorker, Orders
        from measure.serve_line import LineServer
        from measure.serve_part import PartLine, PartPlaces
        from measure.stitch import StitchSettings

        loaded = load_cell(cell)
        model = robot_model_of(loaded)
        planned = None if plan is None else load_plan(plan, loaded, model)
        orders = Orders(() if planned is None else planned.poses, _checked_sphere(loaded, planned, sphere))
        inspected = _inspected(nominal, spec, calibration, sphere, resume)
        desk, interrupted = CellDesk(judges_parts=inspected is not None), False
        camera = devices_of(loaded).camera
        with ExitStack() as stack:
            stack.callback(camera.close)
            told = camera.open().identity()
            begin = partial(_begin, loaded, planned, purpose or _purpose(planned, sphere), told)
            writer, parts = None, None
            if inspected is None:
                writer = stack.enter_context(_session(loaded, begin, out, told, resume))
            else:
                places = PartPlaces(out, results or out.with_name(f"{out.name}-results"), inspected.file, place_of(history, inspected.file))
                line = PartLine(inspected.calibration, inspected.drawing, places, begin, run.console.note, StitchSettings(voxel))
                parts = stack.enter_context(line)
                parts.warm_up()

            def tell(job: Job) -> None:
                run.console.note(_line(job, orders))

            worker = CellWorker(loaded, model, camera, writer, orders, tell, loaded.motion.frames, parts=parts, told=told)
            server = LineServer(desk)
            if serial_port is None:
                at = stack.enter_context(server.over_tcp(host, port))
                run.console.note(f"waiting for the controller's program at {host}:{at}. Ctrl-C ends it")
            else:
                stack.enter_context(server.over_serial(serial_port, baud))
                run.console.note(f"waiting for the controller's program on {serial_port}. Ctrl-C ends it")
            try:
                worker.work(desk.waiting, count)
            except KeyboardInterrupt:
                interrupted = True
        n_ok, n_bad = worker.counts["OK"], worker.counts["NG"]
        run.console.say(f"{n_ok} shots in {out}, {n_bad} not good")
        judged = {} if parts is None else {"parts": dict(parts.counts), "results": parts.places.results}
        run.finish({"n_shots": n_ok, "n_failed": n_bad, "state": "stopped" if interrupted else "complete", "out": out, **judged})
        run.exit_code = EXIT_INTERRUPTED if interrupted else 0 if n_ok else EXIT_NOT_GOOD


def _line(job: Job, orders: Orders) -> str:
    why = f": {job.reason}" if job.reason else ""
    return f"trigger {job.id} ({orders.pose_id(job)}) {job.state}{why}"[:80]


def _purpose(plan: Plan | None, sphere: str | None) -> str:
    return plan.purpose if plan is not None else "workpiece" if sphere is None else "calibration"


def _checked_sphere(cell: Cell, plan: Plan | None, sphere: str | None) -> str | None:
    from drivers.errors import SettingsError

    if plan is not None and sphere is not None:
        raise SettingsError("a plan names its spheres itself", where="--sphere", remedy="Leave out --sphere or --plan.")
    if sphere is not None and sphere not in cell.spheres:
        raise SettingsError(f"the cell has no sphere {sphere!r}", where="--sphere", remedy=f"Choose one of {', '.join(cell.spheres) or 'none'}.")
    return sphere


@dataclass(frozen=True, slots=True)
class _Inspected:
    """What parts are measured with and compared with."""

    calibration: Calibration
    file: Path
    drawing: Drawing


def _inspected(nominal: Path | None, spec: Path | None, calibration: Path | None, sphere: str | None, resume: bool) -> _Inspected | None:
    """What the command says of an inspection; None where it wants none.

    Raises:
        SettingsError: half of it is missing, or it does not go with the other options.
        FileError: a file is missing or broken.
    """
    from drivers.errors import SettingsError

    given = {"--nominal": nominal, "--spec": spec, "--calibration": calibration}
    if all(value is None for value in given.values()):
        return None
    missing = [name for name, value in given.items() if value is None]
    if nominal is None or spec is None or calibration is None:
        raise SettingsError(f"an inspection without {' and '.join(missing)}", remedy="Name mesh, tolerances and calibration, or none of them.")
    if resume or sphere is not None:
        what = "--resume" if resume else "--sphere"
        raise SettingsError(f"{what} with an inspection", where=what, remedy="Leave it out: every start begins a new part, and parts are no spheres.")
    from calibrate.result import Calibration
    from measure.inspecting.nominal import load_nominal
    from measure.inspecting.spec import load_spec
    from measure.part import Drawing

    return _Inspected(Calibration.load(calibration), calibration, Drawing(load_nominal(nominal), load_spec(spec)))


def _begin(cell: Cell, plan: Plan | None, purpose: str, told: Mapping[str, str], out: Path) -> SessionWriter:
    """A new session."""
    from acquire.identity import identity_of_new_session
    from acquire.plan import plan_text
    from acquire.session import SessionWriter

    text, identity = None if plan is None else plan_text(plan), identity_of_new_session(cell, told)
    return SessionWriter.create(out, purpose=purpose, cell=cell, plan_text=text, identity=identity)


@contextmanager
def _session(cell: Cell, begin: Callable[[Path], SessionWriter], out: Path, told: Mapping[str, str], resume: bool) -> Iterator[SessionWriter]:
    """The session; taken away again when no picture came into it."""
    from acquire.session import SessionWriter

    writer = SessionWriter.resume(out, cell=cell, told=told) if resume else begin(out)
    try:
        with writer:
            yield writer
    finally:
        if not resume and not writer.shots:
            shutil.rmtree(out, ignore_errors=True)
