"""The sight crossing S of a pillow, found on the points: S enters the pillow non-linearly, so it is linearised over and over.

Few data say much of S beside the coefficients, so it is held near where it was said to be by a prior of physical size.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibrate import normal
from calibrate.camera_error_pillow import FreeCrossing
from calibrate.clouds import Solution
from calibrate.linear_folds import linearised_at, solved
from calibrate.problem import Problem, State, linearise_geometry
from drivers.kinematics.se3 import FloatArray

_MAX_STEPS = 12
_LONGEST_MM = 40.0
_SETTLED_MM = 0.3
"""A crossing this near moves no point by a micrometre."""


def find_crossing(solution: Solution) -> tuple[FreeCrossing, State]:
    """The most likely crossing under its prior about the one that the solution's model has, and the state there.

    Args:
        solution: with a `FreeCrossing` for its camera model; its points may be thinned.
    """
    given = solution.problem.camera_error
    if not isinstance(given, FreeCrossing):
        raise TypeError(f"{given.name} has no free crossing")
    first = np.array(given.pillow.sight_crossing_mm)
    n_own = len(given.pillow.axis)
    state = replace(solution.state, camera_mm=np.concatenate([solution.state.camera_mm[:n_own], np.zeros(len(given.crossing_terms))]))
    model = _moved(given, first, state.camera_mm[:n_own])
    for _ in range(_MAX_STEPS):
        problem = replace(solution.problem, camera_error=model)
        step, shift = _step(problem, state, solution, model, np.array(model.pillow.sight_crossing_mm) - first)
        shorten = min(1.0, _LONGEST_MM / max(float(np.abs(shift).max()), 1e-12))
        state = state.moved(problem.layout, shorten * step, np.zeros_like(state.pose_noise))
        own = state.camera_mm[:n_own]
        state = replace(state, camera_mm=np.concatenate([own, np.zeros(len(model.crossing_terms))]))
        model = _moved(model, np.array(model.pillow.sight_crossing_mm) + shorten * shift, own)
        if float(np.abs(shift).max()) < _SETTLED_MM:
            break
    return model, state


def _step(problem: Problem, state: State, solution: Solution, model: FreeCrossing, away_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Step (P,) of all unknowns with one shift of the crossing for all axes, its prior about the crossing given; and the shift (3,)."""
    layout, noise = problem.layout, solution.noise
    linearised, _, _ = linearised_at(problem, state, linearise_geometry(problem, state), noise)
    reduced = normal.reduce(linearised, noise.pose_precision)
    changes = layout.camera.start + np.flatnonzero(model.coordinate >= 0)
    shared = np.zeros((layout.size, layout.size + 3))
    shared[:, : layout.size] = np.eye(layout.size)
    shared[changes, changes] = 0.0
    shared[changes, layout.size + model.coordinate[model.coordinate >= 0]] = 1.0
    # every change has a prior of its own in the normal equations, about where the crossing is now: taken out again
    own = reduced.hessian.copy()
    own[changes, changes] -= model.crossing_sigma_mm**-2.0
    hessian, gradient = shared.T @ own @ shared, shared.T @ reduced.gradient
    crossing = np.arange(layout.size, layout.size + 3)
    hessian[crossing, crossing] += model.crossing_sigma_mm**-2.0
    gradient[crossing] += model.crossing_sigma_mm**-2.0 * away_mm
    hessian[changes, changes] = 1.0
    found = solved(hessian, -gradient)
    return found[: layout.size], found[layout.size :]


def _moved(model: FreeCrossing, crossing_mm: FloatArray, coefficients_mm: FloatArray) -> FreeCrossing:
    x, y, z = (float(value) for value in crossing_mm)
    return replace(model, pillow=replace(model.pillow, sight_crossing_mm=(x, y, z)), about_mm=tuple(float(k) for k in coefficients_mm))
