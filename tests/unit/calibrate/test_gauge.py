"""What no shot can tell: finite motions of the unknowns that change no residual, and the rank that is left."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate.camera_error import CameraError, NoCameraError, PillowError
from calibrate.clouds import Solution, solve_clouds
from calibrate.identifiability import Identifiability, identifiability_of, parameter_names, parameter_scale
from calibrate.normal import NoiseModel, linearise, reduce
from calibrate.problem import Problem, State, linearise_geometry
from calibrate.solve import calibrate
from calibrate.sums import shot_moments
from calibrate.verdict import Evidence, judge
from drivers.files.session import read_session
from drivers.kinematics import se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from tests.support.bound import FIRST_NOISE
from tests.support.solving import bent_state, draw_shots, problem_of, start_of
from tests.support.synthetic import SyntheticCell, draw_view, paper_cell
from tests.support.synthetic_session import write_session

Gauge = Callable[[RobotModel, State, FloatArray], State]


def about_its_own_axis(link: int) -> Gauge:
    """Link i slides along and turns about axis i: the link before it can do the same, or the base for the first."""

    def move(model: RobotModel, state: State, six: FloatArray) -> State:
        screw = np.array([0, 0, six[2], 0, 0, six[5]])
        before = np.eye(4)
        before[:3, :3], before[0, 3] = se3.exp_so3([model.alpha_rad[link], 0, 0]), model.a_mm[link]
        moved_before = before @ se3.exp(screw) @ se3.inverse(before)
        xi = state.link_twists.copy()
        xi[link] = se3.log(se3.exp(screw) @ se3.exp(xi[link]))
        if link == 0:
            return replace(state, link_twists=xi, centres_in_base_mm=se3.apply(moved_before, state.centres_in_base_mm))
        xi[link - 1] = se3.log(se3.exp(xi[link - 1]) @ se3.inverse(moved_before))
        return replace(state, link_twists=xi)

    return move


def between_flange_and_hand(model: RobotModel, state: State, six: FloatArray) -> State:
    """The last link's twist and the hand-eye transform are one."""
    xi = state.link_twists.copy()
    xi[-1] = se3.log(se3.exp(xi[-1]) @ se3.exp(six))
    return replace(state, link_twists=xi, flange_from_camera=se3.exp(-six) @ state.flange_from_camera)


GAUGES = {f"axis {i + 1}": about_its_own_axis(i) for i in range(6)} | {"flange": between_flange_and_hand}
"""2 for each of six axes and 6 of the flange: the 18 of METHOD.md 3."""


def moments_at(problem: Problem, state: State) -> FloatArray:
    moments, _ = shot_moments(problem, state, linearise_geometry(problem, state), np.inf)
    return moments


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("name", GAUGES)
def test_a_motion_along_a_gauge_direction_changes_no_residual(name: str, coupled: bool) -> None:
    cell, rng = paper_cell(coupled), np.random.default_rng(1)
    problem = problem_of(cell, draw_shots(cell, rng, 6), PillowError())
    state = bent_state(problem, cell, rng)
    moved = GAUGES[name](cell.nominal, state, np.array([3.0, -2.0, 5.0, 0.02, 0.03, -0.04]))
    np.testing.assert_allclose(moments_at(problem, moved), moments_at(problem, state), rtol=1e-9, atol=1e-7)
    assert np.abs(moved.link_twists - state.link_twists).max() > 1.0


def test_the_gauges_are_18_directions_of_the_solvers_own_null_space() -> None:
    cell, rng = paper_cell(), np.random.default_rng(2)
    problem = problem_of(cell, draw_shots(cell, rng, 30))
    state = start_of(problem, cell)
    columns = linearise_geometry(problem, state).columns[:, :3].reshape(-1, problem.layout.size)
    scale = np.ones(problem.layout.size)
    scale[: problem.layout.camera.stop] = parameter_scale(problem.layout)
    singular = np.linalg.svd(columns / scale, compute_uv=False)
    # hand-eye, links and one centre: 24 directions of robot and hand-eye and the three of the centre
    assert (singular > 1e-6 * singular[0]).sum() == 24 + 3


def test_pose_only_data_in_another_base_are_the_same_data() -> None:
    cell, rng = paper_cell(), np.random.default_rng(3)
    problem = problem_of(cell, draw_shots(cell, rng, 6), PillowError(), pose_only=True)
    state = replace(bent_state(problem, cell, rng), pose_noise=np.zeros((6, 6)))
    shift = se3.exp([300.0, -200.0, 100.0, 0.5, -0.3, 1.0])
    elsewhere = replace(problem, base_from_flange=shift @ problem.base_from_flange)
    moved = replace(state, centres_in_base_mm=se3.apply(shift, state.centres_in_base_mm))
    np.testing.assert_allclose(moments_at(elsewhere, moved), moments_at(problem, state), rtol=1e-9, atol=1e-8)


def solved(cell: SyntheticCell, camera_error: CameraError, *, pose_only: bool = False, n_points: int = 60) -> Identifiability:
    rng = np.random.default_rng(4)
    problem = problem_of(cell, draw_shots(cell, rng, 60, n_points=n_points), camera_error, pose_only=pose_only)
    solution = solve_clouds(problem, start_of(problem, cell, rng), FIRST_NOISE)
    return identifiability_of(solution.problem, solution)


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize(("camera_error", "rank", "n"), [(NoCameraError(), 24, 42), (PillowError(), 27, 45)], ids=["none", "pillow"])
def test_well_spread_shots_determine_what_is_no_gauge(coupled: bool, camera_error: CameraError, rank: int, n: int) -> None:
    found = solved(paper_cell(coupled), camera_error)
    assert (found.rank, found.expected_rank, found.n_parameters) == (rank, rank, n)
    assert found.gap > 10
    assert 1 < found.condition < 1e5
    assert (np.diff(found.singular_values) <= 0).all()


def test_flange_poses_determine_the_hand_eye_transform() -> None:
    found = solved(paper_cell(), NoCameraError(), pose_only=True)
    assert (found.rank, found.expected_rank, found.n_parameters) == (6, 6, 6)
    assert found.gap == np.inf


def always_ahead(rng: np.random.Generator, depth_mm: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """METHOD's orientations, with the sphere at one place in the camera frame."""
    return np.array([0.0, 0.0, 320.0]), draw_view(rng, depth_mm)[1]


def test_a_sphere_at_exactly_one_camera_coordinate_leaves_rank_20(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hand-eye rotation and the length scale vanish (METHOD.md 3); looked at where everything is known."""
    monkeypatch.setattr("tests.support.synthetic.draw_view", always_ahead)
    cell = replace(paper_cell(), camera_error_mm=lambda p: np.zeros(len(p)))
    cell = replace(cell, true=cell.nominal)
    problem = problem_of(cell, draw_shots(cell, np.random.default_rng(6), 60, pose_noise=(0.0, 0.0)))
    found = identifiability_of(problem, seen_from(problem, start_of(problem, cell)))
    assert found.rank <= 20
    assert found.expected_rank == 24
    assert found.gap > 10


def seen_from(problem: Problem, state: State) -> Solution:
    """What a solve would say that ended in a state."""
    geometry = linearise_geometry(problem, state)
    moments, counts = shot_moments(problem, state, geometry, np.inf)
    noise = NoiseModel(point_mm=0.06, pose_mm=0.01, pose_rad=1e-4)
    sums = linearise(problem, state, geometry, moments, noise.point_weight(counts[:, 2]))
    return Solution(problem, state, noise, sums, reduce(sums, noise.pose_precision), geometry, moments, counts[:, 1], 1)


def test_shots_aimed_at_one_camera_coordinate_fail_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """The true robot misses its aim by some mm, so a little is seen of every direction: by far not enough."""
    monkeypatch.setattr("tests.support.synthetic.draw_view", always_ahead)
    found = solved(paper_cell(), PillowError(), n_points=400)
    assert found.rank < found.expected_rank
    evidence = Evidence(
        limits=None,
        cross_validated_rms_mm=0.01,
        length_expanded_uncertainty_mm=None,
        n_shots=60,
        used=60,
        has_joints=True,
        has_certified_length=False,
        line_profile=False,
        covariance_scale=1.0,
    )
    verdict, reasons = judge(evidence, found)
    assert verdict == "fail"
    assert f"rank {found.rank}" in reasons[0]
    assert "spread the sphere in depth" in reasons[0]


@pytest.mark.parametrize("pose_only", [False, True])
def test_names_and_scales_go_with_the_layout(pose_only: bool) -> None:
    cell = paper_cell()
    rng = np.random.default_rng(5)
    problem = problem_of(cell, {name: draw_shots(cell, rng, 1, n_points=3) for name in "AB"}, PillowError(), pose_only=pose_only)
    names = parameter_names(problem.layout, problem.terms, ("A", "B"))
    assert len(set(names)) == len(names) == problem.layout.size
    assert names[problem.layout.hand_eye][0] == "hand_eye.rho_x_mm"
    assert names[problem.layout.centres] == ("sphere.A.x_mm", "sphere.A.y_mm", "sphere.A.z_mm", "sphere.B.x_mm", "sphere.B.y_mm", "sphere.B.z_mm")
    scale = parameter_scale(problem.layout)
    assert len(scale) == problem.layout.camera.stop
    assert all((s > 1) == name.endswith("_rad") for s, name in zip(scale, names[: len(scale)], strict=True))


def _one_place(rng: np.random.Generator, depth_mm: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """Orientations at random, the sphere within a millimetre of one place in the camera frame."""
    return np.array([5.0, -3.0, 330.0]) + rng.normal(0, 0.3, 3), draw_view(rng, depth_mm)[1]


@pytest.mark.parametrize("seed", [9, *(pytest.param(seed, marks=pytest.mark.qualify) for seed in (10, 11))])
def test_a_degenerate_plan_fails_with_its_reason_whatever_camera_model_is_tried(seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Caps tell a little of everything, so that `auto` takes one model or another and the solve ends: the verdict must see through it.

    Repeated poses are test_distinct_views.py's.
    """
    cell, rng = paper_cell(coupled=True), np.random.default_rng(seed)
    monkeypatch.setattr("tests.support.synthetic.draw_view", _one_place)
    shots = draw_shots(cell, rng, 40, n_points=400)
    folder = write_session(tmp_path / "s", cell, {"A": shots}, flange_from_camera=cell.flange_from_camera)
    found = calibrate([read_session(folder)])
    assert found.verdict == "fail", found.reasons
    assert "one place of the camera's view" in found.reasons[0], found.reasons
    assert found.statistics.used + len(found.rejected) == len(shots)
