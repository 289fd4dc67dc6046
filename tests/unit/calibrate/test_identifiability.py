"""Observability by its formulas, gauge and open directions by name, and next best poses that do cure what they are for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate import Calibration
from calibrate.arm_branches import UnseenBranch, arm_branch, unseen_branch
from calibrate.camera_error import CameraError, NoCameraError, PillowError, camera_error_models
from calibrate.clouds import Solution, solve_clouds
from calibrate.identifiability import Identifiability, Observability, identifiability_of, observability_of
from calibrate.next_poses import shortcomings
from calibrate.normal import NoiseModel, linearise, reduce
from calibrate.problem import Problem, State, linearise_geometry
from calibrate.solve import CalibrationSettings, calibrate
from calibrate.sums import shot_moments
from calibrate.verdict import judge, wants_more_poses
from drivers.files.session import read_session
from drivers.kinematics import mdh, se3
from drivers.kinematics.inverse import branches_of_many
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model
from tests.support.bound import FIRST_NOISE
from tests.support.solving import draw_shots, problem_of, start_of
from tests.support.synthetic import SyntheticCell, SyntheticShot, draw_view, paper_cell, sample_cap, with_table_1_errors
from tests.support.synthetic_session import write_session
from tests.unit.calibrate.test_verdict import GOOD, WHOLE

CAMERA = {"driver": "simulated", "kind": "area", "working_range_mm": [230, 450], "field_of_view_deg": [55, 36], "sight_crossing_mm": [60, 0, 500]}
LIMITS = {"centre_rms_mm": 0.2, "length_error_mm": 0.2, "diameter_error_mm": 0.2, "form_mm": 0.3}
VIEW = Callable[[np.random.Generator, tuple[float, float]], tuple[FloatArray, FloatArray]]


def at_one_place(rng: np.random.Generator, depth_mm: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    return np.array([0.0, 0.0, 320.0]), draw_view(rng, depth_mm)[1]


def never_turned(rng: np.random.Generator, depth_mm: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    return draw_view(rng, depth_mm)[0], np.diag([1.0, -1.0, -1.0])


def perfect_cell() -> SyntheticCell:
    """The robot reaches exactly what it aims at, so that a degenerate plan is exactly degenerate."""
    return replace(paper_cell(), true=paper_cell().nominal, camera_error_mm=lambda points: np.zeros(len(points)))


def described(problem: Problem, state: State) -> Solution:
    """What a solve would say that ended in a state."""
    geometry = linearise_geometry(problem, state)
    moments, counts = shot_moments(problem, state, geometry, np.inf)
    noise = NoiseModel(point_mm=0.06, pose_mm=0.01, pose_rad=1e-4)
    sums = linearise(problem, state, geometry, moments, noise.point_weight(counts[:, 2]))
    return Solution(problem, state, noise, sums, reduce(sums, noise.pose_precision), geometry, moments, counts[:, 1], 1)


def exactly(
    camera_error: CameraError, monkeypatch: pytest.MonkeyPatch, view: VIEW | None = None, *, n: int = 40, pose_only: bool = False
) -> tuple[Identifiability, Problem, Solution]:
    if view is not None:
        monkeypatch.setattr("tests.support.synthetic.draw_view", view)
    cell = perfect_cell()
    problem = problem_of(cell, draw_shots(cell, np.random.default_rng(6), n, pose_noise=(0.0, 0.0)), camera_error, pose_only=pose_only)
    solution = described(problem, start_of(problem, cell))
    return identifiability_of(problem, solution), problem, solution


def counts(found: Identifiability, kind: str) -> dict[str, int]:
    return {group.text.partition(":")[0]: group.n_directions for group in found.directions if group.kind == kind}


def test_observability_indices_are_the_published_functions_of_the_singular_values() -> None:
    rng, m, r = np.random.default_rng(0), 12, 5
    jacobian = rng.normal(size=(3 * m, r)) * [1.0, 3.0, 0.2, 5.0, 0.7]
    gram = jacobian.T @ jacobian
    inverse = np.linalg.inv(gram)
    found = observability_of(np.linalg.svd(jacobian, compute_uv=False).astype(np.float64), m)
    largest, smallest = np.linalg.norm(jacobian, 2), 1 / np.sqrt(np.linalg.norm(inverse, 2))
    assert found.o1 == pytest.approx(np.linalg.det(gram) ** (0.5 / r) / np.sqrt(m))
    assert found.o2 == pytest.approx(1 / np.linalg.cond(jacobian))
    assert found.o3 == pytest.approx(smallest)
    assert found.o4 == pytest.approx(smallest**2 / largest)
    assert 1 / found.o5 == pytest.approx(np.linalg.norm(np.linalg.pinv(jacobian), "nuc"))


def test_twice_the_shots_leave_the_first_index_alone_and_raise_those_of_size() -> None:
    values = np.array([9.0, 4.0, 1.0])
    once, twice = observability_of(values, 20), observability_of(np.sqrt(2) * values, 40)
    assert twice.o1 == pytest.approx(once.o1)
    assert twice.o2 == pytest.approx(once.o2)
    for index in ("o3", "o4", "o5"):
        assert getattr(twice, index) == pytest.approx(np.sqrt(2) * getattr(once, index))
    assert observability_of(np.zeros(0), 0) == Observability(0.0, 0.0, 0.0, 0.0, 0.0)


def test_spread_shots_leave_the_gauge_of_the_chain_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    found, problem, _ = exactly(PillowError(), monkeypatch)
    assert found.rank == found.expected_rank == 27
    assert sorted(counts(found, "gauge").values()) == [2, 6, 10]
    assert not counts(found, "open")
    by_text = {group.text.partition(":")[0]: set(group.parameters) for group in found.directions}
    assert by_text["height and heading of the base"] == {"link1.rho_z_mm", "link1.phi_z_rad"}
    flange = by_text["link 6 with the hand-eye transform"]
    assert {"link6.rho_z_mm", "hand_eye.rho_z_mm", "link6.phi_z_rad", "hand_eye.phi_z_rad"} <= flange
    assert not {name for name in flange if not name.startswith(("link6.", "hand_eye."))}
    assert found.observability is not None
    assert found.observability.o2 == pytest.approx(1 / found.condition)
    assert not shortcomings(problem, described(problem, start_of(problem, perfect_cell())), found.expected_rank)


def test_lateral_camera_terms_that_turn_the_view_are_gauge_with_the_hand_eye() -> None:
    box = np.array([[-130.0, -80.0, 240.0], [130.0, 80.0, 410.0]])
    affine = camera_error_models(["affine"], points_in_camera_mm=box, sight_crossing_mm=(60.0, 0.0, 500.0))[0]
    cell, rng = paper_cell(), np.random.default_rng(5)
    problem = problem_of(cell, draw_shots(cell, rng, 60), affine)
    solution = solve_clouds(problem, start_of(problem, cell, rng), FIRST_NOISE)
    found = identifiability_of(solution.problem, solution)
    assert found.rank == found.expected_rank
    camera = next(group for group in found.directions if group.text.startswith("camera field"))
    assert camera.n_directions == 3
    assert {name.partition(".")[0] for name in camera.parameters} == {"camera", "hand_eye"}


@pytest.mark.parametrize(
    ("camera_error", "missing"), [(NoCameraError(), {"orientation of the camera on the flange": 3, "length scale": 1}), (PillowError(), None)]
)
def test_one_camera_coordinate_leaves_orientation_scale_and_field(
    camera_error: CameraError, missing: dict[str, int] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, problem, solution = exactly(camera_error, monkeypatch, at_one_place)
    opened = counts(found, "open")
    if missing is not None:
        assert opened == missing
    assert {"orientation of the camera on the flange", "length scale"} <= set(opened)
    assert sum(opened.values()) + sum(counts(found, "gauge").values()) == found.n_parameters - found.rank
    [text] = shortcomings(problem, solution, found.expected_rank)
    assert "one place of the camera's view" in text


def test_parallel_orientations_leave_the_camera_s_place(monkeypatch: pytest.MonkeyPatch) -> None:
    found, problem, solution = exactly(NoCameraError(), monkeypatch, never_turned)
    assert counts(found, "open")["place of the camera on the flange"] == 3
    assert any("parallel orientations" in text for text in shortcomings(problem, solution, found.expected_rank))


def test_flange_poses_have_no_gauge_and_lose_the_camera_s_place_when_parallel(monkeypatch: pytest.MonkeyPatch) -> None:
    spread, _, _ = exactly(NoCameraError(), monkeypatch, pose_only=True)
    assert spread.directions == ()
    parallel, problem, solution = exactly(NoCameraError(), monkeypatch, never_turned, pose_only=True)
    assert [(group.kind, group.n_directions) for group in parallel.directions] == [("open", 3)]
    assert parallel.directions[0].text.startswith("place of the camera on the flange")
    assert set(parallel.directions[0].parameters) == {"hand_eye.rho_x_mm", "hand_eye.rho_y_mm", "hand_eye.rho_z_mm"}
    assert any("parallel orientations" in text for text in shortcomings(problem, solution, parallel.expected_rank))


def test_too_few_shots_are_told_by_number_and_every_open_direction_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    found, problem, solution = exactly(PillowError(), monkeypatch, n=6)
    assert found.rank < found.expected_rank
    assert sum(counts(found, "open").values()) == found.expected_rank - found.rank
    assert "too few shots: 6 for 30 unknowns" in shortcomings(problem, solution, found.expected_rank)[0]


@pytest.mark.parametrize("name", ["abb_irb1410", "irb1410_paper", "ur5e"])
def test_solutions_of_one_pose_stand_in_branches_of_their_own(name: str) -> None:
    model = load_robot_model(name)
    free = replace(model, joint_limits_rad=np.full((6, 2), [-np.inf, np.inf]), linear_limits=())
    joints = np.random.default_rng(3).uniform(-2.5, 2.5, (60, 6))
    found = branches_of_many(free, mdh.base_from_flange(free, joints))
    sides = arm_branch(free, found.joints_rad)
    for target in range(60):
        own = sides[found.target == target]
        assert len(np.unique(own, axis=0)) == len(own)


def shots_where(cell: SyntheticCell, n: int, keep: Callable[[FloatArray], bool]) -> list[SyntheticShot]:
    rng, kept = np.random.default_rng(8), list[SyntheticShot]()
    while len(kept) < n:
        kept += [shot for shot in draw_shots(cell, rng, 10) if keep(shot.joints_rad)]
    return kept[:n]


def test_the_other_branch_is_missed_only_where_all_shots_are_of_one() -> None:
    cell = paper_cell()
    free: RobotModel = cell.nominal
    sides = [arm_branch(free, shot.joints_rad[None])[0] for shot in draw_shots(cell, np.random.default_rng(8), 40)]
    usual = max((tuple(side) for side in sides), key=[tuple(side) for side in sides].count)
    found = []
    for keep in (lambda q: tuple(arm_branch(free, q[None])[0]) == usual, lambda q: True):
        problem = problem_of(cell, shots_where(cell, 40, keep), PillowError())
        solution = solve_clouds(problem, start_of(problem, cell), FIRST_NOISE)
        found.append(unseen_branch(solution.problem, solution, solution.covariance))
    one, several = found
    assert several is None
    assert one is not None
    assert one.parts
    assert one.expanded_uncertainty_mm > 0.1


def test_one_branch_fails_where_the_other_would_break_the_limit() -> None:
    far, near = (replace(GOOD, unseen_branch=UnseenBranch(("wrist",), u)) for u in (0.31, 0.11))
    verdict, reasons = judge(far, WHOLE)
    assert verdict == "fail"
    assert "wrist turned over" in reasons[0]
    assert "U = 0.310 mm" in reasons[0]
    assert wants_more_poses(far, WHOLE)
    assert judge(near, WHOLE) == ("pass", ())
    assert not wants_more_poses(near, WHOLE)
    assert judge(replace(far, limits=None), WHOLE)[0] == "marginal"


@pytest.fixture(scope="module")
def aimed_at_one_place(tmp_path_factory: pytest.TempPathFactory) -> tuple[SyntheticCell, list[SyntheticShot], Calibration]:
    """A session whose every shot was aimed at one place of the view, of a robot with Table 1's errors."""
    model = load_robot_model("irb1410_paper")
    cell = replace(paper_cell(), nominal=model, true=with_table_1_errors(model))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tests.support.synthetic.draw_view", at_one_place)
        shots = draw_shots(cell, np.random.default_rng(4), 40, n_points=200)
    return cell, shots, solved(tmp_path_factory.mktemp("one"), cell, shots)


def solved(folder: Path, cell: SyntheticCell, shots: list[SyntheticShot], camera: dict[str, object] | None = None) -> Calibration:
    extra = {"limits": LIMITS, "work_volume_mm": [[700, -200, 150], [1050, 300, 450]], "camera": camera or CAMERA}
    write_session(folder / "s", cell, {"A": shots}, flange_from_camera=cell.flange_from_camera, extra_cell=extra)
    return calibrate([read_session(folder / "s")], CalibrationSettings(camera_error="pillow"))


def shot_at(cell: SyntheticCell, joints_rad: FloatArray, rng: np.random.Generator) -> SyntheticShot:
    base_from_camera = cell.true_base_from_flange(joints_rad) @ cell.flange_from_camera
    centre = se3.apply(se3.inverse(base_from_camera), cell.centre_in_base_mm)
    points = sample_cap(centre, cell.radius_mm, 200, rng)
    points[:, 2] += cell.camera_error_mm(points) + rng.normal(0, 0.08, len(points))
    return SyntheticShot(joints_rad, points, base_from_camera)


def test_a_degenerate_plan_fails_with_the_reason_and_feasible_next_poses(
    aimed_at_one_place: tuple[SyntheticCell, list[SyntheticShot], Calibration],
) -> None:
    cell, _, found = aimed_at_one_place
    assert found.verdict == "fail"
    assert "one place of the camera's view" in found.reasons[0]
    assert any(reason.startswith("next best poses: A at ") for reason in found.reasons)
    told = found.to_json_dict()["next_best_poses"]
    assert isinstance(told, list)
    assert 3 <= len(told) <= 5
    assert {"sphere", "joints_rad"} <= set(told[0])
    seen = []
    for pose in found.next_best_poses:
        assert mdh.within_limits(cell.nominal, pose.joints_rad)
        base_from_camera = cell.true_base_from_flange(pose.joints_rad) @ cell.flange_from_camera
        seen.append(se3.apply(se3.inverse(base_from_camera), cell.centre_in_base_mm))
    assert ((np.array(seen)[:, 2] > 230) & (np.array(seen)[:, 2] < 450)).all()
    # not where all the others were
    assert np.ptp(seen, axis=0).max() > 60


def test_the_next_poses_cure_what_they_are_for(
    aimed_at_one_place: tuple[SyntheticCell, list[SyntheticShot], Calibration], tmp_path: Path
) -> None:
    cell, shots, before = aimed_at_one_place
    rng = np.random.default_rng(9)
    after = solved(tmp_path, cell, shots + [shot_at(cell, pose.joints_rad, rng) for pose in before.next_best_poses])
    assert before.identifiability is not None
    assert after.identifiability is not None
    assert before.statistics.rank < before.identifiability.expected_rank
    assert after.statistics.rank == after.identifiability.expected_rank
    assert after.verdict != "fail"


def test_without_what_the_camera_sees_only_words_are_given(
    aimed_at_one_place: tuple[SyntheticCell, list[SyntheticShot], Calibration], tmp_path: Path
) -> None:
    cell, shots, _ = aimed_at_one_place
    found = solved(tmp_path, cell, shots, {"driver": "simulated", "kind": "area", "sight_crossing_mm": [60, 0, 500]})
    assert found.verdict == "fail"
    assert found.next_best_poses == ()
    assert "spread the sphere in depth" in found.reasons[0]


def test_the_file_keeps_the_directions_and_the_poses(
    aimed_at_one_place: tuple[SyntheticCell, list[SyntheticShot], Calibration], tmp_path: Path
) -> None:
    _, _, found = aimed_at_one_place
    found.save(tmp_path / "calibration.yaml")
    again = Calibration.load(tmp_path / "calibration.yaml")
    assert again.identifiability is not None
    assert found.identifiability is not None
    assert again.identifiability.directions == found.identifiability.directions
    assert again.identifiability.observability == found.identifiability.observability
    assert [(p.id, p.sphere, p.joints_rad.tolist()) for p in again.next_best_poses] == [
        (p.id, p.sphere, p.joints_rad.tolist()) for p in found.next_best_poses
    ]
