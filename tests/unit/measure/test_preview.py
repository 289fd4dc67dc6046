"""Previews: the way that a run drives, without gaps, and red wherever something known is touched."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rerun.chunk import RrdReader

from acquire.cell import Cell, load_cell, robot_model_of
from acquire.collision import cell_collisions
from acquire.plan import Plan, PlannedPose, write_plan
from acquire.sweep import STEP_RAD, swept_ways, way_between, way_text
from drivers.files.yaml import dump_yaml
from drivers.kinematics import mdh
from drivers.kinematics.se3 import FloatArray
from measure.cli import app
from measure.cli_run import run_app
from measure.plan_scene import preview_of
from measure.viewer import write_recording
from measure.viewer_surroundings import pieces_of

ANGLES = st.lists(st.floats(-3, 3), min_size=3, max_size=3)
# stretched out to the -x side of a UR5e, on both sides of a wall, and far from it
FAR, LEFT, RIGHT = ([q, -0.3, 0.3, 0.0, 0.5, 0.0] for q in (1.8, 1.5, -1.5))
OBSTACLES = [
    {"name": "wall", "kind": "box", "size_mm": [20, 300, 4000], "centre_in_base_mm": [-500, 0, 0], "rotation_deg": [0, 0, 5]},
    {"name": "post", "kind": "cylinder", "diameter_mm": 60, "height_mm": 500, "centre_in_base_mm": [2000, 0, 0]},
    {"name": "part", "kind": "mesh", "file": "part.stl", "centre_in_base_mm": [2000, 500, 0], "scale": 1000},
]


@pytest.fixture
def cell(tmp_path: Path) -> Cell:
    import trimesh

    trimesh.creation.box(extents=(0.1, 0.2, 0.3)).export(tmp_path / "part.stl")
    data = {
        "format": "spherecal-cell/1",
        "name": "preview",
        "robot": {"driver": "recorded", "model": "ur5e"},
        "camera": {"driver": "recorded"},
        "flange_from_camera": np.eye(4).tolist(),
        "spheres": {"A": {"diameter_mm": 38.1, "expanded_uncertainty_mm": 0.001, "centre_in_base_mm": [500, 0, 1000]}},
        "obstacles": OBSTACLES,
    }
    path = tmp_path / "cell.yaml"
    path.write_text(dump_yaml(data), encoding="utf-8")
    return load_cell(path)


def plan_of(cell: Cell, *joints: list[float], via: list[float] | None = None) -> Plan:
    poses = [PlannedPose(f"p{i}", "A", np.array(q)) for i, q in enumerate(joints)]
    if via is not None:
        poses[-1] = PlannedPose(poses[-1].id, None, poses[-1].joints_rad, (np.array(via),))
    return Plan(cell.sha256, "calibration", tuple(poses))


@given(ANGLES, st.lists(ANGLES, max_size=3), ANGLES)
def test_a_way_has_no_gaps_and_passes_its_via_points(first: list[float], via: list[list[float]], last: list[float]) -> None:
    pose = PlannedPose("b", None, np.array(last), tuple(np.array(point) for point in via))
    way = way_between(PlannedPose("a", None, np.array(first)), pose)
    assert np.abs(np.diff(way, axis=0)).max() <= STEP_RAD + 1e-12
    for point in (first, *via, last):
        assert np.abs(way - point).max(axis=1).min() < 1e-12
    length = sum(np.linalg.norm(np.subtract(b, a)) for a, b in zip([first, *via], [*via, last], strict=True))
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).sum() == pytest.approx(length, abs=1e-9)


@given(st.lists(st.booleans(), max_size=30))
def test_pieces_cover_every_step_of_a_path_once_and_red_is_where_something_touches(touches: list[bool]) -> None:
    clear, touching = pieces_of(np.array(touches, dtype=np.bool_))
    steps = [(i, False) for piece in clear for i in range(piece.start, piece.stop - 1)]
    steps += [(i, True) for piece in touching for i in range(piece.start, piece.stop - 1)]
    assert sorted(steps) == [(i, touches[i] or touches[i + 1]) for i in range(max(0, len(touches) - 1))]


def test_what_touches_is_what_a_ten_times_finer_look_finds(cell: Cell) -> None:
    model = robot_model_of(cell)
    assert model is not None
    blocked = cell_collisions(cell, model)
    over = [1.5, -1.6, 0.3, 0.0, 0.5, 0.0]
    plan = plan_of(cell, FAR, LEFT, RIGHT, over)
    found = swept_ways(plan.poses, blocked)
    finer = swept_ways(plan.poses, blocked, STEP_RAD / 10)
    assert [bool(way.touches.any()) for way in found] == [bool(way.touches.any()) for way in finer]
    assert [bool(way.touches.any()) for way in found][:3] == [False, False, True]
    assert way_text(found[2]) == "the way from p1 to p2 touches something"
    assert not any(way.touches.any() for way in swept_ways(plan.poses, None))


def test_the_scene_is_the_plan(cell: Cell) -> None:
    model = robot_model_of(cell)
    assert model is not None
    plan = plan_of(cell, LEFT, RIGHT)
    found = preview_of(plan, cell, model)
    steps = found.scene.steps
    at_poses = [step for step in steps if step.label.startswith("pose")]
    for step, pose in zip(at_poses, plan.poses, strict=True):
        np.testing.assert_allclose(step.base_from_links, mdh.chain(model, pose.joints_rad), atol=1e-9)
    # the arm is shown under way too, and its camera is never far from where it was shown before
    assert len(steps) > 15
    places: FloatArray = np.array([step.base_from_camera[:3, 3] for step in steps])
    camera = next(path for path in found.scene.paths if path.name == "camera")
    assert np.linalg.norm(camera.points_in_base_mm[:, None] - places, axis=2).min(axis=0).max() < 1e-6
    assert any("TOUCHES" in step.label for step in steps)
    wall, post, part = found.scene.solids
    np.testing.assert_allclose(np.ptp(post.vertices_in_base_mm, axis=0), [60, 60, 500], atol=0.5)
    np.testing.assert_allclose(np.ptp(part.vertices_in_base_mm, axis=0), [100, 200, 300], atol=1e-3)
    np.testing.assert_allclose(wall.vertices_in_base_mm.mean(axis=0), [-500, 0, 0], atol=1e-6)
    assert "the way from p0 to p1 touches something" in found.scene.texts["plan"]


def test_the_recording_holds_paths_and_solids(cell: Cell, tmp_path: Path) -> None:
    model = robot_model_of(cell)
    assert model is not None
    path = write_recording(tmp_path / "preview.rrd", preview_of(plan_of(cell, LEFT, RIGHT), cell, model).scene)
    entities = {str(chunk.entity_path) for chunk in RrdReader(str(path)).stream()}
    assert {"/base/paths/0/touching", "/base/paths/1/clear", "/base/solids/2", "/base/camera"} <= entities


def test_the_command(cell: Cell, tmp_path: Path, capfd: Any) -> None:
    def run(*arguments: object) -> tuple[int, dict[str, Any]]:
        code = run_app(app, ["preview", *map(str, arguments), "--json"])
        return code, json.loads(capfd.readouterr().out)

    plan = tmp_path / "plan.yaml"
    write_plan(plan_of(cell, FAR, LEFT, RIGHT), plan)
    code, told = run(plan)
    assert (code, told["n_poses"], told["touching"], told["out"]) == (3, 3, [{"from": "p1", "to": "p2"}], str(tmp_path / "plan.rrd"))
    assert (tmp_path / "plan.rrd").stat().st_size > 1000
    write_plan(plan_of(cell, FAR, LEFT), plan)
    assert run(plan, "--cell", cell.path, "-o", tmp_path / "other.rrd")[0] == 0
    write_plan(plan_of(cell), plan)
    code, told = run(plan)
    assert (code, told["error"]["message"]) == (1, "holds no poses")
    assert run(tmp_path / "nowhere" / "plan.yaml")[0] == 1
