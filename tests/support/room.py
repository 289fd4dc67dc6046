"""Rooms full of things for ways between poses, and a look at them that shares no code with the planner's.

The arm is taken as points on the middle lines of its capsules; the distance of a point to a box, cylinder or sphere is written
down directly.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from acquire.cell import Cell, load_cell
from acquire.obstacles import BoxObstacle, CylinderObstacle
from acquire.plan import PlannedPose
from drivers.files.yaml import dump_yaml
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

ROOMS = ("table", "stands", "boxes", "bars")
_MOUNT = [[0.0, -1.0, 0.0, 60.0], [1.0, 0.0, 0.0, 60.0], [0.0, 0.0, 1.0, 85.0], [0.0, 0.0, 0.0, 1.0]]
_SCALE = {"ur5e": 0.55, "ur10e": 0.8}
_CAMERA_RADIUS_MM = 70.0
_POINTS_PER_CAPSULE = 25


def room(folder: Path, model_name: str, kind: str, seed: int = 0) -> Cell:
    """A cell with things in the way: a table; spheres on stands; boxes and a wall; two ball bars."""
    rng, scale = np.random.default_rng([seed, 77]), _SCALE.get(model_name, 1.0)
    places = np.array([(800, 230, 330), (830, -240, 300), (980, 40, 420)]) * scale + rng.uniform(-25, 25, (3, 3))
    table_mm = -20.0 if model_name.startswith("ur") else 60.0
    if kind == "bars":
        places = np.array([(800, -250, 300), (800, 250, 300), (720, 60, 330), (1020, -20, 480)]) * scale + rng.uniform(-15, 15, (4, 3))
    obstacles: list[dict[str, object]] = [
        {"name": "table", "kind": "box", "centre_in_base_mm": [950 * scale, 0, table_mm - 20], "size_mm": [1100 * scale, 1500, 40]}
    ]
    if kind != "table":
        obstacles += [_stand(i, place, table_mm) for i, place in enumerate(places)]
    if kind == "boxes":
        obstacles += [
            {
                "name": "wall",
                "kind": "box",
                "centre_in_base_mm": [600 * scale, 620 * scale, 500],
                "size_mm": [900, 30, 1200],
                "rotation_deg": [0, 0, 8],
            },
            {"name": "crate", "kind": "box", "centre_in_base_mm": [900 * scale, -20, table_mm + 90 * scale], "size_mm": [160 * scale] * 3},
        ]
    if kind == "bars":
        obstacles += [_bar(f"bar{i}", places[2 * i], places[2 * i + 1]) for i in range(2)]
    data = {
        "format": "spherecal-cell/1",
        "name": f"{model_name} {kind}",
        "robot": {"driver": "simulated", "model": model_name},
        "camera": {"driver": "simulated", "working_range_mm": [250, 450], "field_of_view_deg": [55, 36]},
        "flange_from_camera": _MOUNT,
        "spheres": {
            "ABCD"[i]: {"diameter_mm": 38.1, "expanded_uncertainty_mm": 0.001, "centre_in_base_mm": place.round(2).tolist()}
            for i, place in enumerate(places)
        },
        "obstacles": obstacles,
    }
    path = folder / f"{model_name}_{kind}_{seed}.yaml"
    path.write_text(dump_yaml(data), encoding="utf-8")
    return load_cell(path)


def _stand(i: int, place: FloatArray, table_mm: float) -> dict[str, object]:
    height = float(place[2] - 20 - table_mm)
    centre = [round(float(place[0]), 2), round(float(place[1]), 2), table_mm + height / 2]
    return {"name": f"stand{i}", "kind": "cylinder", "centre_in_base_mm": centre, "diameter_mm": 25, "height_mm": height}


def _bar(name: str, first: FloatArray, second: FloatArray) -> dict[str, object]:
    """A tube 12 mm below the line between two spheres."""
    way = second - first
    length = float(np.linalg.norm(way))
    tilt, azimuth = np.arccos(way[2] / length), np.arctan2(way[1], way[0])
    centre = 0.5 * (first + second) - [0, 0, 12]
    turn = [0.0, float(np.degrees(tilt)), float(np.degrees(azimuth))]
    return {"name": name, "kind": "cylinder", "centre_in_base_mm": centre.tolist(), "rotation_deg": turn, "diameter_mm": 16, "height_mm": length - 40}


def points_of_ways(poses: Sequence[PlannedPose], step_rad: float) -> FloatArray:
    """(k, n) axis angles on all ways of a plan, so close together."""
    corners = [point for pose in poses for point in (*pose.via_rad, pose.joints_rad)]
    pieces = [a + np.linspace(0, 1, 2 + int(np.abs(b - a).max() / step_rad))[:, None] * (b - a) for a, b in pairwise(corners)]
    return np.concatenate([corners[0][None], *pieces])


def least_room_mm(cell: Cell, model: RobotModel, joints_rad: FloatArray) -> float:
    """The least distance (k) of arm and camera to the things of the cell and to each other over poses (k, n), in pieces of memory."""
    parts = np.array_split(joints_rad, max(1, len(joints_rad) // 400))
    return min(float(np.minimum(_to_things_mm(cell, model, part), _to_itself_mm(cell, model, part)).min()) for part in parts)


def _lines(cell: Cell, model: RobotModel, joints: FloatArray) -> list[tuple[int, float, FloatArray]]:
    """Link, radius, and points (k, p, 3) in the base of every capsule, the camera's last."""
    share = np.linspace(0, 1, _POINTS_PER_CAPSULE)[:, None]
    frames = mdh.chain(model, joints)
    bodies = [(c.link, c.radius_mm, np.array(c.start_mm), np.array(c.end_mm)) for c in model.shape]
    bodies.append((model.n_joints, _CAMERA_RADIUS_MM, np.zeros(3), np.asarray(cell.flange_from_camera)[:3, 3]))
    return [(link, radius, se3.apply(frames[:, None, link], a + share * (b - a))) for link, radius, a, b in bodies]


def _to_things_mm(cell: Cell, model: RobotModel, joints: FloatArray) -> FloatArray:
    least = np.full(len(joints), np.inf)
    for link, radius, points in _lines(cell, model, joints):
        if link < 2:
            continue
        for sphere in cell.spheres.values():
            distance = np.linalg.norm(points - np.array(sphere.centre_in_base_mm), axis=-1) - sphere.radius_mm
            least = np.minimum(least, distance.min(axis=1) - radius)
        for thing in cell.obstacles:
            inside = se3.apply(se3.inverse(thing.base_from_obstacle), points)
            if isinstance(thing, BoxObstacle):
                distance = np.linalg.norm(np.maximum(np.abs(inside) - np.array(thing.size_mm) / 2, 0), axis=-1)
            elif isinstance(thing, CylinderObstacle):
                beside = np.maximum(np.hypot(inside[..., 0], inside[..., 1]) - thing.diameter_mm / 2, 0)
                distance = np.hypot(beside, np.maximum(np.abs(inside[..., 2]) - thing.height_mm / 2, 0))
            else:
                raise NotImplementedError(thing.kind)
            least = np.minimum(least, distance.min(axis=1) - radius)
    return least


def _to_itself_mm(cell: Cell, model: RobotModel, joints: FloatArray) -> FloatArray:
    """Links three or more apart, and the end of the camera against the forearm."""
    lines, least = _lines(cell, model, joints), np.full(len(joints), np.inf)
    eye = (lines[-1][0] + 1, lines[-1][1], lines[-1][2][:, -1:])
    for first in lines:
        for second in (*lines, eye):
            if second[0] - first[0] >= 3:
                apart = np.linalg.norm(first[2][:, :, None] - second[2][:, None], axis=-1).min(axis=(1, 2))
                least = np.minimum(least, apart - first[1] - second[1])
    return least
