"""From a plan to the `Scene` of its preview: the arm on its way from pose to pose, its paths, and what stands around."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from acquire.capture_settings import planned_seconds, settings_of
from acquire.cell import Cell
from acquire.collision import cell_collisions
from acquire.obstacles import Obstacle, solid_of
from acquire.plan import Plan, with_part
from acquire.sweep import SweptWay, swept_ways, way_text
from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from measure.covering import views_of_triangles
from measure.scene import PathMark, Scene, SolidMark, SphereMark, Step

_SHOWN_STEP_RAD = np.radians(8.0)
"""Between two pictures of the arm under way; collisions are looked for in finer steps."""
_NONE = np.empty((0, 3))
_DEFAULT_VIEW_DEG = (40.0, 30.0)
_DEFAULT_DEPTH_MM = 350.0


@dataclass(frozen=True, slots=True, eq=False)
class Preview:
    """A plan looked at before anything moves."""

    scene: Scene
    ways: tuple[SweptWay, ...]
    seconds: float
    """About how long the run takes."""

    @property
    def touching(self) -> tuple[SweptWay, ...]:
        """Ways that touch something that the cell file knows."""
        return tuple(way for way in self.ways if way.touches.any())


def preview_of(plan: Plan, cell: Cell, model: RobotModel) -> Preview:
    """The preview of a plan by the nominal robot.

    Raises:
        FileError: a mesh of an obstacle cannot be read.
    """
    cell = with_part(cell, plan)
    ways = swept_ways(plan.poses, cell_collisions(cell, model))
    seconds = planned_seconds(plan.poses, settings_of(cell))
    hand_eye = np.eye(4) if cell.flange_from_camera is None else np.asarray(cell.flange_from_camera, dtype=np.float64)
    depth = _DEFAULT_DEPTH_MM if cell.camera.working_range_mm is None else float(np.mean(cell.camera.working_range_mm))
    is_area = cell.camera.kind == "area"
    places = [(name, sphere) for name, sphere in cell.spheres.items() if sphere.centre_in_base_mm is not None]
    scene = Scene(
        title=f"plan for {cell.name}",
        steps=tuple(step for way in ways for step in _steps(way, model, hand_eye)),
        spheres=tuple(SphereMark(name, np.array(sphere.centre_in_base_mm), sphere.radius_mm) for name, sphere in places),
        texts={"plan": _summary(plan, cell, ways, seconds)},
        shape=model.shape,
        field_of_view_deg=(cell.camera.field_of_view_deg or _DEFAULT_VIEW_DEG) if is_area else None,
        depth_mm=depth,
        solids=tuple(_solid(obstacle, plan, cell, model) for obstacle in cell.obstacles),
        paths=_paths(ways, model, hand_eye),
    )
    return Preview(scene, ways, seconds)


def _steps(way: SweptWay, model: RobotModel, hand_eye: FloatArray) -> Iterator[Step]:
    """The arm under way, thinned, and at the pose."""
    for i in _shown(way.joints_rad):
        links = mdh.chain(model, way.joints_rad[i])
        at_pose = i == len(way.joints_rad) - 1
        where = f"pose {way.pose.id}, {_aim(way)}" if at_pose else f"on the way to {way.pose.id}"
        yield Step(where + (": TOUCHES something" if way.touches[i] else ""), links, links[-1] @ hand_eye, _NONE, _NONE)


def _shown(joints_rad: FloatArray) -> list[int]:
    """Rows to show, the last one always: no axis much further than a step from one to the next."""
    travelled = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(joints_rad, axis=0)).max(axis=1))])
    wanted = np.arange(0.0, travelled[-1], _SHOWN_STEP_RAD)
    return sorted({*np.searchsorted(travelled, wanted[1:]).tolist(), len(joints_rad) - 1})


def _paths(ways: Sequence[SweptWay], model: RobotModel, hand_eye: FloatArray) -> tuple[PathMark, ...]:
    """Of the camera and of the flange, through all poses."""
    joints, touches = np.concatenate([way.joints_rad for way in ways]), np.concatenate([way.touches for way in ways])
    flange = mdh.base_from_flange(model, joints)
    return (PathMark("camera", (flange @ hand_eye)[:, :3, 3], touches), PathMark("flange", flange[:, :3, 3], touches))


def _solid(obstacle: Obstacle, plan: Plan, cell: Cell, model: RobotModel) -> SolidMark:
    """An obstacle, or the plan's part coloured by the poses that see it."""
    sees = cell.flange_from_camera is not None and cell.camera.working_range_mm is not None and cell.camera.field_of_view_deg is not None
    if obstacle != plan.part or not sees:
        return SolidMark(obstacle.name, *solid_of(obstacle, cell.folder))
    return SolidMark(obstacle.name, *views_of_triangles(plan, cell, model))


def _aim(way: SweptWay) -> str:
    return "no sphere" if way.pose.sphere is None else f"sphere {way.pose.sphere}"


def _summary(plan: Plan, cell: Cell, ways: Sequence[SweptWay], seconds: float) -> str:
    touching = [way for way in ways if way.touches.any()]
    known = ", ".join(obstacle.name for obstacle in cell.obstacles) or "none"
    lines = [
        f"# {len(plan.poses)} poses for {cell.name}",
        "",
        f"purpose **{plan.purpose}**, about {seconds / 60:.0f} min at {cell.motion.speed_rad_s:g} rad/s",
        "",
        "Drag the time slider: the arm goes from pose to pose, straight in axis angles and over the via points, by the nominal robot.",
        *(["The part: red is seen by no pose, amber by one, green by two, teal by three and more.", ""] if plan.part is not None else []),
        "Green lines: ways of the camera and of the flange. Red: something is touched there, margins included.",
        "",
        f"Obstacles of the cell file: {known}. What stands in no file (sphere stands, cables, people) is not seen.",
        "",
        *(f"* {way_text(way)}" for way in touching),
    ]
    return "\n".join(lines if touching else [*lines, "Nothing that the cell file knows is touched."])
