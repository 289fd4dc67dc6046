"""Plans that cover the surface of a workpiece: where it stands, views of it, and what the poses of a plan see of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquire.candidates import CandidatePool, feasible
from acquire.cell import Cell
from acquire.collision import CollisionCheck
from acquire.coverage import SEEN, Cover, Sights, Surface, choose_cover, looking_poses, surface_of
from acquire.obstacles import MeshObstacle, mesh_of, solid_of
from acquire.plan import Plan, with_part
from acquire.poses import DEFAULT_LAW
from acquire.visibility import CameraView, camera_view
from drivers.errors import DataError, FileError, SettingsError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

N_POINTS = 3000
N_VIEWS = 700
# Triangles of a preview are cut to this share of the part's diagonal, so that colours show where a view ends.
_PREVIEW_SHARE = 1 / 40


@dataclass(frozen=True, slots=True)
class Coverage:
    """What the poses of a plan see of a part's surface, as shares of its area."""

    covered_fraction: float
    seen_twice_fraction: float
    not_covered: Mapping[str, float]
    """By reason."""

    def to_json_dict(self) -> dict[str, object]:
        """For `--json` and plan files."""
        shares = {reason: round(share, 4) for reason, share in sorted(self.not_covered.items())}
        covered, twice = round(self.covered_fraction, 4), round(self.seen_twice_fraction, 4)
        return {"covered_fraction": covered, "seen_twice_fraction": twice, "not_covered": shares}


def placed_part(cell: Cell, file: Path, placed: Sequence[float] | None) -> MeshObstacle:
    """The part of a plan, where it stands: where it was said to, or where the cell has it among its obstacles.

    Args:
        cell: the cell.
        file: the part's mesh.
        placed: x, y, z in mm of the origin of its coordinates in the base, then its turns about the base's x, y and z axes, degrees.

    Raises:
        SettingsError: nobody says where it stands.
    """
    absolute = file.resolve()
    for obstacle in cell.obstacles if placed is None else ():
        if isinstance(obstacle, MeshObstacle) and (cell.folder / obstacle.file).resolve() == absolute:
            return obstacle
    if placed is None:
        remedy = "Give --placed X Y Z RX RY RZ, or name the file as a mesh among the obstacles of the cell."
        raise SettingsError("nobody says where the part stands", file=file, where="--placed", remedy=remedy)
    folder = cell.folder.resolve()
    name = absolute.relative_to(folder) if absolute.is_relative_to(folder) else absolute
    x, y, z, *turns = (float(value) for value in placed)
    return MeshObstacle(name="part", kind="mesh", file=str(name), centre_in_base_mm=(x, y, z), rotation_deg=(turns[0], turns[1], turns[2]))


def part_pool(
    cell: Cell,
    part: MeshObstacle,
    n: int,
    model: RobotModel,
    flange_from_camera: FloatArray,
    view: CameraView,
    check: CollisionCheck,
    rng: np.random.Generator,
) -> tuple[CandidatePool, Cover]:
    """Up to n views that cover a part, and why the rest of it is not seen.

    Args:
        cell: the part among its obstacles.
        part: the part.
        n: the most poses.
        model: the nominal robot.
        flange_from_camera: (4, 4) first guess.
        view: what the camera sees.
        check: the collision check, the part in it.
        rng: seeded by the caller.

    Raises:
        DataError: no view is feasible that sees any of it.
    """
    surface, sights = _surface(cell, part, rng), _sights(cell)
    poses = looking_poses(surface, view, N_VIEWS, rng)
    in_camera = np.broadcast_to([0.0, 0.0, view.middle_mm], (len(poses), 3))
    floor_mm = min(0.0, float(surface.points_in_base_mm[:, 2].min()))
    everywhere = np.ones(len(poses), dtype=np.bool_)
    pool = feasible(model, flange_from_camera, poses, in_camera, everywhere, DEFAULT_LAW.limit_margin_rad, floor_mm, check)
    can = np.zeros(len(poses), dtype=np.bool_)
    can[pool.view] = True
    cover = choose_cover(sights.stages(view, poses, surface), can, n)
    if not cover.rows:
        reasons = ", ".join(f"{reason} {count}" for reason, count in pool.rejected.items())
        remedy = "Stand it within the robot's reach and the camera's range, the side to be seen upwards."
        raise DataError(f"no feasible view sees the part ({reasons})", file=cell.path, where=f"part {part.file}", remedy=remedy)
    return pool.take([_branch(pool, row) for row in cover.rows]), cover


def coverage_of(plan: Plan, cell: Cell, model: RobotModel, cover: Cover | None = None) -> Coverage:
    """What the poses of a plan see of its part.

    Args:
        plan: with a part.
        cell: its camera.
        model: the nominal robot.
        cover: why the rest is not seen, where that is known.
    """
    part, full = _part_of(plan), with_part(cell, plan)
    surface = _surface(full, part, np.random.default_rng(0))
    views = _seen(plan, full, model, surface).sum(axis=0)
    rest = float((views == 0).mean())
    told = {} if cover is None else dict(cover.not_covered)
    scale = rest / sum(told.values()) if sum(told.values()) > 0 else 0.0
    return Coverage(1 - rest, float((views > 1).mean()), {reason: share * scale for reason, share in told.items()})


def views_of_triangles(plan: Plan, cell: Cell, model: RobotModel) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64]]:
    """Vertices (v, 3) in the base and small triangles (t, 3) of a plan's part, and how many of its poses see each (t,)."""
    import trimesh

    part, full = _part_of(plan), with_part(cell, plan)
    vertices, triangles = solid_of(part, cell.folder)
    longest = float(np.linalg.norm(np.ptp(vertices, axis=0))) * _PREVIEW_SHARE
    remesh: Any = trimesh.remesh
    vertices, triangles = remesh.subdivide_to_size(vertices, triangles, max_edge=longest, max_iter=20)
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    views = _seen(plan, full, model, Surface(corners.mean(axis=1), unit)).sum(axis=0)
    return np.asarray(vertices), np.asarray(triangles, dtype=np.int64), np.asarray(views, dtype=np.int64)


def _seen(plan: Plan, cell: Cell, model: RobotModel, surface: Surface) -> NDArray[np.bool_]:
    joints = np.array([pose.joints_rad for pose in plan.poses])
    base_from_camera = mdh.base_from_flange(model, joints) @ np.asarray(cell.flange_from_camera)
    return np.asarray(_sights(cell).stages(camera_view(cell.camera), base_from_camera, surface) == SEEN)


def _sights(cell: Cell) -> Sights:
    return Sights([solid_of(obstacle, cell.folder) for obstacle in cell.obstacles])


def _surface(cell: Cell, part: MeshObstacle, rng: np.random.Generator) -> Surface:
    vertices, triangles = mesh_of(part, cell.folder)
    return surface_of(se3.apply(part.base_from_obstacle, vertices), triangles, N_POINTS, rng)


def _branch(pool: CandidatePool, view: int) -> int:
    """Of the branches that reach a view the one nearest to what most poses use."""
    rows = np.flatnonzero(pool.view == view)
    return int(rows[np.argmin(np.abs(pool.joints_rad[rows] - np.median(pool.joints_rad, axis=0)).max(axis=1))])


def _part_of(plan: Plan) -> MeshObstacle:
    if plan.part is None:
        raise FileError("the plan names no part", where="part", remedy="Plan with a part: plan CELL PART --for workpiece.")
    return plan.part
