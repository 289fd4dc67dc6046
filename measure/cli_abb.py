"""`spherecal abb-program`, and the ABB half of `spherecal simulate-controller`."""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from measure.cli_run import AsJson, Debug, Quiet, Run, command

if TYPE_CHECKING:
    from drivers.kinematics.mdh import RobotModel
    from drivers.simulated.controllers.abb import AbbController
    from drivers.simulated.truth import Truth


def abb_program(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write the program and its installation page to.")],
    via: Annotated[Literal["tcp", "serial"], typer.Option(help="The line: a socket (needs 616-1) or a serial port.")] = "tcp",
    address: Annotated[str, typer.Option(help="Address of the controller.")] = "192.168.125.1",
    port: Annotated[int, typer.Option(help="Port of the program; the second program has the next one.", min=1025, max=65534)] = 5000,
    com: Annotated[str, typer.Option(help="Serial port of the controller.")] = "COM1:",
    baud: Annotated[int, typer.Option(help="Speed of the serial line.", min=19200, max=115200)] = 38400,
    mass_kg: Annotated[float, typer.Option(help="Mass on the flange: camera, cables, bracket.", min=0.001, max=1000)] = 1.0,
    pc_address: Annotated[str, typer.Option(help="Address of this computer, for programs of your own (spherecal_job.mod).")] = "192.168.125.2",
    force: Annotated[bool, typer.Option("--force", help="Replace files of an earlier call.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Write the RAPID program for an ABB IRC5 and a page to print that tells how to install it."""
    with command(as_json, debug, quiet) as run:
        from drivers.abb.program import ProgramSettings, write_program

        settings = ProgramSettings(
            via=via, address=address, port=port, com=com, baud=baud, mass_kg=mass_kg, pc_address=pc_address
        )
        files = write_program(out, settings, force=force)
        run.console.table("", ["file", "what it is"], [[path.name, what] for path, what in files])
        run.console.say(f"print {out / 'INSTALL.html'} and follow it. Never run on hardware: start in manual mode at reduced speed")
        run.finish({"out": out, "files": [path.name for path, _ in files]})


def serve_abb(
    run: Run,
    model: RobotModel,
    truth: Truth | None,
    host: str,
    *,
    port: int,
    bench_port: int,
    speed_up: float,
    faults: Sequence[str],
    until_eof: bool,
) -> None:
    """Serve a simulated IRC5 until somebody ends it.

    Raises:
        SettingsError: no loopback address, a port that is taken, a model without six axes, or no such fault.
    """
    from drivers.errors import SettingsError
    from drivers.simulated.controllers.abb_make import make_abb_controller

    made = make_abb_controller(model, truth, host, port=port, bench_port=bench_port, speed_up=speed_up)
    try:
        made.start()
        for text in faults:
            words = text.split()
            try:
                made.fault(words[0] if words else "", *words[1:2])
            except ValueError as error:
                raise SettingsError(str(error), where="--fault", remedy="Name one of them.") from error
        run.console.note(_ready_text(made))
        if until_eof:
            threading.Thread(target=_end_at_eof, args=(made,), daemon=True).start()
        made.ended.wait()
    finally:
        made.close()
    run.finish({"controller": "abb", "host": host})


def _ready_text(made: AbbController) -> str:
    return (
        f"IRC5 at {made.host}: program {made.port}, second program {made.state_port}, serial line {made.serial_port}, bench {made.bench_port}. "
        "Ctrl-C ends it."
    )


def _end_at_eof(made: AbbController) -> None:
    while sys.stdin.buffer.read(4096):
        pass
    made.ended.set()
