"""What a calibration's covariance comes from: an exact split, since a covariance is made of what each piece of information leaves open.

With the information H the sum of its pieces H_k and S = inv(H), S = S H S = sum of S H_k S: each term is the covariance that
the noise of one piece alone causes. Here the piece of certificates: radii, the optical radius offset, lengths.
"""

from __future__ import annotations

import numpy as np

from calibrate import normal
from calibrate.clouds import Solution
from drivers.kinematics.se3 import FloatArray


def artefact_covariance(solution: Solution) -> FloatArray:
    """(P, P) part of `solution.covariance` that certificates cause."""
    problem = solution.problem
    layout = problem.layout
    information = np.zeros((layout.size, layout.size))
    information[layout.radius_offset, layout.radius_offset] = problem.priors.radius_offset_mm**-2
    information[layout.sphere_radius, layout.sphere_radius] = np.diag(problem.radius_sigma_mm**-2.0)
    for length in problem.lengths:
        row = np.zeros(layout.size)
        away = solution.state.centres_in_base_mm[length.first] - solution.state.centres_in_base_mm[length.second]
        for index, sign in ((length.first, 1.0), (length.second, -1.0)):
            start = layout.centres.start + 3 * index
            row[start : start + 3] = sign * away / np.linalg.norm(away) / length.sigma_mm
        information += np.outer(row, row)
    free = np.ones(layout.size, dtype=np.bool_)
    free[layout.terms] = problem.free_terms
    inverse = normal.symmetric_inverse(solution.reduced.hessian[np.ix_(free, free)])
    result = np.zeros_like(information)
    result[np.ix_(free, free)] = inverse @ information[np.ix_(free, free)] @ inverse
    return result
