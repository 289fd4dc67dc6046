"""Plans that cover a part: what is counted as seen is seen, by another geometry and by the simulated camera; the way to the stitched cloud."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from acquire.cell import load_cell, robot_model_of
from acquire.coverage import NO_POSE, OCCLUDED, OUT_OF_VIEW, SEEN, TOO_FEW, TOO_FLAT, Sights, Surface, choose_cover, surface_of
from acquire.obstacles import MeshObstacle
from acquire.plan import load_plan, with_part
from acquire.sweep import touching_ways
from acquire.visibility import CameraView
from drivers.files.session import read_scan, read_session
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.workpiece import stepped_block
from measure.cli import app
from measure.cli_run import run_app
from measure.covering import placed_part, views_of_triangles
from measure.demo_cell import TABLE_TOP_MM, WORKPIECE_CENTRE_MM, write_demo_cell
from measure.plan_scene import preview_of

VIEW = CameraView((250.0, 450.0), (float(np.radians(27.5)), float(np.radians(18))))
TURN_DEG = float(np.degrees(0.35))
DOWN = np.diag([1.0, -1.0, -1.0])


def test_points_lie_evenly_on_their_triangles() -> None:
    box = trimesh.creation.box((100, 50, 20))
    surface = surface_of(np.asarray(box.vertices), np.asarray(box.faces), 2000, np.random.default_rng(0))
    half = np.array([50, 25, 10])
    np.testing.assert_allclose(np.abs(surface.points_in_base_mm / half).max(axis=1), 1, atol=1e-9)
    np.testing.assert_allclose((surface.points_in_base_mm * surface.normals_in_base).sum(axis=1), np.abs(surface.normals_in_base) @ half, atol=1e-9)
    top = (surface.normals_in_base[:, 2] > 0.5).mean()
    assert top == pytest.approx(100 * 50 / (2 * (100 * 50 + 100 * 20 + 50 * 20)), abs=0.01)


def test_every_stage_is_what_it_says() -> None:
    points = np.array([[0.0, 0, 0], [0, 0, 0], [400, 0, 0], [0, 0, 200], [60, 0, 0], [0, 0, 0]])
    flat = np.array([0.0, np.sin(np.radians(61)), np.cos(np.radians(61))])
    normals = np.array([[0.0, 0, 1], flat, [0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, -1]])
    shade = trimesh.creation.box((20, 20, 2))
    shade.apply_translation([40, 0, 100])
    sights = Sights([(np.asarray(shade.vertices), np.asarray(shade.faces))])
    eye = se3.from_rotation_translation(DOWN, [0.0, 0, 350])
    expected = [[SEEN, TOO_FLAT, OUT_OF_VIEW, OUT_OF_VIEW, OCCLUDED, TOO_FLAT]]
    np.testing.assert_array_equal(sights.stages(VIEW, eye[None], Surface(points, normals)), expected)


def test_the_cover_takes_what_adds_most_and_says_why_the_rest_is_not_seen() -> None:
    stages = np.full((4, 10), OCCLUDED, dtype=np.uint8)
    stages[0, :5], stages[1, 4:8], stages[2, 8], stages[3, 5:9] = SEEN, SEEN, SEEN, SEEN
    feasible = np.array([True, True, False, True])
    both = choose_cover(stages, feasible, 9)
    # the second sees as much as the last, and overlaps with the first
    assert both.rows[:2] == (0, 1)
    assert both.not_covered == {"occluded": 0.1}
    assert choose_cover(stages, feasible, 1).not_covered == pytest.approx({TOO_FEW: 0.4, "occluded": 0.1})
    assert choose_cover(stages, np.array([True, True, False, False]), 9).not_covered == pytest.approx({NO_POSE: 0.1, "occluded": 0.1})
    assert choose_cover(stages, ~np.ones(4, dtype=np.bool_), 9).rows == ()


def test_a_part_is_planned_looked_at_captured_and_seen_where_it_was_promised(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = write_demo_cell(tmp_path, 0, (160, 100))
    vertices, faces = stepped_block()
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "block.stl")
    out, place = tmp_path / "part.yaml", [*WORKPIECE_CENTRE_MM, 0, 0, TURN_DEG]
    assert run_app(app, ["plan", str(path), str(tmp_path / "block.stl"), "--for", "workpiece", "--json", "-n", "20", "-o", str(out)]) == 1
    assert "--placed" in json.loads(capfd.readouterr().out)["error"]["remedy"]
    arguments = ["plan", str(path), str(tmp_path / "block.stl"), "--for", "workpiece", "--placed", *map(str, place), "-n", "20", "-o", str(out)]
    assert run_app(app, [*arguments, "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    coverage = told["coverage"]
    # the underside stands on the table and some faces lie inside: about 45 % of all triangles can be seen by nobody
    assert coverage["covered_fraction"] > 0.48
    assert coverage["covered_fraction"] + sum(coverage["not_covered"].values()) == pytest.approx(1, abs=1e-3)
    assert coverage["seen_twice_fraction"] > 0.15
    assert told["predicted"] == {"centre_rms_mm": None, "length_rms_mm": None}
    cell = load_cell(path)
    model = robot_model_of(cell)
    assert model is not None
    plan = load_plan(out, cell, model)
    assert (plan.purpose, {pose.sphere for pose in plan.poses}) == ("workpiece", {None})
    assert touching_ways(plan.poses, with_part(cell, plan), model) == ()
    part = next(solid for solid in preview_of(plan, cell, model).scene.solids if solid.name == "part")
    assert part.views is not None
    assert (part.views > 0).any()

    session = tmp_path / "session"
    assert run_app(app, ["capture", str(path), str(out), "-o", str(session), "--yes", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["n_shots"] == len(plan.poses)
    small, triangles, views = views_of_triangles(plan, cell, model)
    seen = _measured(session, np.asarray(cell.flange_from_camera), model)
    middles = small[triangles].mean(axis=1)[views > 0]
    nearest = cKDTree(seen).query(middles[::7])[0]
    # the arm of the simulation has errors of some mm
    assert np.quantile(nearest, 0.95) < 8
    assert seen[:, 2].max() > TABLE_TOP_MM + 70


def _measured(session: Path, flange_from_camera: FloatArray, model: RobotModel) -> FloatArray:
    """(n, 3) all points of a session, nominally in the base."""
    clouds = []
    read = read_session(session)
    for shot in read.shots:
        assert shot.joints_rad is not None
        points = read_scan(read, shot).xyz_mm.reshape(-1, 3)[::11]
        clouds.append(se3.apply(mdh.base_from_flange(model, shot.joints_rad) @ flange_from_camera, points[np.isfinite(points).all(axis=1)]))
    return np.concatenate(clouds)


def test_a_part_among_the_obstacles_needs_no_place(tmp_path: Path) -> None:
    trimesh.creation.box((10, 10, 10)).export(tmp_path / "part.stl")
    cell = load_cell(write_demo_cell(tmp_path, 0))
    part = MeshObstacle(name="housing", kind="mesh", file="part.stl", centre_in_base_mm=(1, 2, 3))
    standing = cell.model_copy(update={"obstacles": (*cell.obstacles, part)})
    assert placed_part(standing, tmp_path / "part.stl", None) == part
    there = placed_part(cell, tmp_path / "part.stl", [4, 5, 6, 0, 0, 90])
    assert (there.file, there.centre_in_base_mm, there.rotation_deg) == ("part.stl", (4, 5, 6), (0, 0, 90))
