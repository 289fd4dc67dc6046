"""`spherecal simulate-controller`: a robot controller on the wire, for adapters to be tried without hardware."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from measure.cli_run import AsJson, Debug, Quiet, command, stopped_by_signals

if TYPE_CHECKING:
    from drivers.kinematics.mdh import RobotModel
    from drivers.simulated.controllers.bench import BenchClient
    from drivers.simulated.truth import Truth


def simulate_controller(
    controller: Annotated[
        Literal["ur", "abb"], typer.Argument(help="Whose protocol: ur (RTDE, dashboard, scripts), abb (spherecal.mod over TCP and a pty).")
    ],
    host: Annotated[str, typer.Option(help="Loopback address to serve; every UR needs one of its own.")] = "127.0.0.2",
    port: Annotated[int, typer.Option(help="Port of the program that moves (abb); the second program has the next one.")] = 5000,
    cell: Annotated[Path | None, typer.Option(help="Cell file: its robot model, and the truth of its simulated camera.")] = None,
    model: Annotated[str | None, typer.Option(help="Robot model, without a cell file. [default: ur5e or abb_irb1410]")] = None,
    truth: Annotated[Path | None, typer.Option(help="Truth file, without a cell file; none: a robot without errors.")] = None,
    bench_port: Annotated[int, typer.Option(help="Port of the bench, where faults are asked for.")] = 29900,
    speed_up: Annotated[float, typer.Option(help="How much faster than real the robot moves.", min=0.01, max=1000)] = 1.0,
    factory_calibration: Annotated[int | None, typer.Option(help="Seed of a kinematic calibration of the controller's own (UR).")] = None,
    fault: Annotated[list[str] | None, typer.Option("--fault", metavar="'NAME [NUMBER]'", help="Misbehave from the start. Repeat.")] = None,
    until_eof: Annotated[bool, typer.Option("--until-eof", help="End when standard input is closed.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Serve a simulated robot controller until Ctrl-C. Faults on order: `fault NAME` at the bench, e.g. with netcat."""
    with command(as_json, debug, quiet) as run, stopped_by_signals():
        robot, known = _robot_and_truth(cell, model or {"ur": "ur5e", "abb": "abb_irb1410"}[controller], truth)
        if controller == "abb":
            from measure.cli_abb import serve_abb

            serve_abb(run, robot, known, host, port=port, bench_port=bench_port, speed_up=speed_up, faults=fault or (), until_eof=until_eof)
            return
        from drivers.simulated.controllers.bench import BenchClient
        from drivers.simulated.controllers.ur.make import make_controller
        from drivers.simulated.controllers.ur.server import serve

        made = make_controller(robot, known, host, bench_port=bench_port, speed_up=speed_up, factory_calibration=factory_calibration)

        def ready(line: str) -> None:
            run.console.note(line)
            if until_eof:
                _afterwards(lambda: _quit_at_eof(BenchClient(host, made.bench_port)))

        serve(made, ready, fault or ())
        run.finish({"controller": controller, "host": host})


def _robot_and_truth(cell: Path | None, model: str, truth: Path | None) -> tuple[RobotModel, Truth | None]:
    from drivers.models import load_robot_model
    from drivers.simulated.truth_file import load_truth

    if cell is None:
        return load_robot_model(model), None if truth is None else load_truth(truth)
    from acquire.cell import load_cell, robot_model_of
    from drivers.errors import SettingsError

    loaded = load_cell(cell)
    robot = robot_model_of(loaded)
    if robot is None:
        raise SettingsError("the cell names no robot model", file=cell, where="robot.model", remedy="Name one, e.g. ur5e.")
    named = loaded.camera.settings.get("truth", loaded.robot.settings.get("truth"))
    path = truth or (loaded.folder / named if isinstance(named, str) else None)
    return robot, None if path is None else load_truth(path)


def _afterwards(action: Callable[[], object]) -> None:
    threading.Thread(target=action, daemon=True).start()


def _quit_at_eof(bench: BenchClient) -> None:
    # not sys.stdin: its lock would be held when the interpreter shuts down
    while os.read(sys.stdin.fileno(), 4096):
        pass
    bench.ask("quit")
