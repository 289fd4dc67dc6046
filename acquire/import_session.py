"""A session from poses and clouds that other programs wrote: all of it, readable and checked, or nothing."""

from __future__ import annotations

import datetime
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquire.cell import Cell, robot_model_of
from acquire.check import check_session
from acquire.import_clouds import Matching
from acquire.import_poses import Understood
from acquire.session import SessionWriter
from acquire.session_folder import check_free
from drivers.cameras.exports import grid_of
from drivers.cameras.points import UNITS_MM, Axes, optical_points_mm
from drivers.errors import DataError, FileError, SettingsError
from drivers.files.clouds import parse_cloud
from drivers.files.disk import read_bytes, sha256_hex, sync_folder
from drivers.files.ply import PointCloud
from drivers.files.pose_list import PoseList
from drivers.files.session import read_session
from drivers.kinematics.mdh import RobotModel

_LOOKED_AT = 5
_METRES_BELOW = 10.0
"""Cameras measure beyond 10 mm and, those that are meant here, within 10 m."""


@dataclass(frozen=True, slots=True, eq=False)
class Import:
    """Everything that is to become a session, understood and matched; nothing is written yet."""

    poses: PoseList
    understood: Understood
    matching: Matching
    spheres: tuple[tuple[str, ...], ...]
    """Of every pose: the spheres in its cloud, none for a workpiece."""
    cloud_unit: str
    """One of `drivers.cameras.points.UNITS_MM`."""
    cloud_axes: Axes | None
    notes: tuple[str, ...]


def plan_import(
    cell: Cell,
    poses: PoseList,
    understood: Understood,
    matching: Matching,
    *,
    spheres: Sequence[str],
    purpose: str,
    cloud_unit: str | None = None,
    cloud_axes: Axes | None = None,
) -> Import:
    """Put poses, clouds and spheres together.

    Args:
        cell: whose spheres they are.
        poses: as read.
        understood: what they mean.
        matching: the clouds of them.
        spheres: in every cloud, where the list has no column of its own; a cell's only sphere needs no name.
        purpose: calibration, verification or workpiece.
        cloud_unit: of the clouds; None is found out.
        cloud_axes: turns the clouds into the camera-optical frame.

    Raises:
        SettingsError: it cannot be told which sphere is meant, or there is no such.
        DataError: axis angles alone, and no robot model to turn them into poses; no cloud holds a point.
        FileError: a cloud is broken.
    """
    model = robot_model_of(cell)
    if understood.base_from_flange is None and model is None:
        remedy = "Name the model under robot in the cell file, or give flange poses too."
        raise DataError("only axis angles, and the cell names no robot model", file=poses.file, remedy=remedy)
    named = [_spheres_of(label.sphere, spheres, cell, purpose, label.where, poses.file) for label in poses.labels]
    notes = [*poses.described, *understood.notes, _matched(matching)]
    if cloud_unit is None:
        cloud_unit, why = likely_unit([path for path in matching.clouds if path is not None])
        notes.append(why)
    return Import(poses, understood, matching, tuple(named), cloud_unit, cloud_axes, tuple(notes))


def _spheres_of(own: str | None, spheres: Sequence[str], cell: Cell, purpose: str, where: str, file: str) -> tuple[str, ...]:
    if purpose == "workpiece" and own is None and not spheres:
        return ()
    chosen = (own,) if own is not None else tuple(spheres) or (tuple(cell.spheres) if len(cell.spheres) == 1 else ())
    known = ", ".join(cell.spheres) or "none"
    if not chosen:
        message = "the cell has several spheres, and nothing tells which one a cloud shows" if cell.spheres else "the cell has no spheres"
        raise SettingsError(
            message, where="--sphere", remedy=f"Give --sphere (spheres of the cell: {known}), or a column sphere, or --for workpiece."
        )
    if unknown := [name for name in chosen if name not in cell.spheres]:
        raise DataError(f"there is no sphere {unknown[0]!r} in {cell.path.name}", file=file, where=where, remedy=f"Spheres of the cell: {known}.")
    return chosen


def _matched(matching: Matching) -> str:
    how = {"file": "by the column of file names", "name": "by name", "number": "by number", "order": "in natural order"}[matching.by]
    n_missing, n_unused = matching.clouds.count(None), len(matching.unused)
    parts = [f"clouds matched {how}"]
    parts += [f"{n_missing} poses without a cloud"] if n_missing else []
    parts += [f"{n_unused} clouds without a pose left out"] if n_unused else []
    return ", ".join(parts)


def read_cloud(path: Path) -> PointCloud:
    """A cloud of another program.

    Raises:
        FileError: it is broken, or was moved out of the camera's frame by its program.
    """
    return _parsed(read_bytes(path), path)


def _parsed(data: bytes, path: Path) -> PointCloud:
    cloud = parse_cloud(data, file=path)
    if any(comment.startswith("viewpoint ") for comment in cloud.comments):
        remedy = "Export it in the camera's own frame: a cloud that was moved cannot calibrate a camera."
        raise FileError("has a viewpoint: its points may have been moved out of the camera's frame", file=path, remedy=remedy)
    return cloud


def likely_unit(clouds: Sequence[Path]) -> tuple[str, str]:
    """The unit of clouds, and how it was found out: what their comments say, else by their distances.

    Raises:
        DataError: the first clouds hold no point, or tell different units.
        FileError: one is broken.
    """
    found: dict[str, str] = {}
    for path in clouds[:_LOOKED_AT]:
        cloud = read_cloud(path)
        said = next((unit for unit in UNITS_MM if f"unit {unit}" in cloud.comments), None)
        distances = np.linalg.norm(cloud.points_mm, axis=1)
        distances = distances[np.isfinite(distances) & (distances > 0)]
        if said is not None:
            found.setdefault(said, f"clouds in {said}, as they say themselves")
        elif distances.size:
            middle = float(np.median(distances))
            unit = "m" if middle < _METRES_BELOW else "mm"
            found.setdefault(unit, f"clouds in {unit}: their middle distance is {middle:.3g}")
    if len(found) != 1:
        message = "the first clouds hold no point" if not found else f"the clouds look as if some were in {' and some in '.join(found)}"
        raise DataError(message, file=clouds[0].parent, remedy="Say --cloud-unit mm or --cloud-unit m, and look at the clouds.")
    return next(iter(found.items()))


def write_import(task: Import, cell: Cell, out: str | Path, *, purpose: str, advance: Callable[[int, int], None] | None = None) -> tuple[int, int]:
    """Write the session beside its place and rename it: it is there as a whole, or not at all.

    Returns:
        How many shots are good, and how many poses had no cloud.

    Raises:
        FileError: the folder is in use or cannot be written, a cloud is broken, or the shots do not fit the cell.
        DataError: a cloud without a point.
    """
    target = Path(out)
    check_free(target)
    try:
        target.absolute().parent.mkdir(parents=True, exist_ok=True)
        working = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.absolute().parent))
    except OSError as error:
        raise FileError(f"cannot be made ({error.strerror})", file=target, remedy="Choose a folder that can be written.") from error
    try:
        with SessionWriter.create(working, purpose=purpose, cell=cell) as writer:
            for row in range(len(task.poses)):
                _append(writer, task, row)
                if advance is not None:
                    advance(row + 1, len(task.poses))
            counts = [shot.status for shot in writer.shots]
        _check(working, cell, robot_model_of(cell))
        os.replace(working, target)
        sync_folder(target.absolute().parent)
    except BaseException:
        shutil.rmtree(working, ignore_errors=True)
        raise
    return counts.count("ok"), counts.count("failed")


def _check(folder: Path, cell: Cell, model: RobotModel | None) -> None:
    """Read it as `calibrate` will."""
    check_session(read_session(folder), cell, model)


def _append(writer: SessionWriter, task: Import, row: int) -> None:
    """The shots of one pose: one for each sphere in its cloud."""
    label, path = task.poses.labels[row], task.matching.clouds[row]
    joints = None if task.understood.joints_rad is None else task.understood.joints_rad[row]
    pose = None if task.understood.base_from_flange is None else task.understood.base_from_flange[row]
    pose_id = label.name or (None if label.number is None else str(label.number))
    source: dict[str, object] = {"poses": Path(task.poses.file).name, "where": label.where}
    spheres: tuple[str | None, ...] = task.spheres[row] or (None,)
    if path is None:
        extra = {"source": source}
        writer.append(
            sphere=spheres[0], joints_rad=joints, base_from_flange=pose, pose_id=pose_id, status="failed", reason="there is no cloud", extra=extra
        )
        return
    data = read_bytes(path)
    xyz_mm, intensity = _scan(data, path, task)
    extra = {"source": source | {"cloud": path.name, "sha256": sha256_hex(data)}}
    first = writer.append(
        sphere=spheres[0],
        joints_rad=joints,
        base_from_flange=pose,
        xyz_mm=xyz_mm,
        intensity=intensity,
        pose_id=pose_id,
        time_utc=_time_utc(label.time, path),
        extra=extra,
    )
    for sphere in spheres[1:]:
        same = {"same_scan_as": first.index, "time_utc": first.time_utc}
        writer.append(sphere=sphere, joints_rad=joints, base_from_flange=pose, pose_id=pose_id, extra=extra, **same)  # type: ignore[arg-type]


def _scan(data: bytes, path: Path, task: Import) -> tuple[NDArray[np.float32], NDArray[np.floating] | None]:
    """Points in mm in the camera's frame, and brightness where the file has it; both as a grid where there is one."""
    cloud = _parsed(data, path)
    xyz_mm = optical_points_mm(cloud.xyz_mm, unit_mm=UNITS_MM[task.cloud_unit], axes=task.cloud_axes)
    if not np.isfinite(xyz_mm).any():
        raise DataError("holds no point", file=path, remedy="Export it again, or take the pose and its cloud out.")
    grid = grid_of(cloud, None)
    shape = xyz_mm.shape[:-1] if grid is None else grid
    intensity = cloud.properties.get("intensity")
    usable = intensity is not None and np.issubdtype(intensity.dtype, np.number)
    return xyz_mm.reshape(*shape, 3), intensity.astype(np.float32).reshape(shape) if usable and intensity is not None else None


def _time_utc(told: str | None, path: Path) -> str:
    """The list's own time where it is one, else when the cloud was written."""
    try:
        when = datetime.datetime.fromisoformat(told or "")
    except ValueError:
        when = datetime.datetime.fromtimestamp(path.stat().st_mtime, datetime.UTC)
    when = when if when.tzinfo is not None else when.astimezone()
    return when.astimezone(datetime.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
