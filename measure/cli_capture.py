"""`spherecal capture`: the run, watched by a person or by nobody."""

from __future__ import annotations

import sys
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_run import EXIT_INTERRUPTED, EXIT_NOT_GOOD, AsJson, Debug, Quiet, command, stopped_by_signals

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.capture import CaptureSettings
    from acquire.cell import Cell
    from acquire.events import Command, Event
    from acquire.plan import Plan
    from acquire.visibility import CameraView
    from measure.cli_run import Run
    from measure.console import Console
    from measure.running import CaptureResult
    from measure.running_operator import Interrupts
    from measure.running_screen import Screen

MOTION_WORD = "move"


@dataclass(frozen=True, slots=True)
class How:
    """How a plan may be run in a cell."""

    settings: CaptureSettings
    step: bool
    """A person lets the robot go to every single pose."""
    note: str = ""
    """Why."""


@dataclass(frozen=True, slots=True)
class Extras:
    """What watches a run from outside."""

    until_length_u_mm: float | None = None
    extend: int = 0
    view: bool = False


def capture(
    cell: Annotated[Path, typer.Argument(help="The cell file.")],
    plan: Annotated[Path, typer.Argument(help="The plan, as `plan` writes it.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The session folder to write.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a session that was interrupted.")] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask before the robot moves. For plans that were driven step by step in this cell.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List the poses and the time they take; touch nothing.")] = False,
    step: Annotated[bool, typer.Option("--step", help="Ask before every pose.")] = False,
    touching: Annotated[
        bool, typer.Option("--touching", help="Run it step by step although, by rough shapes, a way touches what the cell file knows.")
    ] = False,
    speed: Annotated[
        float | None, typer.Option(min=0.001, metavar="RAD_S", help="No axis faster than this; never faster than the cell says.")
    ] = None,
    warm_up: Annotated[bool, typer.Option("--warm-up", help="First let the camera run until it drifts no more.")] = False,
    until_length_u: Annotated[
        float | None,
        typer.Option(min=0.001, metavar="MM", help="End early when lengths over the work volume are predicted this well, expanded (k = 2)."),
    ] = None,
    extend: Annotated[
        int, typer.Option(min=0, metavar="N", help="With --until-length-u: up to N further best next poses, while it is not reached.")
    ] = 0,
    view: Annotated[bool, typer.Option("--view", help="Show the run in Rerun, on this machine only.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Drive the robot through a plan and record a session. Ctrl-C pauses when the shot in hand is on disk, twice stops at once."""
    with command(as_json, debug, quiet) as run:
        from acquire.cell import load_cell, robot_model_of
        from acquire.plan import load_plan, with_part
        from drivers.errors import FileError

        loaded = load_cell(cell)
        poses = load_plan(plan, loaded, robot_model_of(loaded))
        loaded = with_part(loaded, poses)
        settings = _settings(loaded, speed, warm_up)
        if dry_run:
            run.finish(_dry_run(run.console, loaded, poses, settings))
            return
        _check_extend(loaded, until_length_u, extend)
        touches = _touches(loaded, poses)
        if touches and not touching:
            more = f", and {len(touches) - 1} more" if len(touches) > 1 else ""
            raise FileError(
                f"{touches[0]}{more}",
                file=plan,
                remedy="Look at it with `spherecal preview`; plan again, or give points to pass (via_rad). Are the rough shapes wrong? --touching",
            )
        how = how_to_run(loaded, poses, settings, yes=yes, step=step or bool(touches))
        if how.note:
            run.console.note(how.note)
        result, interrupts = _captured(run, loaded, poses, out, how, Extras(until_length_u, extend, view), resume=resume)
        run.console.say(f"{result.n_shots} shots in {out}, {result.n_failed} failed, {result.n_skipped} skipped: {result.state}")
        if result.state == "stopped":
            run.console.note(f"go on with: spherecal capture {cell} {plan} -o {out} --resume")
        run.finish(result.to_json_dict())
        run.exit_code = EXIT_INTERRUPTED if interrupts.ended else 0 if result.n_shots else EXIT_NOT_GOOD


def _settings(cell: Cell, speed_rad_s: float | None, warm_up: bool) -> CaptureSettings:
    from acquire.capture import settings_of
    from acquire.capture_settings import WarmUpSettings

    settings = settings_of(cell)
    motion = settings.motion if speed_rad_s is None else replace(settings.motion, speed_rad_s=min(speed_rad_s, settings.motion.speed_rad_s))
    return replace(settings, motion=motion, warm_up=WarmUpSettings() if warm_up else None)


def _touches(cell: Cell, plan: Plan) -> list[str]:
    """What is wrong with the ways of a plan, which may have been edited, or its cell."""
    from acquire.cell import robot_model_of
    from acquire.sweep import touching_ways, way_text

    return [way_text(way) for way in touching_ways(plan.poses, cell, robot_model_of(cell))]


def _check_extend(cell: Cell, until_length_u_mm: float | None, extend: int) -> None:
    from drivers.errors import SettingsError
    from measure.running import moves_a_real_robot

    if extend and until_length_u_mm is None:
        raise SettingsError("further poses are taken until something is reached", where="--extend", remedy="Give --until-length-u MM too.")
    if extend and moves_a_real_robot(cell):
        _require_person("--extend goes where nobody has driven before")


def _captured(run: Run, cell: Cell, plan: Plan, out: Path, how: How, extras: Extras, *, resume: bool) -> tuple[CaptureResult, Interrupts]:
    from acquire.cell import robot_model_of
    from measure.running import capture_session, moves_a_real_robot
    from measure.running_coverage import Coverage
    from measure.running_keys import Keyboard
    from measure.running_operator import Interrupts, Operator
    from measure.running_screen import Screen

    real, model = moves_a_real_robot(cell), robot_model_of(cell)
    with run.console.live() as draw, Keyboard.opened() as keys, ExitStack() as stack:
        attended = keys is not None and (real or how.step)
        screen = Screen(run.console.note, run.console.error, draw, Coverage(model, _view(cell)), keys=attended)
        interrupts = Interrupts(screen.tell, attended=attended)
        operator = Operator(keys if attended else None, interrupts, screen.prompt, step=how.step, planned=[pose.id for pose in plan.poses])
        look = stack.enter_context(_viewer(cell, extras.view))
        advice = stack.enter_context(_advice(plan, out, extras, screen, watched=draw is not None and real))

        def watch(event: Event) -> Command | None:
            screen.show(event)
            look(event)
            advised = advice(event)
            return operator.command_at(event) or advised

        with stopped_by_signals(), interrupts.watching():
            result = capture_session(cell, plan, out, watcher=watch, resume=resume, settings=how.settings, stepped=how.step)
    return result, interrupts


@contextmanager
def _viewer(cell: Cell, wanted: bool) -> Iterator[Callable[[Event], None]]:
    from acquire.cell import robot_model_of
    from measure.running_view import viewed

    with viewed(cell, robot_model_of(cell) if wanted else None) as show:
        yield show


@contextmanager
def _advice(plan: Plan, out: Path, extras: Extras, screen: Screen, *, watched: bool) -> Iterator[Callable[[Event], Command | None]]:
    """The running solve of a calibration, where somebody sees it or it is to end the run."""
    from measure.running_advice import Advice, Wanted
    from measure.running_solve import SolveWorker

    if plan.purpose != "calibration" or not (watched or extras.until_length_u_mm is not None):
        yield lambda _: None
        return
    with SolveWorker() as solver:
        yield Advice(solver, out, plan, Wanted(extras.until_length_u_mm, extras.extend), screen.solved).command_at


def _view(cell: Cell) -> CameraView | None:
    from acquire.visibility import camera_view

    known = cell.camera.kind == "area" and cell.camera.working_range_mm is not None and cell.camera.field_of_view_deg is not None
    return camera_view(cell.camera) if known else None


def _dry_run(console: Console, cell: Cell, plan: Plan, settings: CaptureSettings) -> dict[str, object]:
    import numpy as np

    from acquire.capture import planned_seconds

    rows = [[pose.id, pose.sphere or "-", "  ".join(f"{angle:7.1f}" for angle in np.degrees(pose.joints_rad))] for pose in plan.poses]
    seconds, speed = planned_seconds(plan.poses, settings), settings.motion.speed_rad_s
    console.table("", ["pose", "sphere", "axes, degrees"], rows)
    console.say(f"{len(plan.poses)} poses, about {seconds / 60:.0f} min at {speed:g} rad/s; nothing was moved")
    touches = _touches(cell, plan)
    for text in touches:
        console.say(text)
    if left := _never_driven(cell, plan, settings):
        console.say(f"{len(left)} of the poses were never driven in this cell: their first run goes step by step at {_first_speed(settings):g} rad/s")
    counts = {"n_shots": 0, "n_failed": 0, "state": "dry_run", "n_poses": len(plan.poses), "seconds": seconds}
    return {**counts, "never_driven": list(left), "touching": touches}


def how_to_run(cell: Cell, plan: Plan, settings: CaptureSettings, *, yes: bool, step: bool) -> How:
    """Whether a plan may be run in a cell, and how; asks the one question before a real robot moves.

    The first run of a plan in a cell is attended, step by step and slow, whatever the command line says.

    Raises:
        SettingsError: nobody is there to answer, or the answer is no.
        FileError: the record of the cell's runs cannot be read.
    """
    from acquire.cell import devices_of
    from drivers.errors import SettingsError
    from measure.running_screen import NO_SAFETY

    left = _never_driven(cell, plan, settings)
    if left:
        what = f"{len(left)} of the plan's {len(plan.poses)} poses were never driven in this cell step by step"
        if yes or not sys.stdin.isatty():
            devices_of(cell)  # a driver that does not exist is told first: making devices opens nothing
            remedy = "Run it once at a terminal, without --yes: it asks before every pose and moves slowly. --yes is for plans that were driven so."
            raise SettingsError(what, file=cell.path, remedy=remedy)
        slow = replace(settings, motion=replace(settings.motion, speed_rad_s=_first_speed(settings)))
        return How(slow, step=True, note=f"{what}:\nfirst run, step by step at {slow.motion.speed_rad_s:g} rad/s\n{NO_SAFETY}")
    if step:
        _require_person("--step asks before every pose")
    elif not yes:
        _confirm_motion(cell, plan, settings)
    return How(settings, step=step)


def _first_speed(settings: CaptureSettings) -> float:
    return min(settings.motion.speed_rad_s, settings.first_speed_rad_s)


def _never_driven(cell: Cell, plan: Plan, settings: CaptureSettings) -> tuple[str, ...]:
    """Poses that a first run has still to show; none where nothing can be hurt."""
    from measure.running import moves_a_real_robot
    from measure.running_record import never_driven, read_runs, runs_path

    return never_driven(cell, plan, read_runs(runs_path(cell)), settings.first_speed_rad_s) if moves_a_real_robot(cell) else ()


def _confirm_motion(cell: Cell, plan: Plan, settings: CaptureSettings) -> None:
    from drivers.errors import SettingsError
    from measure.running import moves_a_real_robot
    from measure.running_screen import NO_SAFETY

    if not moves_a_real_robot(cell):
        return
    _require_person("the robot is about to move")
    speed = f"{settings.motion.speed_rad_s:g} rad/s"
    sys.stderr.write(f"{NO_SAFETY}\n")
    sys.stderr.write(f"The robot of {cell.name!r} will move through {len(plan.poses)} poses at up to {speed}. Type '{MOTION_WORD}' to start: ")
    sys.stderr.flush()
    if sys.stdin.readline().strip() != MOTION_WORD:
        raise SettingsError("the motion was not confirmed", remedy=f"Type '{MOTION_WORD}', or use --yes.")


def _require_person(why: str) -> None:
    from drivers.errors import SettingsError

    if not sys.stdin.isatty():
        raise SettingsError(f"{why} and there is no terminal to answer at", remedy="Confirm with --yes, or run it at a terminal.")
