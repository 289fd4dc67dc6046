"""Plans: what the CLI promises about them, on the demo's cell."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import Cell, load_cell, robot_model_of
from acquire.collision import cell_collisions
from acquire.plan import Plan, PlannedPose, load_plan, write_plan
from acquire.sweep import touching_ways
from drivers.errors import SettingsError
from drivers.kinematics import mdh, se3
from measure.cli import app
from measure.cli_run import run_app
from measure.demo_cell import TABLE_TOP_MM, true_centres_in_base_mm, write_demo_cell
from measure.planning import NO_WAY, PlanSettings, make_plan


@pytest.fixture(scope="module")
def cell_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_demo_cell(tmp_path_factory.mktemp("cell"), 0)


@pytest.fixture(scope="module")
def cell(cell_path: Path) -> Cell:
    return load_cell(cell_path)


def test_plan_writes_a_plan_that_loads_and_tells_the_contracts_keys(cell_path: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "plan.yaml"
    assert run_app(app, ["plan", str(cell_path), "-n", "13", "-o", str(out), "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["n_candidates"] == told["n_feasible"] + sum(told["rejected"].values())
    cell = load_cell(cell_path)
    plan = load_plan(out, cell, robot_model_of(cell))
    assert told["predicted"] == plan.predicted
    assert 0.001 < told["predicted"]["length_rms_mm"] < 1
    assert 0.03 < told["predicted"]["centre_rms_mm"] < 1
    assert len(plan.poses) == len(told["poses"]) == 13
    assert plan.purpose == "calibration"
    assert {pose.sphere for pose in plan.poses} == set(cell.spheres)


def test_every_pose_sees_its_sphere(cell: Cell) -> None:
    model = robot_model_of(cell)
    if model is None:
        pytest.fail("the demo has a robot")
    for pose in make_plan(cell, PlanSettings(n_poses=30)).plan.poses:
        base_from_camera = mdh.base_from_flange(model, pose.joints_rad) @ np.asarray(cell.flange_from_camera)
        x, y, z = se3.apply(se3.inverse(base_from_camera), np.array(cell.spheres[str(pose.sphere)].centre_in_base_mm))
        assert 250 < z < 450
        assert abs(x) < z * np.tan(np.radians(27.5))
        assert abs(y) < z * np.tan(np.radians(18))
        assert base_from_camera[2, 3] > TABLE_TOP_MM


def test_what_a_plan_drives_is_clear_one_sided_and_begins_where_the_robot_stands(cell: Cell) -> None:
    model = robot_model_of(cell)
    assert model is not None
    start = np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0])
    result = make_plan(cell, PlanSettings("verification", n_poses=10, start_rad=start))
    poses = result.plan.poses
    assert touching_ways([PlannedPose("start", None, start), *poses], cell, model) == ()
    assert len(poses) == 10 - result.rejected.get(NO_WAY, 0)
    assert result.n_one_sided >= 8
    assert sum(bool(pose.via_rad) and bool((pose.joints_rad > pose.via_rad[-1]).all()) for pose in poses) >= 8
    assert result.n_candidates == result.n_feasible + sum(result.rejected.values())


def test_an_edited_plan_is_refused_by_capture_where_it_touches_something(cell: Cell, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    poses = make_plan(cell, PlanSettings("verification", n_poses=10)).plan.poses
    model = robot_model_of(cell)
    assert model is not None
    lower = poses[0].joints_rad + np.linspace(-1, 1, 41)[:, None] * np.eye(6)[1]
    lower = lower[mdh.within_limits(model, lower)]
    into_table = lower[np.argmax(cell_collisions(cell, model)(lower))]
    edited = Plan(cell.sha256, "verification", (poses[0], PlannedPose("low", None, into_table), *poses[1:]))
    write_plan(edited, tmp_path / "plan.yaml")
    arguments = ["capture", str(cell.path), str(tmp_path / "plan.yaml"), "-o", str(tmp_path / "session"), "--yes", "--json"]
    assert run_app(app, arguments) == 1
    error = json.loads(capfd.readouterr().out)["error"]
    assert "low itself touches something" in error["message"]
    assert "--touching" in error["remedy"]
    assert not (tmp_path / "session").exists()
    assert run_app(app, [*arguments, "--dry-run"]) == 0
    assert "pose low itself touches something" in json.loads(capfd.readouterr().out)["touching"]


def test_the_seed_makes_the_plan_and_purposes_differ(cell: Cell) -> None:
    def joints(settings: PlanSettings) -> list[tuple[float, ...]]:
        return [tuple(pose.joints_rad) for pose in make_plan(cell, settings).plan.poses]

    first = joints(PlanSettings(n_poses=12))
    assert joints(PlanSettings(n_poses=12)) == first
    assert not set(joints(PlanSettings(n_poses=12, seed=1))) & set(first)
    assert not set(joints(PlanSettings("verification", n_poses=12))) & set(first)


def test_a_verification_is_spread_and_predicts_nothing(cell: Cell) -> None:
    result = make_plan(cell, PlanSettings("verification", n_poses=12))
    told = result.to_json_dict()
    assert told["predicted"] == {"centre_rms_mm": None, "length_rms_mm": None}
    # G to I, and two thirds of the diagonal of 500 x 600 x 500 mm
    assert told["longest_length_mm"] == pytest.approx(629, abs=4)
    assert told["wanted_length_mm"] == pytest.approx(618.2, abs=0.1)


def test_a_calibration_plan_uses_several_branches_and_shares_its_poses(cell: Cell) -> None:
    poses = make_plan(cell, PlanSettings(n_poses=40, spheres=("A", "B", "C", "D"))).plan.poses
    counts = [sum(pose.sphere == name for pose in poses) for name in "ABCD"]
    assert sum(counts) == 40
    assert min(counts) >= 5
    assert len({bool(np.sin(pose.joints_rad[4]) > 0) for pose in poses}) == 2


def test_a_workpiece_plan_looks_at_its_region(cell: Cell) -> None:
    region = np.array([[930.0, -40, 60], [1110, 100, 140]])
    plan = make_plan(cell, PlanSettings("workpiece", 6, region_mm=region)).plan
    assert [pose.sphere for pose in plan.poses] == [None] * 6


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-n", "3"], "fewer than 10 spheres"),
        (["--sphere", "Z"], "no sphere 'Z'"),
        (["--for", "workpiece", "--region", "9", "9", "9", "0", "0", "0"], "no box"),
        (["--for", "workpiece", "--region", "5000", "0", "0", "5100", "100", "100"], "unreachable"),
    ],
)
def test_what_cannot_be_planned_is_told_and_leaves_nothing(
    arguments: list[str], words: str, cell_path: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_app(app, ["plan", str(cell_path), *arguments, "-o", str(tmp_path / "p.yaml")]) == 1
    err = capfd.readouterr().err
    assert words in err
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("model: irb1410_paper", "model: null", "robot model"),
        ("working_range_mm: [250, 450]", "working_range_mm: null", "working_range_mm"),
        ("\n    centre_in_base_mm", "\n    cte_per_k: 1.0e-6 #", "unknown place"),
    ],
)
def test_a_cell_that_lacks_something_is_told_what(old: str, new: str, words: str, cell_path: Path, tmp_path: Path) -> None:
    text = cell_path.read_text()
    assert old in text
    (tmp_path / "cell.yaml").write_text(text.replace(old, new))
    with pytest.raises(SettingsError, match=words):
        make_plan(load_cell(tmp_path / "cell.yaml"), PlanSettings())


def test_the_places_in_the_cell_file_are_near_but_not_the_truth(cell: Cell) -> None:
    for name, centre in true_centres_in_base_mm().items():
        off = np.abs(np.array(cell.spheres[name].centre_in_base_mm) - centre)
        assert 0.01 < off.max() < 2.1


def test_a_changed_cell_is_told(cell_path: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cell = load_cell(cell_path)
    out = tmp_path / "plan.yaml"
    assert run_app(app, ["plan", str(cell_path), "-n", "10", "-o", str(out), "-q"]) == 0
    changed = tmp_path / "cell.yaml"
    changed.write_text(cell_path.read_text() + "\n# a remark\n")
    with caplog.at_level(logging.WARNING):
        load_plan(out, load_cell(changed), robot_model_of(cell))
    assert "another state" in caplog.text
