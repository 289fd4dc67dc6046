"""A first guess from line profiles: many starts, since one arc leaves the side of its plane open (METHOD.md 5).

All starts are refined side by side (Levenberg-Marquardt on thinned-out arcs). A given guess that leads to a good fit
near itself is taken without them. A few arcs that lie far from where the others put them are then left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrate.problem import IntArray, Problem
from calibrate.start import Start, initial_state
from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

BoolArray = NDArray[np.bool_]

_N_STARTS = 48
_POINTS_PER_ARC = 16
_ROUNDS, _FINALISTS, _FINAL_ROUNDS = 25, 6, 60
_LEVER_MM = 300.0
_GOOD_MM, _NEAR_MM, _NEAR_RAD = 0.5, 100.0, 0.35
_SPOILED, _SPOILED_MM, _MOST_SPOILED, _SPOILED_ROUNDS = 4.0, 1.0, 0.25, 6
"""An arc this many times further off than the median one, and so far at least, is left out; not more than a quarter of all."""
_ENOUGH_ARCS = 12
"""With fewer a wrong solution may fit as well, and all starts are compared."""


@dataclass(frozen=True, slots=True, eq=False)
class _Arcs:
    """Thinned-out arcs: N points of m shots on S spheres."""

    base_from_flange: FloatArray
    """(N, 4, 4) of each point's shot."""
    points_in_camera_mm: FloatArray
    """(N, 3)"""
    member: FloatArray
    """(N, S), 1 for the point's sphere."""
    radius_mm: FloatArray
    """(N,)"""
    shot: IntArray
    """(N,) of each point."""

    def of_shots(self, keep: BoolArray) -> _Arcs:
        """The arcs of some shots (m,)."""
        rows = keep[self.shot]
        return _Arcs(self.base_from_flange[rows], self.points_in_camera_mm[rows], self.member[rows], self.radius_mm[rows], self.shot[rows])


@dataclass(frozen=True, slots=True, eq=False)
class _Fits:
    """B solutions."""

    flange_from_camera: FloatArray
    """(B, 4, 4)"""
    centres_in_base_mm: FloatArray
    """(B, S, 3)"""
    rms_mm: FloatArray
    """(B,)"""

    def part(self, rows: IntArray) -> _Fits:
        return _Fits(self.flange_from_camera[rows], self.centres_in_base_mm[rows], self.rms_mm[rows])


def start_from_arcs(problem: Problem, guess: FloatArray | None, seed: int = 7447, *, n_starts: int = _N_STARTS) -> Start:
    """The best of many local solves for hand-eye and centres, every other error at zero; of one where the guess is good.

    Raises:
        DataError: fewer than six arcs.
    """
    if problem.n_shots < 6:
        raise DataError(
            f"{problem.n_shots} profiles are too few", remedy="Take at least 12 profiles of the sphere, turned and shifted in all directions."
        )
    arcs, mean = _thinned(problem)
    if guess is not None:
        guessed = _refined(arcs, _start(problem, mean, guess[None, :3, :3]), _FINAL_ROUNDS)
        if problem.n_shots >= _ENOUGH_ARCS and _is_good(guessed, guess):
            return _as_start(problem, arcs, guessed)
    quaternions = np.random.default_rng(seed).normal(size=(n_starts, 4))
    fits = _refined(arcs, _start(problem, mean, _rotation_of_quaternion(quaternions)), _ROUNDS)
    fits = _refined(arcs, fits.part(np.argsort(fits.rms_mm, kind="stable")[:_FINALISTS]), _FINAL_ROUNDS)
    fits = fits.part(np.argsort(fits.rms_mm, kind="stable")[:1])
    return _as_start(problem, arcs, fits if guess is None or fits.rms_mm[0] < guessed.rms_mm[0] else guessed)


def _is_good(fits: _Fits, guess: FloatArray) -> bool:
    off = se3.log(se3.inverse(guess) @ fits.flange_from_camera[0])
    return bool(fits.rms_mm[0] < _GOOD_MM and np.linalg.norm(off[:3]) < _NEAR_MM and np.linalg.norm(off[3:]) < _NEAR_RAD)


def _as_start(problem: Problem, arcs: _Arcs, fits: _Fits) -> Start:
    fits, miss_mm, keep = _without_spoiled(arcs, fits, problem.n_shots)
    state = initial_state(problem, fits.flange_from_camera[0], fits.centres_in_base_mm[0])
    return Start(state, np.where(keep, 0.0, miss_mm), float(fits.rms_mm[0]))


def _without_spoiled(arcs: _Arcs, fits: _Fits, n_shots: int) -> tuple[_Fits, FloatArray, BoolArray]:
    """A fit (B = 1) of all arcs but a few far ones, the rms (m,) of each arc about it, and which arcs it is of."""
    keep = np.ones(n_shots, dtype=bool)
    for _ in range(_SPOILED_ROUNDS):
        miss_mm = _rms_of_shots_mm(arcs, fits, n_shots)
        far = miss_mm > max(_SPOILED * float(np.median(miss_mm)), _SPOILED_MM)
        if far.mean() > _MOST_SPOILED or (far == ~keep).all():
            break
        keep = ~far
        part = arcs.of_shots(keep)
        fits = _refined(part, _linearised(part, fits)[0], _FINAL_ROUNDS)
    return fits, _rms_of_shots_mm(arcs, fits, n_shots), keep


def _rms_of_shots_mm(arcs: _Arcs, fits: _Fits, n_shots: int) -> FloatArray:
    """(m,) about a fit (B = 1)."""
    _, _, residual = _linearised(arcs, fits)
    squares = np.bincount(arcs.shot, residual[0] ** 2, minlength=n_shots)
    return np.asarray(np.sqrt(squares / np.bincount(arcs.shot, minlength=n_shots)))


def _start(problem: Problem, mean_in_camera_mm: FloatArray, rotations: FloatArray) -> _Fits:
    """For rotations (B, 3, 3) the linear solution of translation and centres when each arc's mean (m, 3) stood for the centre."""
    flange, n_spheres, m = problem.base_from_flange, len(problem.radius_mm), problem.n_shots
    columns = np.zeros((m, 3, 3 + 3 * n_spheres))
    columns[:, :, :3] = flange[:, :3, :3]
    for axis in range(3):
        columns[np.arange(m), axis, 3 + 3 * problem.sphere + axis] = -1.0
    turned = np.einsum("mij,bjk,mk->bmi", flange[:, :3, :3], rotations, mean_in_camera_mm)
    right = -(flange[:, :3, 3] + turned).reshape(len(rotations), -1)
    solution = np.linalg.lstsq(columns.reshape(3 * m, -1), right.T, rcond=1e-6)[0].T
    return _Fits(
        se3.from_rotation_translation(rotations, solution[:, :3]), solution[:, 3:].reshape(-1, n_spheres, 3), np.full(len(rotations), np.inf)
    )


def _refined(arcs: _Arcs, fits: _Fits, rounds: int) -> _Fits:
    """Levenberg-Marquardt of every solution by itself."""
    damping = np.full(len(fits.rms_mm), 1e-3)
    best, rows, residual = _linearised(arcs, fits)
    for _ in range(rounds):
        normal = np.swapaxes(rows, 1, 2) @ rows
        diagonal = np.einsum("bkk->bk", normal)
        damped = normal + ((damping[:, None] * diagonal) + 1e-9 * diagonal.max(axis=1)[:, None])[:, :, None] * np.eye(normal.shape[1])
        step = -np.linalg.solve(damped, np.swapaxes(rows, 1, 2) @ residual[..., None])[..., 0]
        tried, tried_rows, tried_residual = _linearised(arcs, _moved(best, step))
        better = tried.rms_mm < best.rms_mm
        damping = np.clip(np.where(better, damping * 0.2, damping * 5.0), 1e-9, 1e6)
        if not better.any() and damping.min() > 1e3:
            break
        best = _Fits(
            np.where(better[:, None, None], tried.flange_from_camera, best.flange_from_camera),
            np.where(better[:, None, None], tried.centres_in_base_mm, best.centres_in_base_mm),
            np.where(better, tried.rms_mm, best.rms_mm),
        )
        rows = np.where(better[:, None, None], tried_rows, rows)
        residual = np.where(better[:, None], tried_residual, residual)
    return best


def _moved(fits: _Fits, step: FloatArray) -> _Fits:
    twist = step[:, :6] / [1, 1, 1, _LEVER_MM, _LEVER_MM, _LEVER_MM]
    return _Fits(se3.exp(twist) @ fits.flange_from_camera, fits.centres_in_base_mm + step[:, 6:].reshape(fits.centres_in_base_mm.shape), fits.rms_mm)


def _linearised(arcs: _Arcs, fits: _Fits) -> tuple[_Fits, FloatArray, FloatArray]:
    """The solutions with their rms, derivatives (B, N, 6 + 3 S) by left twist and centres, residuals (B, N) `|W - c| - R`."""
    in_flange = se3.apply(fits.flange_from_camera[:, None], arcs.points_in_camera_mm)
    away = se3.apply(arcs.base_from_flange, in_flange) - arcs.member @ fits.centres_in_base_mm
    distance = np.linalg.norm(away, axis=2)
    outward = away / np.maximum(distance, 1e-9)[..., None]
    in_flange_axes = (outward[..., None, :] @ arcs.base_from_flange[:, :3, :3])[..., 0, :]
    by_centres = -(arcs.member[..., None] * outward[:, :, None, :]).reshape(*distance.shape, -1)
    rows = np.concatenate([in_flange_axes, np.cross(in_flange, in_flange_axes) / _LEVER_MM, by_centres], axis=-1)
    residual = distance - arcs.radius_mm
    return _Fits(fits.flange_from_camera, fits.centres_in_base_mm, np.sqrt((residual**2).mean(axis=1))), rows, residual


def _rotation_of_quaternion(wxyz: FloatArray) -> FloatArray:
    q = wxyz / np.linalg.norm(wxyz, axis=-1, keepdims=True)
    angle = 2 * np.arccos(np.clip(q[:, 0], -1, 1))
    axis = q[:, 1:] / np.maximum(np.linalg.norm(q[:, 1:], axis=-1, keepdims=True), 1e-12)
    return se3.exp_so3(axis * angle[:, None])


def _thinned(problem: Problem) -> tuple[_Arcs, FloatArray]:
    """Some points evenly along each arc, and the mean (m, 3) of each arc."""
    ends = zip(problem.starts[:-1], problem.starts[1:], strict=True)
    chosen = [np.linspace(a, b - 1, min(_POINTS_PER_ARC, b - a)).astype(np.int64) for a, b in ends]
    shot = np.repeat(np.arange(problem.n_shots), [len(rows) for rows in chosen])
    points, sphere = problem.points_in_camera_mm[np.concatenate(chosen)], problem.sphere[shot]
    arcs = _Arcs(problem.base_from_flange[shot], points, np.eye(len(problem.radius_mm))[sphere], problem.radius_mm[sphere], shot)
    return arcs, np.array([problem.points_in_camera_mm[rows].mean(axis=0) for rows in chosen])
