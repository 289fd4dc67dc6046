"""First guess of frames and targets from nothing, and which external points fit it.

With the robot taken as it is, `base_from_flange_j t = R p_j + t_0` is linear in the target t, the nine elements of R and
t_0. R is then projected on SO(3) and all are refined. Points of one plane, or fewer than five, leave R open; then the
rigid motion that carries the measured points to the flange's own places is the better start, so both are tried.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibrate import normal
from calibrate.external import ExternalRows, external_rows, joined
from calibrate.external_points import ExternalPoints
from calibrate.normal import NoiseModel
from calibrate.plausibility import parallelogram
from calibrate.problem import Problem, State, linearise_geometry
from drivers.errors import DataError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

LARGEST_SCALE_MM = 25.0
"""No robot's geometry is off by more; beyond this data and model do not belong together."""
MEDIAN_LENGTH = 1.538
"""Median length of a 3-vector of unit noise."""
_SMALLEST_SCALE_MM = 1e-3
_FRAME_ROUNDS, _ALL_ROUNDS = 25, 12
_SETTLED_SCALES = 1e-3
_CUTOFF_SCALES = 4.0
_ELEMENT_SCALE_MM = 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class ExternalStart:
    """Where a robust solve of external points alone ended."""

    state: State
    miss_mm: FloatArray
    """(E,) distance of every point from where the model puts it."""
    scale_mm: float
    """Robust standard deviation on each axis, what the unknowns take out given back."""
    weight: FloatArray
    """(E,) in [0, 1]."""


def start_frames(problem: Problem, state: State) -> ExternalStart:
    """Frames and targets for a robot as a state has it; the state with them.

    Raises DataError where no frame brings the points to the arm; it names the most likely cause, found by trying it.
    """
    best = _best_frames(problem, state)
    if best.scale_mm <= LARGEST_SCALE_MM:
        return best
    raise DataError(
        f"no frame brings the external points to the arm (they stay {best.scale_mm:.0f} mm apart); {_likely_cause(problem, state)}",
        remedy="Check the robot model, the units and handedness of the points, and that each line holds the axis angles of its own point.",
    )


def refine_all(problem: Problem, start: ExternalStart) -> ExternalStart:
    """Robot, frames and targets together, a weight per point (Geman and McClure) so that spoiled ones do not bend the robot."""
    return _refined(problem, start, np.ones(problem.layout.size, dtype=bool), _ALL_ROUNDS)


def _best_frames(problem: Problem, state: State) -> ExternalStart:
    points, model = problem.external, problem.model
    if points is None or model is None:
        raise DataError("there are no external points", remedy="Give shots with reference, target and point_in_reference_mm.")
    free = np.zeros(problem.layout.size, dtype=bool)
    free[problem.layout.references] = free[problem.layout.targets] = True
    flange = mdh.base_from_flange(model, points.joints_rad, state.link_twists)
    found = []
    for frames, targets in (_linear(points, flange), _kabsch(points, flange)):
        first = replace(state, base_from_reference=frames, target_in_flange_mm=targets)
        found.append(_refined(problem, ExternalStart(first, np.zeros(0), np.inf, np.ones(points.n_shots)), free, _FRAME_ROUNDS))
    return min(found, key=lambda start: start.scale_mm)


def _linear(points: ExternalPoints, flange: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least squares for R (9), t_0 (3) of every frame and every target (3), reweighted; least norm where they stay open."""
    n_frames, n_targets, rows = len(points.references), len(points.targets), np.arange(points.n_shots)
    size = 12 * n_frames + 3 * n_targets
    columns = np.zeros((points.n_shots, 3, size))
    for axis in range(3):
        for j in range(3):
            columns[rows, axis, 12 * points.reference + 3 * axis + j] = -points.points_in_reference_mm[:, j] / _ELEMENT_SCALE_MM
        columns[rows, axis, 12 * points.reference + 9 + axis] = -1.0
        columns[rows, :, 12 * n_frames + 3 * points.target + axis] = flange[:, :3, axis]
    weight = np.ones(points.n_shots)
    for _ in range(_FRAME_ROUNDS):
        root = np.sqrt(weight)[:, None]
        right = -(flange[:, :3, 3] * root).reshape(-1)
        unknowns = np.linalg.lstsq((columns * root[:, :, None]).reshape(-1, size), right, rcond=1e-9)[0]
        miss = np.linalg.norm(columns @ unknowns + flange[:, :3, 3], axis=1)
        weight = _weights(miss, max(float(np.median(miss)) / MEDIAN_LENGTH, _SMALLEST_SCALE_MM))
    of_frames = unknowns[: 12 * n_frames].reshape(n_frames, 12)
    rotations = np.array([se3.nearest_rotation(matrix) for matrix in (of_frames[:, :9] / _ELEMENT_SCALE_MM).reshape(-1, 3, 3)])
    return se3.from_rotation_translation(rotations, of_frames[:, 9:]), np.asarray(unknowns[12 * n_frames :].reshape(n_targets, 3))


def _kabsch(points: ExternalPoints, flange: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Targets at the flange's origin, frames by the rigid motion that brings the measured points there."""
    seen = [points.reference == index for index in range(len(points.references))]
    frames = [se3.fit_rigid(points.points_in_reference_mm[of], flange[of, :3, 3]) for of in seen]
    return np.array(frames), np.zeros((len(points.targets), 3))


def _refined(problem: Problem, start: ExternalStart, free: NDArray[np.bool_], n_rounds: int) -> ExternalStart:
    """Gauss-Newton on some of the unknowns, points weighted by how far off they are; pose noise is left to the scale."""
    state, weight, scale = replace(start.state, pose_noise=np.zeros((problem.n_scans, 6))), start.weight, start.scale_mm
    for turn in range(n_rounds + 1):
        rows = _rows_of(problem, state)
        miss = np.linalg.norm(rows.residual_mm, axis=1)
        scale = max(float(np.median(miss)) / MEDIAN_LENGTH * _lost_freedom(problem, free), _SMALLEST_SCALE_MM)
        weight = _weights(miss, scale)
        step = _step(problem, state, rows, weight, scale, free)
        if turn == n_rounds or np.abs(rows.columns @ step).max() < _SETTLED_SCALES * scale:
            break
        state = state.moved(problem.layout, step, np.zeros_like(state.pose_noise))
    return ExternalStart(state, miss, scale, weight)


def _step(problem: Problem, state: State, rows: ExternalRows, weight: FloatArray, scale_mm: float, free: NDArray[np.bool_]) -> FloatArray:
    noise = NoiseModel(scale_mm, 1e-6, 1e-9, external_mm=scale_mm)
    nothing = np.zeros((problem.n_shots, problem.layout.n_camera + 5, problem.layout.n_camera + 5))
    priors = normal.linearise(problem, state, linearise_geometry(problem, state), nothing, np.zeros(problem.n_shots))
    sums = joined(priors, replace(rows, points=replace(rows.points, weight=weight)), noise)
    step = np.zeros(problem.layout.size)
    step[free] = -normal.symmetric_solve(sums.hessian[np.ix_(free, free)], sums.gradient[free])
    return step


def _rows_of(problem: Problem, state: State) -> ExternalRows:
    rows = external_rows(problem, state)
    if rows is None:
        raise DataError("there are no external points", remedy="Give shots with reference, target and point_in_reference_mm.")
    return rows


def _lost_freedom(problem: Problem, free: NDArray[np.bool_]) -> float:
    """How much larger residuals would be had the unknowns not been fitted to them."""
    layout = problem.layout
    n_unknowns = 6 * layout.n_references + 3 * layout.n_targets
    n_unknowns += max(4 * layout.n_links - 6, 0) if free[layout.links].any() else 0
    n_rows = 3 * (problem.external.n_shots if problem.external else 0)
    return float(np.sqrt(n_rows / max(n_rows - n_unknowns, 3)))


def _weights(miss_mm: FloatArray, scale_mm: float) -> FloatArray:
    return np.asarray((1.0 + (miss_mm / (_CUTOFF_SCALES * scale_mm)) ** 2) ** -2.0)


def _likely_cause(problem: Problem, state: State) -> str:
    """What makes the points fit, told as a guess; found by trying each."""
    points, model = problem.external, problem.model
    if points is None or model is None:
        return ""
    found = {name: _best_frames(attempt(problem, points, model), state).scale_mm for name, attempt in _CAUSES.items()}
    name, scale_mm = min(found.items(), key=lambda item: item[1])
    if scale_mm <= LARGEST_SCALE_MM:
        return f"most likely {name} (with that {scale_mm:.2f} mm)"
    return "no single cause explains it"


_Attempt = Callable[[Problem, ExternalPoints, RobotModel], Problem]


def _with_angles(problem: Problem, points: ExternalPoints, joints_rad: FloatArray) -> Problem:
    return replace(problem, external=replace(points, joints_rad=joints_rad))


def _with_points(problem: Problem, points: ExternalPoints, factor: ArrayLike) -> Problem:
    return replace(problem, external=replace(points, points_in_reference_mm=points.points_in_reference_mm * np.asarray(factor)))


_CAUSES: dict[str, _Attempt] = {
    "the points are in metres": lambda problem, points, _: _with_points(problem, points, 1000.0),
    "the reference frame is left-handed": lambda problem, points, _: _with_points(problem, points, [1.0, -1.0, 1.0]),
    "the axis angles are in degrees": lambda problem, points, _: _with_angles(problem, points, np.radians(points.joints_rad)),
    "the axes come in reverse order": lambda problem, points, _: _with_angles(problem, points, points.joints_rad[:, ::-1]),
    "points and axis angles are shifted by one shot": lambda problem, points, _: _with_angles(problem, points, np.roll(points.joints_rad, 1, axis=0)),
    "points and axis angles are shifted by one shot the other way": lambda problem, points, _: _with_angles(
        problem, points, np.roll(points.joints_rad, -1, axis=0)
    ),
    "the coupling of the robot model does not belong to these axis angles": lambda problem, _, model: replace(
        problem, model=replace(model, coupling=np.eye(model.n_joints))
    ),
    "the parallelogram coupling theta_3 = q_3 - q_2 is missing from the robot model": lambda problem, _, model: replace(
        problem, model=replace(model, coupling=parallelogram(model.n_joints))
    ),
}
