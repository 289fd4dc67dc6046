"""Shots that the other shots cannot explain: studentised misses, the worst taken out first.

A shot pulls the solution towards itself, most where no other shot has its posture: its miss e in the solution has the
covariance V - S C S' (V of its own centre, S how that moves with the unknowns, C theirs), not V, and without it the solution
would miss it by V inv(V - S C S') e. One bad shot makes its neighbours look bad, too, so the worst goes first, and what the
others look like without it follows to first order:

    C <- C + C S' inv(V - S C S') S C,   e_i <- e_i + S_i C S' inv(V - S C S') e.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibrate import normal
from calibrate.clouds import Solution
from calibrate.problem import Problem
from calibrate.validation import judge_arcs, predict, shot_centre_covariance_mm2
from drivers.kinematics.se3 import FloatArray

REJECT_CHI2 = 30.7
"""A clean shot exceeds this in one of a million cases (chi-square, three degrees of freedom)."""
_MEDIAN_CHI2 = 2.366
_LEAST_FREE = 0.05
"""Of a shot's variance: what it takes part in to more than 95 % it decides alone, and nobody can judge it."""


class Unexplained(NamedTuple):
    """The shots of a problem that noise, pose noise and the typical shot do not explain."""

    far: NDArray[np.bool_]
    """(m,)."""
    miss_mm: FloatArray
    """(m,) how far each shot's sphere lies from where the others put it."""
    chi2: FloatArray
    """(m,) squared miss in units of what noise and the others' own uncertainty explain; zero of far ones."""
    directions: FloatArray
    """(m,) in how many directions a shot shows its centre: what `chi2` is on average."""


def unexplained(problem: Problem, solution: Solution) -> Unexplained:
    """Judge every shot by the others: an area camera's by its centre, a profile's by what of a centre it shows."""
    if problem.along_sight:
        miss = predict(problem, solution.state).centre_error_mm
        own, sensitivity = shot_centre_covariance_mm2(problem, solution)
        directions = np.full(problem.n_shots, 3.0)
    else:
        miss, own, sensitivity, directions = judge_arcs(problem, solution)
    # whitened by each shot's own covariance
    root = np.linalg.cholesky(own)
    white, sensitivity = np.linalg.solve(root, miss[..., None])[..., 0], np.linalg.solve(root, sensitivity)
    # terms of the arm that are held have next to no variance here: they do not give way to a shot
    covariance = normal.symmetric_inverse(solution.reduced.hessian)
    far = np.zeros(problem.n_shots, dtype=bool)
    others_mm = np.zeros(problem.n_shots)
    while True:
        pulls = sensitivity @ covariance
        inverse = _inverse_of_free(pulls @ np.swapaxes(sensitivity, 1, 2))
        without = (inverse @ white[..., None])[..., 0]
        others_mm = np.where(far, others_mm, np.linalg.norm((root @ without[..., None])[..., 0], axis=1))
        chi2 = np.where(far, 0.0, np.einsum("mi,mi->m", white, without))
        worst = int(np.argmax(chi2))
        if chi2[worst] <= REJECT_CHI2 * max(1.0, float(np.median(chi2[~far])) / _MEDIAN_CHI2) or far.sum() > problem.n_shots // 2:
            return Unexplained(far, others_mm, chi2, directions)
        far[worst] = True
        white = white + sensitivity @ (pulls[worst].T @ without[worst])
        covariance = covariance + pulls[worst].T @ inverse[worst] @ pulls[worst]


def _inverse_of_free(leverage: FloatArray) -> FloatArray:
    """(m, 3, 3) inverses of 1 - leverage, nowhere more than can be judged."""
    values, vectors = np.linalg.eigh(np.eye(3) - leverage)
    return np.asarray((vectors / np.maximum(values, _LEAST_FREE)[:, None, :]) @ np.swapaxes(vectors, 1, 2))
