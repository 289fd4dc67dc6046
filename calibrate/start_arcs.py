"""A first guess from line profiles: many starts, since one arc leaves the side of its plane open (METHOD.md 5)."""

from __future__ import annotations

import numpy as np

from calibrate.problem import IntArray, Problem, State
from calibrate.start import Start, initial_state
from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

_N_STARTS = 48
_POINTS_PER_ARC = 24


def start_from_arcs(problem: Problem, guess: FloatArray | None, seed: int = 7447) -> Start:
    """The best of many local solves for hand-eye and centres on thinned-out arcs, every other error at zero.

    Raises:
        DataError: fewer than six arcs.
    """
    from scipy.optimize import least_squares

    if problem.n_shots < 6:
        raise DataError(
            f"{problem.n_shots} profiles are too few", remedy="Take at least 12 profiles of the sphere, turned and shifted in all directions."
        )
    points, shot = _thinned(problem)
    n_spheres = len(problem.radius_mm)

    def unpack(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return se3.from_rotation_translation(se3.exp_so3(x[:3]), x[3:6]), x[6:].reshape(n_spheres, 3)

    def residuals(x: FloatArray) -> FloatArray:
        hand_eye, centres = unpack(x)
        in_base = se3.apply((problem.base_from_flange @ hand_eye)[shot], points)
        return np.asarray(np.linalg.norm(in_base - centres[problem.sphere[shot]], axis=1) - problem.radius_mm[problem.sphere[shot]])

    best_x, best_cost = None, np.inf
    for first in _starts(problem, points, shot, guess, np.random.default_rng(seed)):
        found = least_squares(residuals, first, method="lm", max_nfev=600)
        if found.cost < best_cost:
            best_x, best_cost = np.asarray(found.x), float(found.cost)
    if best_x is None:  # pragma: no cover - _starts always yields
        raise DataError("no first guess", remedy="Give flange_from_camera in the cell file.")
    hand_eye, centres = unpack(best_x)
    state: State = initial_state(problem, hand_eye, centres)
    return Start(state, np.zeros(problem.n_shots), float(np.sqrt(2 * best_cost / len(points))))


def _starts(problem: Problem, points: FloatArray, shot: IntArray, guess: FloatArray | None, rng: np.random.Generator) -> list[FloatArray]:
    """Random orientations, each with the linear solution for translation and centres when points stood for centres."""
    rotations = [] if guess is None else [guess[:3, :3]]
    quaternions = rng.normal(size=(_N_STARTS, 4))
    rotations += list(_rotation_of_quaternion(quaternions))
    return [_linear_rest(problem, points, shot, rotation) for rotation in rotations]


def _linear_rest(problem: Problem, points: FloatArray, shot: IntArray, rotation: FloatArray) -> FloatArray:
    mean = np.stack([points[shot == j].mean(axis=0) for j in range(problem.n_shots)])
    flange = problem.base_from_flange
    n_spheres = len(problem.radius_mm)
    columns = np.zeros((problem.n_shots, 3, 3 + 3 * n_spheres))
    columns[:, :, :3] = flange[:, :3, :3]
    rows = np.arange(problem.n_shots)
    for axis in range(3):
        columns[rows, axis, 3 + 3 * problem.sphere + axis] = -1.0
    right = -(flange[:, :3, 3] + np.einsum("mij,jk,mk->mi", flange[:, :3, :3], rotation, mean))
    solution = np.linalg.lstsq(columns.reshape(-1, 3 + 3 * n_spheres), right.reshape(-1), rcond=1e-6)[0]
    return np.concatenate([se3.log_so3(rotation), solution])


def _rotation_of_quaternion(wxyz: FloatArray) -> FloatArray:
    q = wxyz / np.linalg.norm(wxyz, axis=-1, keepdims=True)
    angle = 2 * np.arccos(np.clip(q[:, 0], -1, 1))
    axis = q[:, 1:] / np.maximum(np.linalg.norm(q[:, 1:], axis=-1, keepdims=True), 1e-12)
    return se3.exp_so3(axis * angle[:, None])


def _thinned(problem: Problem) -> tuple[FloatArray, IntArray]:
    """Points (k, 3) and their shot (k,), evenly along each arc."""
    chosen = [
        np.linspace(a, b - 1, min(_POINTS_PER_ARC, b - a)).astype(np.int64) for a, b in zip(problem.starts[:-1], problem.starts[1:], strict=True)
    ]
    shot = np.repeat(np.arange(problem.n_shots), [len(c) for c in chosen])
    return problem.points_in_camera_mm[np.concatenate(chosen)], shot.astype(np.int64)
