"""`spherecal serve-cell`: the controller's own program owns the motion and asks for pictures."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from measure.cli_run import EXIT_INTERRUPTED, EXIT_NOT_GOOD, AsJson, Debug, Quiet, command, stopped_by_signals

if TYPE_CHECKING:
    from acquire.cell import Cell
    from acquire.plan import Plan
    from acquire.session import SessionWriter
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
    count: Annotated[int | None, typer.Option(help="End after so many good pictures.", min=1)] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a session.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Take a picture when the robot's own program asks (TRIG), keep it, and tell OK or NG. Ctrl-C ends it."""
    with command(as_json, debug, quiet) as run, stopped_by_signals():
        from acquire.cell import devices_of, load_cell, robot_model_of
        from acquire.plan import load_plan
        from measure.serve import CellDesk, CellWorker, Orders
        from measure.serve_line import LineServer

        loaded = load_cell(cell)
        model = robot_model_of(loaded)
        planned = None if plan is None else load_plan(plan, loaded, model)
        orders = Orders(() if planned is None else planned.poses, _checked_sphere(loaded, planned, sphere))
        desk, interrupted = CellDesk(), False
        camera = devices_of(loaded).camera
        with ExitStack() as stack:
            stack.callback(camera.close)
            told = camera.open().identity()
            writer = stack.enter_context(_session(loaded, planned, out, purpose or _purpose(planned, sphere), told, resume))

            def tell(job: Job) -> None:
                run.console.note(_line(job, orders))

            worker = CellWorker(loaded, model, camera, writer, orders, tell, loaded.motion.frames, told=told)
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
        run.finish({"n_shots": n_ok, "n_failed": n_bad, "state": "stopped" if interrupted else "complete", "out": out})
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


@contextmanager
def _session(cell: Cell, plan: Plan | None, out: Path, purpose: str, told: Mapping[str, str], resume: bool) -> Iterator[SessionWriter]:
    """The session; taken away again when no picture came into it."""
    from acquire.identity import identity_of_new_session
    from acquire.plan import plan_text
    from acquire.session import SessionWriter

    if resume:
        writer = SessionWriter.resume(out, cell=cell, told=told)
    else:
        text, identity = None if plan is None else plan_text(plan), identity_of_new_session(cell, told)
        writer = SessionWriter.create(out, purpose=purpose, cell=cell, plan_text=text, identity=identity)
    try:
        with writer:
            yield writer
    finally:
        if not resume and not writer.shots:
            shutil.rmtree(out, ignore_errors=True)
