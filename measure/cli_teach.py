"""`spherecal teach`: a plan from poses to which a person leads the arm."""

from __future__ import annotations

import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from measure.cli_run import EXIT_INTERRUPTED, AsJson, Debug, Quiet, command, stopped_by_signals

if TYPE_CHECKING:
    from acquire.cell import Cell
    from acquire.plan import PlannedPose
    from acquire.teach import TeachSettings
    from drivers.errors import SpherecalError
    from drivers.protocols import Devices
    from measure.console import Console
    from measure.teaching import Hand

For = Literal["calibrate", "verify", "workpiece"]
_PURPOSES: dict[For, Literal["calibration", "verification", "workpiece"]] = {
    "calibrate": "calibration",
    "verify": "verification",
    "workpiece": "workpiece",
}
GUIDE_WORD, JOG_WORD = "guide", "move"


def teach(
    cell: Annotated[Path, typer.Argument(help="The cell file.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The plan to write.")] = Path("plan.yaml"),
    purpose: Annotated[For, typer.Option("--for", help="What the poses are for.")] = "calibrate",
    sphere: Annotated[str | None, typer.Option(help="The sphere to look at first; by default the one the camera is aimed at.")] = None,
    held: Annotated[bool, typer.Option("--held", help="Do not make the arm soft: it is jogged at its pendant.")] = False,
    jog: Annotated[bool, typer.Option("--jog", help="Move single axes by keys, slowly.")] = False,
    every: Annotated[float, typer.Option(min=0.05, max=60, help="Seconds between two pictures.")] = 0.5,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Lead the arm by hand, or jog it, and keep poses from which the sphere is seen. The plan is on disk after every pose."""
    with command(as_json, debug, quiet) as run, stopped_by_signals():
        from acquire.cell import devices_of, load_cell
        from acquire.plan import PLAN_FORMAT
        from acquire.teach import TeachSettings
        from drivers.protocols import HandGuided
        from measure.files import replacing, require_writable
        from measure.teaching import Hand

        loaded = load_cell(cell)
        require_writable(out)
        devices = devices_of(loaded)
        settings = TeachSettings(guided=not held and not jog and isinstance(devices.robot, HandGuided), sphere_name=sphere)
        _confirm(loaded, settings, jog)
        book = _Book(loaded, _PURPOSES[purpose], out)
        with replacing(out, PLAN_FORMAT) as former:
            trouble = _lesson(run.console, devices, book, settings, Hand(jog=jog), every)
            if not book.poses:
                out.unlink(missing_ok=True)
                raise trouble or _nothing_taught()
        if former is not None and former.exists():
            run.console.note(f"the earlier {out} was kept as {former}")
        run.console.say(f"{len(book.poses)} poses in {out}")
        if trouble is not None and not isinstance(trouble, KeyboardInterrupt):
            raise trouble
        run.finish({**book.counts, "state": "complete" if trouble is None else "interrupted", "out": out})
        run.exit_code = 0 if trouble is None else EXIT_INTERRUPTED


@dataclass(slots=True)
class _Book:
    """The plan as it grows; every pose is on disk before the next one."""

    cell: Cell
    purpose: Literal["calibration", "verification", "workpiece"]
    out: Path
    poses: tuple[PlannedPose, ...] = ()

    def save(self, poses: tuple[PlannedPose, ...]) -> None:
        """Write the plan anew."""
        from acquire.plan import Plan, write_plan

        self.poses = poses
        write_plan(Plan(self.cell.sha256, self.purpose, poses), self.out)

    @property
    def counts(self) -> dict[str, object]:
        """What `--json` says of the poses."""
        names = dict.fromkeys(pose.sphere for pose in self.poses)
        return {"n_poses": len(self.poses), "spheres": {str(name): sum(pose.sphere == name for pose in self.poses) for name in names}}


def _lesson(
    console: Console, devices: Devices, book: _Book, settings: TeachSettings, hand: Hand, every_s: float
) -> SpherecalError | KeyboardInterrupt | None:
    """One lesson; what ended it early is given back, as what was taught stays whatever that was."""
    from acquire.teach import run_teach
    from drivers.errors import SpherecalError
    from measure.running_keys import Keyboard
    from measure.teaching import TeachScreen
    from measure.teaching import teach as lead

    try:
        with Keyboard.opened() as keys, devices, console.live() as draw, closing(run_teach(devices, book.cell, settings)) as lesson:
            if keys is None:
                raise _no_terminal()
            lead(lesson, keys, TeachScreen(console.note, draw, hand), hand, book.save, every_s=every_s)
    except (SpherecalError, KeyboardInterrupt) as error:
        return error
    return None


def _confirm(cell: Cell, settings: TeachSettings, jog: bool) -> None:
    """Say what is about to give way or move, and ask the one question.

    Raises:
        SettingsError: nobody is there to answer, or the answer is no.
    """
    from drivers.errors import SettingsError
    from measure.running import moves_a_real_robot
    from measure.teaching import HAND_GUIDING, JOGGING

    if not sys.stdin.isatty():
        raise _no_terminal()
    if not (settings.guided or jog) or not moves_a_real_robot(cell):
        return
    text = HAND_GUIDING.format(name=cell.name) if settings.guided else JOGGING.format(name=cell.name, speed=settings.motion.speed_rad_s)
    word = GUIDE_WORD if settings.guided else JOG_WORD
    sys.stderr.write(f"{text}\nType '{word}' to start: ")
    sys.stderr.flush()
    if sys.stdin.readline().strip() != word:
        raise SettingsError("it was not confirmed", remedy=f"Type '{word}'; or teach with --held and the pendant.")


def _no_terminal() -> SpherecalError:
    from drivers.errors import SettingsError

    remedy = "Run it at a terminal, e.g. over ssh -t, or plan poses with `spherecal plan`."
    return SettingsError("poses are taught by keys, and there is no terminal", remedy=remedy)


def _nothing_taught() -> SpherecalError:
    from drivers.errors import SettingsError

    return SettingsError("no pose was kept, and so no plan was written", remedy="Enter keeps a pose from which the sphere is seen.")
