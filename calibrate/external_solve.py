"""Solving with external points: rejection with a reason, held-out shots, and sessions that hold nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calibrate.assemble import without_pose_noise
from calibrate.camera_error import NoCameraError
from calibrate.clouds import Solution, solve_clouds
from calibrate.external import ExternalRows, external_rows
from calibrate.external_points import ExternalPoints, ExternalShot, external_points
from calibrate.external_start import ExternalStart, refine_all, start_frames
from calibrate.normal import NoiseModel
from calibrate.observations import RejectedShot
from calibrate.problem import Layout, Priors, Problem, State
from calibrate.robot_terms import arm_terms
from calibrate.start import initial_state
from drivers.errors import DataError
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

N_FOLDS = 10
SPARE_ROWS = 9
"""Figures beyond the unknowns without which nothing can be left out."""
FIRST_NOISE = NoiseModel(point_mm=0.05, pose_mm=0.05, pose_rad=1e-4)
REJECT_CHI2 = 30.7
"""A clean shot exceeds this in one of a million cases (chi-square, three degrees of freedom)."""
_GROSS_SCALES = 8.0
"""Beyond it a point is spoiled before anything is known of the noise; nearer ones are judged once the noise is."""
_MEDIAN_CHI2 = 2.366
_REJECT_ROUNDS = 4
_FOLD_TOLERANCE_MM = 1e-4
_LEAVE_ONE_OUT_BELOW = 30


@dataclass(frozen=True, slots=True, eq=False)
class ExternalSolved:
    """A solve in which external points took part."""

    solution: Solution
    held_out_mm: FloatArray
    """(E, 3) error of every point against a solve without it, base axes; NaN where no other shot shows its frame or target."""
    rejected: tuple[RejectedShot, ...]
    compared: Mapping[str, float] = field(default_factory=dict)
    """Held-out rms (mm) with a rigid arm and with one that yields under gravity; empty where nothing was compared."""


def solve_robot_alone(shots: Sequence[ExternalShot], model: RobotModel, priors: Priors, flange_from_camera: FloatArray | None) -> ExternalSolved:
    """Calibrate a robot on external points alone; its deflection under gravity is estimated where left-out points want it.

    Args:
        shots: at least one.
        model: nominal robot.
        priors: of the link twists and deflection terms.
        flange_from_camera: what is known of the hand-eye transform, handed on as it is; identity where nothing is.

    Raises:
        DataError: no frame brings the points to the arm, or the solve does not settle.
    """
    hand_eye = np.eye(4) if flange_from_camera is None else flange_from_camera
    terms = arm_terms(model)
    points = external_points(shots, model, terms)
    problem = robot_problem(points, model, priors, hand_eye)
    start, points, rejected = believed(problem, points, initial_state(problem, hand_eye, np.zeros((0, 3))))
    return _rigid_or_yielding(replace(problem, external=points), start.state, rejected)


def _rigid_or_yielding(problem: Problem, state: State, rejected: tuple[RejectedShot, ...]) -> ExternalSolved:
    rigid = _solve_and_reject(problem, state, rejected)
    if not problem.terms or problem.external is None or not has_spare_points(problem.external, problem.layout):
        return rigid
    free = tuple(replace(term, estimated=term.kind == "compliance") for term in problem.terms)
    yielding = _solve_and_reject(replace(problem, terms=free), rigid.solution.state, rejected)
    compared = {"rigid": rms_mm(rigid.held_out_mm), "yielding": rms_mm(yielding.held_out_mm)}
    return replace(yielding if _wins(yielding, rigid) else rigid, compared=compared)


def _solve_and_reject(problem: Problem, state: State, rejected: tuple[RejectedShot, ...]) -> ExternalSolved:
    """Solve, reject the points that the noise cannot explain, and solve again until none is left."""
    for last in (*[False] * _REJECT_ROUNDS, True):
        solution = solve_clouds(problem, without_pose_noise(state, problem.n_scans), FIRST_NOISE)
        better, spoiled = without_spoiled(solution)
        if last or better is None or not spoiled:
            break
        problem, state, rejected = replace(problem, external=better), solution.state, rejected + spoiled
    return ExternalSolved(solution, held_out_errors(solution), rejected)


def _wins(yielding: ExternalSolved, rigid: ExternalSolved) -> bool:
    """Whether left-out points want the arm to yield: better by more than one standard error of the difference."""
    squares = []
    for solved in (rigid, yielding):
        points = solved.solution.problem.external
        shots = () if points is None else points.shots
        squares.append({shot.key: float(error @ error) for shot, error in zip(shots, solved.held_out_mm, strict=True) if np.isfinite(error).all()})
    gain = np.array([squares[0][key] - squares[1][key] for key in sorted(squares[0].keys() & squares[1].keys())])
    return len(gain) > 1 and bool(gain.mean() > gain.std(ddof=1) / np.sqrt(len(gain)))


def has_spare_points(points: ExternalPoints, layout: Layout) -> bool:
    """Whether there are figures enough for some to be left out."""
    unknowns = 4 * layout.n_links - 6 + 6 * layout.n_references + 3 * layout.n_targets
    return 3 * points.n_shots >= unknowns + SPARE_ROWS


def joined_by_external(
    problem: Problem, state: State, shots: Sequence[ExternalShot], flange_from_camera: FloatArray
) -> tuple[Problem, State, tuple[RejectedShot, ...]]:
    """A problem of spheres with external points added, its state with their frames and targets, and the points that fit neither.

    The arm yields in it where the external points alone want it to: they see the arm without the camera's errors.

    Raises DataError where no frame brings the points to the arm.
    """
    if not shots:
        return problem, state, ()
    model = problem.model
    if model is None:
        why = "external reference points need axis angles and the robot's model, and the other shots have none"
        return problem, state, tuple(RejectedShot(shot.session, shot.index, why) for shot in shots)
    points = external_points(shots, model, problem.terms)
    alone = robot_problem(points, model, problem.priors, flange_from_camera)
    first, points, rejected = believed(alone, points, initial_state(alone, flange_from_camera, np.zeros((0, 3))))
    solved = _rigid_or_yielding(replace(alone, external=points), first.state, rejected)
    points, rejected = solved.solution.problem.external or points, solved.rejected
    problem, alone = replace(problem, terms=solved.solution.problem.terms), replace(alone, external=points)
    bare = replace(initial_state(alone, flange_from_camera, np.zeros((0, 3))), link_twists=state.link_twists)
    start = start_frames(alone, bare).state
    problem = replace(problem, external=points.held_at(start.base_from_reference, start.target_in_flange_mm))
    state = replace(state, base_from_reference=start.base_from_reference, target_in_flange_mm=start.target_in_flange_mm)
    return problem, without_pose_noise(state, problem.n_scans), rejected


def believed(problem: Problem, points: ExternalPoints, state: State) -> tuple[ExternalStart, ExternalPoints, tuple[RejectedShot, ...]]:
    """Robust solve of external points alone: its end, the points that fit it, and the others with a reason.

    Raises DataError where no frame brings the points to the arm.
    """
    start = start_frames(problem, state)
    points = points.held_at(start.state.base_from_reference, start.state.target_in_flange_mm)
    problem = replace(problem, external=points)
    if not has_spare_points(points, problem.layout):  # every point fits itself: none can be told to be wrong
        return start, points, ()
    start = refine_all(problem, start)
    far = start.miss_mm > _GROSS_SCALES * start.scale_mm
    rejected = tuple(_too_far(points.shots[i], start.miss_mm[i]) for i in np.flatnonzero(far).tolist())
    return start, points.subset(np.flatnonzero(~far)), rejected


def without_spoiled(solution: Solution) -> tuple[ExternalPoints | None, tuple[RejectedShot, ...]]:
    """The external points of a solve without those further off than noise, pose noise and the typical one explain."""
    points = solution.problem.external
    if points is None:
        return None, ()
    rows = rows_without_pose_noise(solution.problem, solution.state)
    covariance = rows.pose_covariance_mm2(solution.noise)
    chi2 = np.einsum("ei,ei->e", rows.residual_mm, np.linalg.solve(covariance, rows.residual_mm[..., None])[..., 0])
    typical = max(1.0, float(np.median(chi2)) / _MEDIAN_CHI2)
    far, miss_mm = chi2 > REJECT_CHI2 * typical, np.linalg.norm(rows.residual_mm, axis=1)
    rejected = tuple(_too_far(points.shots[i], miss_mm[i]) for i in np.flatnonzero(far).tolist())
    return points.subset(np.flatnonzero(~far)), rejected


def rows_without_pose_noise(problem: Problem, state: State) -> ExternalRows:
    """External points as a state predicts them that knows nothing of the stops' pose noise.

    Raises DataError where the problem has none.
    """
    rows = external_rows(problem, without_pose_noise(state, problem.n_scans))
    if rows is None:
        raise DataError("there are no external points", remedy="Give shots with reference, target and point_in_reference_mm.")
    return rows


def held_out_errors(solution: Solution, n_folds: int = N_FOLDS) -> FloatArray:
    """(E, 3) error of every external point against a solve without its fold; all spheres stay, and the noise model does."""
    points = solution.problem.external
    if points is None:
        return np.zeros((0, 3))
    fold, error = folds_of(points, n_folds), np.full((points.n_shots, 3), np.nan)
    for k in range(int(fold.max(initial=-1)) + 1):
        inside, outside = np.flatnonzero(fold == k), np.flatnonzero(fold != k)
        known = np.isin(points.reference[inside], points.reference[outside]) & np.isin(points.target[inside], points.target[outside])
        inside = inside[known]
        if not len(inside):
            continue
        training = replace(solution.problem, external=points.subset(outside))
        start = without_pose_noise(solution.state, training.n_scans)
        state = solve_clouds(training, start, solution.noise, estimate_noise=False, tolerance_mm=_FOLD_TOLERANCE_MM).state
        error[inside] = rows_without_pose_noise(replace(solution.problem, external=points.subset(inside)), state).residual_mm
    return error


def folds_of(points: ExternalPoints, n_folds: int) -> NDArray[np.int64]:
    """(E,) fold of every shot: by stop, and by the set of axis angles and not their order."""
    _, group = np.unique(np.round(points.joints_rad, 9), axis=0, return_inverse=True)
    group = group.ravel()
    n_groups = int(group.max(initial=-1)) + 1
    shuffled = np.random.default_rng(20230825).permutation(n_groups)
    return np.asarray(shuffled[group] % (n_groups if n_groups < _LEAVE_ONE_OUT_BELOW else n_folds))


def predicted_rms_mm(solution: Solution) -> float:
    """First-order rms of the distance between a point and a prediction of it: parameters, pose noise and tracker; NaN without any."""
    if solution.problem.external is None:
        return float("nan")
    rows = rows_without_pose_noise(solution.problem, solution.state)
    spread = rows.columns @ solution.covariance @ np.swapaxes(rows.columns, 1, 2)
    return float(np.sqrt(np.trace(rows.pose_covariance_mm2(solution.noise) + spread, axis1=1, axis2=2).mean()))


def rms_mm(error_mm: FloatArray) -> float:
    """Root of the mean squared length of the rows of (E, 3) that are known; NaN where none is."""
    squares = (error_mm**2).sum(axis=1)
    known = squares[np.isfinite(squares)]
    return float(np.sqrt(known.mean())) if len(known) else float("nan")


def _too_far(shot: ExternalShot, miss_mm: float) -> RejectedShot:
    return RejectedShot(shot.session, shot.index, f"outlier: its target {shot.target} lies {miss_mm:.2f} mm from where the other shots put it")


def robot_problem(points: ExternalPoints, model: RobotModel, priors: Priors, flange_from_camera: FloatArray) -> Problem:
    """A problem without any sphere; its hand-eye transform stays where it is."""
    n, n_terms = model.n_joints, points.load.shape[-1]
    return Problem(
        model=model,
        joints_rad=np.zeros((0, n)),
        base_from_flange=np.zeros((0, 4, 4)),
        scan=np.zeros(0, dtype=np.int64),
        sphere=np.zeros(0, dtype=np.int64),
        points_in_camera_mm=np.zeros((0, 3)),
        starts=np.zeros(1, dtype=np.int64),
        camera_error=NoCameraError(),
        radius_mm=np.zeros(0),
        radius_sigma_mm=np.zeros(0),
        priors=priors,
        terms=arm_terms(model),
        load=np.zeros((0, n, n_terms)),
        first_flange_from_camera=flange_from_camera,
        external=points,
    )
