"""Poses for a quick check: those that tell the causes of a drift apart.

Of cause h at its usual size, `s² = h' (V + D P D')^-1 h` is what is left for the eye after another cause (columns D,
generous prior P) has taken its share; the chance to mistake one for the other falls as exp(-s² / 8) (Chernoff). The
poses chosen make the worst such pair as clear as can be. Axis 1 against a moved sphere and axis n against the
mounting are left out: no pose tells them apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from calibrate.design_shots import cap_points
from calibrate.drift_causes import CAMERA, HAND_EYE, SHOT, Cause, causes_of
from calibrate.observations import SphereShot
from calibrate.quick_check import CheckResiduals, check_residuals, known_state
from calibrate.result import Calibration
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

LARGEST_TILT_RAD = float(np.radians(60))
"""Of views that a check may be chosen from: the more oblique, the longer the levers of axes 4 and 5."""
_GENEROUS = 8.0
"""Factor on the usual size of a cause that another one must be told from."""
_HAND_EYE_MM = 0.3
_STARTS, _SWEEPS = 2, 4
_ALARM_SIGMAS, _MISSED_COUNTS = 3.3, 3.0
"""How far a change must stand out to give an alarm, and what missing it counts against naming a wrong cause."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckDesign:
    """Chosen poses."""

    rows: NDArray[np.int64]
    """(n,) of the candidates."""
    separations: dict[str, float]
    """For each cause to be named, in standard deviations from the one that resembles it most."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pool:
    covariance: FloatArray
    """(3 m, 3 m) of all candidates together."""
    effects: FloatArray
    """(3 m, e) of every cause to be named."""
    effect_names: tuple[str, ...]
    others: tuple[tuple[str, FloatArray], ...]
    """Columns (3 m, k) of every cause, as large as it may be."""


def choose_check_poses(
    calibration: Calibration, joints_rad: FloatArray, spheres: Sequence[str], n: int, rng: np.random.Generator, radius_mm: dict[str, float]
) -> CheckDesign:
    """The n of some candidates that tell the causes of a drift apart best.

    Args:
        calibration: of the whole robot; its covariance and noise count.
        joints_rad: (m, n_axes) of the candidates.
        spheres: (m,) which sphere of the calibration each looks at.
        n: how many to choose.
        rng: seeded by the caller.
        radius_mm: certified radius of every sphere.
    """
    pool = _pool(calibration, joints_rad, spheres, radius_mm)
    m = len(joints_rad)
    tried = [_exchanged(pool, rng.permutation(m)[:n], m) for _ in range(_STARTS)]
    rows = np.sort(min(tried, key=lambda found: found[1])[0])
    squares = _separations(pool, rows[None])[1][0]
    least: dict[str, float] = {}
    for e, name in enumerate(pool.effect_names):
        least[name] = min(least.get(name, np.inf), float(np.sqrt(squares[e].min())))
    return CheckDesign(rows, least)


def ideal_shots(calibration: Calibration, joints_rad: FloatArray, spheres: Sequence[str], radius_mm: dict[str, float]) -> list[SphereShot]:
    """What shots would show if nothing had changed: caps without noise."""
    shots = []
    flange = calibration.base_from_flange(joints_rad)
    for i, (q, name) in enumerate(zip(joints_rad, spheres, strict=True)):
        camera_from_base = se3.inverse(flange[i] @ calibration.flange_from_camera)
        centre = se3.apply(camera_from_base, calibration.sphere_centres_in_base_mm[name])
        radius = radius_mm[name] + calibration.sphere_radius_offsets_mm[name]
        points = cap_points(centre[None], np.array([radius]))[0]
        points = points - calibration.camera_correction_mm(points)
        shots.append(SphereShot("", i, name, f"{i:064d}", q, flange[i], points, radius_mm[name], centre))
    return shots


def clarity(residuals: CheckResiduals, causes: Sequence[Cause]) -> dict[str, tuple[float, float]]:
    """For each cause to be named how far its usual size stands out of the noise, and apart from the cause that resembles it most (sigmas)."""
    pool = _pool_of(residuals, causes)
    everything = np.arange(residuals.n_shots)[None]
    alone, together = _separations(pool, everything)
    apart = np.sqrt(together[0].min(axis=-1))
    seen = np.sqrt(alone[0])
    names = dict.fromkeys(pool.effect_names)
    members = {name: [e for e, own in enumerate(pool.effect_names) if own == name] for name in names}
    return {name: (float(seen[rows].min()), float(apart[rows].min())) for name, rows in members.items()}


def _pool(calibration: Calibration, joints_rad: FloatArray, spheres: Sequence[str], radius_mm: dict[str, float]) -> _Pool:
    residuals = check_residuals(calibration, ideal_shots(calibration, joints_rad, spheres, radius_mm))
    state = known_state(calibration, residuals.problem.n_scans)
    return _pool_of(residuals, causes_of(residuals, state, tuple(calibration.sphere_centres_in_base_mm)))


def _pool_of(residuals: CheckResiduals, causes: Sequence[Cause]) -> _Pool:
    effects, names = _effects(causes, residuals)
    others = []
    for cause in causes:
        if cause.name != SHOT:
            columns = np.concatenate([shape.scaled for shape in cause.shapes], axis=1)
            others.append((cause.name, _GENEROUS * columns))
    return _Pool(residuals.covariance_mm2, effects, names, tuple(others))


def _effects(causes: Sequence[Cause], residuals: CheckResiduals) -> tuple[FloatArray, tuple[str, ...]]:
    n_axes = 0 if residuals.problem.model is None else residuals.problem.model.n_joints
    columns, names = [], []
    for cause in causes:
        first = cause.shapes[0]
        if cause.name == HAND_EYE:
            columns += list(_HAND_EYE_MM * first.columns.T)
            names += [cause.name] * 3
        elif cause.name == CAMERA or (cause.name.startswith("axis") and cause.name not in ("axis 1", f"axis {n_axes}")):
            columns += list(first.scaled.T)
            names.append(cause.name)
    return np.array(columns).T, tuple(names)


def _separations(pool: _Pool, choices: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """(c, e) squared distance of every effect from nothing, and (c, e, o) from every other cause, for choices (c, n) of candidates."""
    index = (3 * choices[:, :, None] + np.arange(3)).reshape(len(choices), -1)
    factor = np.linalg.cholesky(pool.covariance[index[:, :, None], index[:, None, :]])
    everything = np.concatenate([pool.effects, *(columns for _, columns in pool.others)], axis=1)
    white = np.linalg.solve(factor, everything[index])
    e = pool.effects.shape[1]
    gram = np.swapaxes(white, -1, -2) @ white
    own = np.diagonal(gram[:, :e, :e], axis1=1, axis2=2)
    result = np.full((len(choices), e, len(pool.others)), np.inf)
    start = e
    for o, (name, columns) in enumerate(pool.others):
        part = slice(start, start + columns.shape[1])
        start = part.stop
        inner = gram[:, part, part] + np.eye(columns.shape[1])
        cross = gram[:, part, :e]
        taken = (cross * np.linalg.solve(inner, cross)).sum(axis=1)
        left = own - taken
        same = np.array([name == effect for effect in pool.effect_names])
        result[:, ~same, o] = np.maximum(left[:, ~same], 0.0)
    return own, result


def _criterion(pool: _Pool, choices: NDArray[np.int64]) -> FloatArray:
    """(c,) chance to miss a cause, and a bound on that to name a wrong one, summed."""
    seen, apart = _separations(pool, choices)
    return np.asarray(_MISSED_COUNTS * ndtr(_ALARM_SIGMAS - np.sqrt(seen)).sum(axis=1) + np.exp(-apart / 8).sum(axis=(1, 2)))


def _exchanged(pool: _Pool, rows: NDArray[np.int64], m: int) -> tuple[NDArray[np.int64], float]:
    value = float(_criterion(pool, rows[None])[0])
    for _ in range(_SWEEPS):
        before = value
        for place in range(len(rows)):
            free = np.setdiff1d(np.arange(m), rows)
            choices = np.repeat(rows[None], len(free), axis=0)
            choices[:, place] = free
            values = _criterion(pool, choices)
            best = int(values.argmin())
            if values[best] < value:
                value, rows = float(values[best]), choices[best]
        if value > before * (1 - 1e-3):
            break
    return rows, value
