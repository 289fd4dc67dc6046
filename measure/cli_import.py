"""`spherecal import`: a session from poses and clouds that other programs wrote."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from measure.cli_run import AsJson, Debug, Quiet, command

if TYPE_CHECKING:
    from acquire.import_session import Import
    from measure.console import Console

FIRST_ROWS = 5
For = Literal["calibrate", "verify", "workpiece"]
_PURPOSES: dict[For, str] = {"calibrate": "calibration", "verify": "verification", "workpiece": "workpiece"}
_LengthUnit = Literal["mm", "m"]
_AngleUnit = Literal["deg", "rad"]


def import_session(
    cell: Annotated[Path, typer.Argument(help="The cell file: its spheres, and its robot model where there are axis angles.")],
    poses: Annotated[Path, typer.Argument(help="CSV or other table of poses, RAPID module, or URScript.")],
    clouds: Annotated[str, typer.Option("--clouds", help="Folder of the PLY, PCD or NPZ clouds, or a pattern in quotes.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The session folder to write.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show the first rows as they are understood; write nothing.")] = False,
    rotation: Annotated[
        str | None,
        typer.Option(help="Convention of the rotations: a make (abb, fanuc, kuka, staubli, ur, ...), fixed-xyz, moving-zyx, quaternion-wxyz, ..."),
    ] = None,
    columns: Annotated[str | None, typer.Option(help="Names of the columns, separated by commas, instead of the header's.")] = None,
    use: Annotated[Literal["both", "joints", "poses"], typer.Option(help="Take axis angles, flange poses, or both.")] = "both",
    unit: Annotated[_LengthUnit | None, typer.Option(help="Of the positions.")] = None,
    joint_unit: Annotated[_AngleUnit | None, typer.Option(help="Of the axis angles.")] = None,
    angle_unit: Annotated[_AngleUnit | None, typer.Option(help="Of the angles of the rotations.")] = None,
    cloud_unit: Annotated[Literal["mm", "m", "um", "inch"] | None, typer.Option(help="Of the clouds.")] = None,
    cloud_axes: Annotated[
        str, typer.Option(help="Of the clouds: optical, graphics, unity, robot, or what is right, down, out, as x,-y,-z.")
    ] = "optical",
    match: Annotated[Literal["auto", "file", "name", "number", "order"], typer.Option(help="How clouds and poses belong together.")] = "auto",
    allow_missing: Annotated[
        bool, typer.Option("--allow-missing", help="Poses without a cloud become failed shots, other clouds are left out.")
    ] = False,
    sphere: Annotated[list[str] | None, typer.Option("--sphere", help="The sphere in every cloud. Repeat where several are in view.")] = None,
    purpose: Annotated[For, typer.Option("--for", help="What the session is for.")] = "calibrate",
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Make a session from a list of poses and a folder of clouds. What is not said is found out and told; what stays open is an error."""
    with command(as_json, debug, quiet) as run:
        from acquire.cell import load_cell, robot_model_of
        from acquire.import_clouds import find_clouds, match_clouds
        from acquire.import_poses import Meaning, understand
        from acquire.import_session import plan_import, write_import
        from calibrate.plausibility import likely_cause
        from drivers.cameras.points import parse_axes
        from drivers.files.poses import read_poses

        target = None if dry_run else _place(out)
        loaded, named = load_cell(cell), _PURPOSES[purpose]
        listed = read_poses(poses, columns=None if columns is None else columns.split(","), use=use)
        understood = understand(listed, robot_model_of(loaded), Meaning(rotation, unit, joint_unit, angle_unit), likely_cause)
        matching = match_clouds(listed.labels, find_clouds(clouds), match, file=poses, allow_missing=allow_missing)
        axes = parse_axes(cloud_axes.split(",") if "," in cloud_axes else cloud_axes, where="--cloud-axes")
        spheres = tuple(sphere or ())
        task = plan_import(loaded, listed, understood, matching, spheres=spheres, purpose=named, cloud_unit=cloud_unit, cloud_axes=axes)
        _tell(run.console, task)
        if target is None:
            run.console.say("nothing was written")
            run.finish(_result(task, 0, 0, "dry_run", None))
            return
        with run.console.progress("importing") as advance:
            n_shots, n_failed = write_import(task, loaded, target, purpose=named, advance=advance)
        run.console.say(f"{n_shots} shots in {target}" + (f", {n_failed} poses without a cloud" if n_failed else ""))
        run.console.note(f"see what the clouds show: spherecal centres {target}")
        run.finish(_result(task, n_shots, n_failed, "complete", target))


def _place(out: Path | None) -> Path:
    """Where the session goes, before anything is read.

    Raises:
        SettingsError: it was not said.
        FileError: something is there already.
    """
    from acquire.session_folder import check_free
    from drivers.errors import SettingsError

    if out is None:
        raise SettingsError("nothing says where the session goes", where="--out", remedy="Name a new folder with -o, or look first with --dry-run.")
    check_free(out)
    return out


def _tell(console: Console, task: Import) -> None:
    """How everything was understood, and the first rows."""
    for note in task.notes:
        console.say(note)
    rows = first_rows(task)
    columns = ["pose", "sphere", "cloud"]
    columns += ["axes, degrees"] if task.understood.joints_rad is not None else []
    columns += ["x y z, mm", "about x y z, degrees"] if task.understood.base_from_flange is not None else []
    console.table("", columns, rows)
    if len(task.poses) > len(rows):
        console.say(f"... and {len(task.poses) - len(rows)} more")


def first_rows(task: Import) -> list[list[str]]:
    """The first poses as they were understood: rotations about the fixed axes x, y, z, whatever the file says."""
    import numpy as np

    from drivers.kinematics.rotations import fixed_xyz_rad

    rows = []
    for i in range(min(FIRST_ROWS, len(task.poses))):
        label, cloud = task.poses.labels[i], task.matching.clouds[i]
        name = label.name or (label.where if label.number is None else str(label.number))
        row = [name, ", ".join(task.spheres[i]) or "-", "-" if cloud is None else cloud.name]
        if task.understood.joints_rad is not None:
            row.append(" ".join(f"{angle:.2f}" for angle in np.degrees(task.understood.joints_rad[i])))
        if task.understood.base_from_flange is not None:
            pose = task.understood.base_from_flange[i]
            row.append(" ".join(f"{value:.2f}" for value in pose[:3, 3]))
            row.append(" ".join(f"{angle:.2f}" for angle in np.degrees(fixed_xyz_rad(pose[:3, :3]))))
        rows.append(row)
    return rows


def _result(task: Import, n_shots: int, n_failed: int, state: str, out: Path | None) -> dict[str, object]:
    """What `--json` prints."""
    understood = task.understood
    poses = [
        {
            "where": label.where,
            "name": label.name,
            "spheres": list(task.spheres[i]),
            "cloud": None if task.matching.clouds[i] is None else str(task.matching.clouds[i]),
            "joints_rad": None if understood.joints_rad is None else understood.joints_rad[i],
            "base_from_flange": None if understood.base_from_flange is None else understood.base_from_flange[i],
        }
        for i, label in enumerate(task.poses.labels[:FIRST_ROWS])
    ]
    return {
        "n_shots": n_shots,
        "n_failed": n_failed,
        "state": state,
        "out": out,
        "n_poses": len(task.poses),
        "rotation": understood.rotation,
        "units": {**understood.units, "clouds": task.cloud_unit},
        "matched_by": task.matching.by,
        "notes": list(task.notes),
        "first_poses": poses,
    }
