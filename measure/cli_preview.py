"""`spherecal preview`: a plan looked at before anything moves."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from measure.cli_run import EXIT_NOT_GOOD, AsJson, Debug, Quiet, command
from measure.console import viewer_command

_MOST_LINES = 10


def preview(
    plan: Annotated[Path, typer.Argument(help="The plan, as `plan` or `teach` writes it.")],
    cell: Annotated[Path | None, typer.Option(help="The cell file; by default cell.yaml beside the plan.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The recording to write; by default beside the plan.")] = None,
    view: Annotated[bool, typer.Option("--view", help="Open it in the viewer.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Show a plan's poses and the ways between them as a Rerun recording. Exit code 3 where something known is touched."""
    with command(as_json, debug, quiet) as run:
        from acquire.cell import load_cell, robot_model_of
        from acquire.plan import load_plan
        from acquire.sweep import way_text
        from drivers.errors import FileError, SettingsError
        from measure.cli_report import open_viewer
        from measure.files import require_writable
        from measure.plan_scene import preview_of
        from measure.viewer import write_recording

        target = plan.with_suffix(".rrd") if out is None else out
        require_writable(target)
        loaded = load_cell(plan.with_name("cell.yaml") if cell is None else cell)
        model = robot_model_of(loaded)
        poses = load_plan(plan, loaded, model)
        if model is None:
            raise SettingsError("the cell names no robot model", file=loaded.path, where="robot.model", remedy="Name one: poses are axis angles.")
        if not poses.poses:
            raise FileError("holds no poses", file=plan, where="poses", remedy="Plan or teach some.")
        found = preview_of(poses, loaded, model)
        write_recording(target, found.scene)
        run.console.say(f"{len(poses.poses)} poses, about {found.seconds / 60:.0f} min at {loaded.motion.speed_rad_s:g} rad/s")
        for way in found.touching[:_MOST_LINES]:
            run.console.say(way_text(way))
        if len(found.touching) > _MOST_LINES:
            run.console.say(f"and {len(found.touching) - _MOST_LINES} more")
        run.console.say(f"{target} written; look at it with: {viewer_command(target)}")
        if view:
            open_viewer(target)
        touching = [{"from": None if way.before is None else way.before.id, "to": way.pose.id} for way in found.touching]
        run.finish({"n_poses": len(poses.poses), "seconds": found.seconds, "touching": touching, "out": target})
        run.exit_code = EXIT_NOT_GOOD if touching else 0
