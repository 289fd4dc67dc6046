"""Plans in rooms full of things, looked at again by a check that shares no code with the planner; and what planned poses are worth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from acquire.collision import DEFAULT_SETTINGS
from acquire.sweep import STEP_RAD, touching_ways
from calibrate.design import choose_shots, predicted_of_shots
from drivers.models import load_robot_model
from measure.planning import NO_WAY, PlanSettings, Purpose, make_plan
from tests.support.designing import random_rows, volume_case
from tests.support.room import ROOMS, least_room_mm, points_of_ways, room
from tests.support.solving import one_thread

FIRST_SEED = 9400
MODELS = ("abb_irb1410", "ur5e", "ur10e")


def check_plan(folder: Path, name: str, kind: str, seed: int, purpose: Purpose, n: int, finer: int = 10) -> None:
    """A plan has its poses, and a finer look finds nothing touched anywhere."""
    cell, model = room(folder, name, kind, seed), load_robot_model(name)
    result = make_plan(cell, PlanSettings(purpose, n, seed=seed))
    poses = result.plan.poses
    least_mm = least_room_mm(cell, model, points_of_ways(poses, STEP_RAD / finer))
    detours = sum(len(pose.via_rad) > 1 for pose in poses)
    print(f"{name} {kind} seed {seed} {purpose}: {len(poses)} poses, {result.n_one_sided} one-sided, {detours} detours, least room {least_mm:.1f} mm")
    assert touching_ways(poses, cell, model) == ()
    assert least_mm > DEFAULT_SETTINGS.way_margin_mm - 0.5
    assert len(poses) == n - result.rejected.get(NO_WAY, 0) >= 0.9 * n
    assert result.n_one_sided >= 0.8 * len(poses)


@pytest.mark.qualify
@pytest.mark.parametrize("purpose", ["calibration", "verification"])
@pytest.mark.parametrize("kind", ROOMS)
@pytest.mark.parametrize("name", MODELS)
def test_no_pose_and_no_way_touches_anything(name: str, kind: str, purpose: Purpose, tmp_path: Path) -> None:
    for seed in (FIRST_SEED, FIRST_SEED + 1):
        check_plan(tmp_path, name, kind, seed, purpose, 40)


def test_no_pose_and_no_way_touches_anything_in_one_room(tmp_path: Path) -> None:
    check_plan(tmp_path, "ur5e", "boxes", FIRST_SEED, "verification", 8, finer=2)


@pytest.mark.parametrize("n_cells", [pytest.param(8, marks=pytest.mark.qualify), 1])
def test_forty_planned_poses_are_expected_to_do_what_seventy_random_ones_do(n_cells: int) -> None:
    found = []
    for seed in range(FIRST_SEED + 100, FIRST_SEED + 100 + n_cells):
        case, rng = volume_case("bar3", per_sphere=40, camera_error="field" if n_cells > 1 else "affine", seed=seed), np.random.default_rng(seed)
        with one_thread():
            chosen = choose_shots(case.scene, case.aim, case.joints_rad, case.sphere, 40).predicted.length_rms_mm
            rows = [random_rows(case, 72, rng) for _ in range(3 if n_cells > 1 else 1)]
            random = [predicted_of_shots(case.scene, case.aim, case.joints_rad[r], case.sphere[r]).length_rms_mm for r in rows]
        found.append((chosen, float(np.median(random))))
        print(f"seed {seed}: 40 chosen {chosen:.4f}, 72 random {np.round(random, 4)}")
    chosen_mm, random_mm = np.median(found, axis=0)
    print(f"medians {chosen_mm:.4f} {random_mm:.4f}")
    assert chosen_mm <= random_mm
