"""A pose taken many times is one view: its repeats add no rank, and end in `fail` with the reason, by whatever method."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate.camera_error import PillowError
from calibrate.distinct_views import count_distinct_views, is_starved, most_rank
from calibrate.problem import LengthConstraint
from calibrate.solve import CalibrationSettings, calibrate
from drivers.files.session import read_session
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from tests.support.solving import draw_shots, problem_of
from tests.support.synthetic import SyntheticCell, SyntheticShot, paper_cell, sample_cap
from tests.support.synthetic_session import write_session


def taken_again(cell: SyntheticCell, joints_rad: FloatArray, rng: np.random.Generator) -> SyntheticShot:
    """A shot from reported axis angles, its true pose and its points with noise of their own."""
    noise = np.concatenate([rng.normal(0, 0.01, 3), rng.normal(0, 1e-4, 3)])
    base_from_camera = cell.true_base_from_flange(joints_rad) @ se3.exp(noise) @ cell.flange_from_camera
    points = sample_cap(se3.apply(se3.inverse(base_from_camera), cell.centre_in_base_mm), cell.radius_mm, 300, rng)
    points[:, 2] += cell.camera_error_mm(points) + rng.normal(0, 0.08, len(points))
    return SyntheticShot(joints_rad, points, base_from_camera)


@pytest.mark.parametrize("has_guess", [True, False])
@pytest.mark.parametrize("n_poses", [1, 2])
@pytest.mark.parametrize("method", ["clouds", "centres", "stepwise"])
def test_repeats_of_one_or_two_poses_fail_with_the_reason(method: str, n_poses: int, has_guess: bool, tmp_path: Path) -> None:
    cell, rng = paper_cell(coupled=True), np.random.default_rng(9)
    few = draw_shots(cell, rng, n_poses, n_points=10)
    shots = [taken_again(cell, shot.joints_rad, rng) for _ in range(20 // n_poses) for shot in few]
    folder = write_session(tmp_path / "s", cell, {"A": shots}, flange_from_camera=cell.flange_from_camera if has_guess else None)
    found = calibrate([read_session(folder)], CalibrationSettings(method=method))
    assert found.verdict == "fail"
    assert f"20 shots are of {n_poses} distinct pose" in found.reasons[0]
    assert found.statistics.used == len(shots), found.rejected
    assert found.statistics.rank <= 3 * (n_poses - 1) + len(found.camera_error.axis)


def test_views_are_counted_by_pose_branch_and_sphere_in_any_order() -> None:
    cell, rng = paper_cell(), np.random.default_rng(3)
    shots = draw_shots(cell, rng, 5, n_points=3)
    other_branch = replace(shots[0], joints_rad=shots[0].joints_rad + np.array([0, 0, 0, 2 * np.pi, 0, 0]))
    nearly = replace(shots[1], joints_rad=shots[1].joints_rad + rng.normal(0, 1e-4, 6))
    everything = [*shots, *shots, other_branch, nearly]
    problem = problem_of(cell, {"A": everything, "B": shots[:2]}, PillowError())
    assert count_distinct_views(problem) == 6 + 2
    backwards = problem_of(cell, {"A": everything[::-1], "B": shots[1::-1]}, PillowError())
    assert count_distinct_views(backwards) == 6 + 2
    length = LengthConstraint(0, 1, 500.0, 0.01)
    # each view three numbers, less three for each sphere's unknown place; a length tells one, the camera its own terms
    assert most_rank(replace(problem, lengths=(length,))) == 3 * (8 - 2) + 1 + 3
    assert is_starved(problem)
    assert not is_starved(problem_of(cell, draw_shots(cell, rng, 9, n_points=3)))
