"""The whole-cloud solver: Gauss-Newton on every point, pose noise estimated along the way (METHOD.md 4)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibrate import normal
from calibrate.normal import Linearised, NoiseModel, Reduced
from calibrate.problem import Geometry, Problem, State, expected_radius_mm, linearise_geometry
from calibrate.variance import estimate_point_noise, estimate_pose_noise
from drivers.errors import DataError
from drivers.kinematics.se3 import FloatArray

POINT_CUTOFF_SIGMAS = 5.0
"""Geman-McClure cutoff in standard deviations: a clean point keeps 92 % of its weight on average."""
_LAST_ESTIMATE = 7
"""Passes in which the noise model is estimated anew; later ones hold it, so that the descent can end."""
_FIRST_SWEEPS = 4
_STEP_TOLERANCE_MM = 1e-8
_STALL_TOLERANCE_MM = 1e-5
_PATIENCE, _LAST_TOLERANCE_MM = 25, 1e-3
"""A point that changes sides between two passes can keep a solve from its last digits: a micrometre is then enough."""
_REBASE_TOLERANCE_MM = 1e-5
_MAX_PASSES = 40


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where the solve ended, and what the data say about it."""

    problem: Problem
    """With the camera basis of the denoised points."""
    state: State
    noise: NoiseModel
    linearised: Linearised
    reduced: Reduced
    geometry: Geometry
    moments: FloatArray
    point_rms_mm: FloatArray
    """(m,) rms radial residual of each shot with its pose noise taken out."""
    passes: int

    @property
    def covariance(self) -> FloatArray:
        """(P, P) of the unknowns, pose noise included; deflection terms that were held are considered.

        With S = -inv(H_xx) H_xc the estimate of the others follows a deflection c by S c (Schmidt 1966), so that their
        covariance is inv(H_xx) + S Q S' and the cross covariance S Q, Q the prior of c.
        """
        layout = self.problem.layout
        if self.problem.estimate_terms or not layout.n_terms:
            return normal.symmetric_inverse(self.reduced.hessian)
        held = np.zeros(layout.size, dtype=bool)
        held[layout.terms] = True
        free = ~held
        inverse = normal.symmetric_inverse(self.reduced.hessian[np.ix_(free, free)])
        follows = -inverse @ self.reduced.hessian[np.ix_(free, held)]
        variance = self.problem.priors.term_sigma_rad(self.problem.terms) ** 2
        result = np.zeros((layout.size, layout.size))
        result[np.ix_(free, free)] = inverse + follows * variance @ follows.T
        result[np.ix_(free, held)] = follows * variance
        result[np.ix_(held, free)] = (follows * variance).T
        result[np.ix_(held, held)] = np.diag(variance)
        return result


def solve_clouds(
    problem: Problem, start: State, noise: NoiseModel, *, estimate_noise: bool = True, tolerance_mm: float = _STEP_TOLERANCE_MM
) -> Solution:
    """Minimise the whole-cloud cost from a start that is good to some millimetres.

    Without `estimate_noise` the noise model and the camera basis are taken as given.

    Raises DataError when the passes do not settle, which means that data and model do not belong together.
    """
    state, step_mm, settled = start, np.inf, False
    cutoff = np.inf if estimate_noise else POINT_CUTOFF_SIGMAS * float(np.hypot(noise.point_mm, noise.form_mm))
    n_points = np.diff(problem.starts).astype(np.float64)
    for passes in range(1, _MAX_PASSES + 1):
        geometry = linearise_geometry(problem, state)
        if estimate_noise and passes > 1 and step_mm > _REBASE_TOLERANCE_MM:
            problem = rebased(problem, state, geometry)
        estimating = estimate_noise and passes <= _LAST_ESTIMATE
        if estimating:
            noise = estimate_point_noise(patch_sums(problem, state, geometry, cutoff), noise)
            cutoff = POINT_CUTOFF_SIGMAS * np.hypot(noise.point_mm, noise.form_mm)
        moments, counts = shot_moments(problem, state, geometry, cutoff)
        linearised = normal.linearise(problem, state, geometry, moments, noise.point_weight(n_points))
        if estimating and passes > 1:
            noise = estimate_pose_noise(linearised, noise, sweeps=_FIRST_SWEEPS if passes == 2 else 1)
        reduced = normal.reduce(linearised, noise.pose_precision)
        if settled:
            rms = np.sqrt(counts[:, 1] / counts[:, 2])
            return Solution(problem, state, noise, linearised, reduced, geometry, moments, rms, passes)
        step, noise_step = normal.solve_step(linearised, reduced)
        state = state.moved(problem.layout, step, noise_step)
        previous_mm, step_mm = step_mm, _size_mm(problem, geometry, step)
        # rounding ends the descent of nearly noise-free data some digits above the tolerance
        stalled = step_mm < (_STALL_TOLERANCE_MM if passes < _PATIENCE else _LAST_TOLERANCE_MM) and step_mm > 0.3 * previous_mm
        settled = (passes > 2 or not estimate_noise) and (step_mm < tolerance_mm or stalled)
    raise DataError(
        f"the solve did not settle in {_MAX_PASSES} passes (last step {step_mm:.2g} mm)",
        remedy="Check that the robot model, the spheres and the scans belong together; `spherecal centres` shows each shot.",
    )


def rebased(problem: Problem, state: State, geometry: Geometry) -> Problem:
    """The problem with the camera basis taken where the points would be without their noise.

    Taken at the noisy points it correlates with their residuals (errors in variables): 0.08 mm of depth noise then cost
    0.015 mm of bias on the paper's cell; with the basis of the denoised points none was seen.
    """
    from calibrate import moments_kernels

    if not problem.layout.n_camera:
        return problem
    points = np.zeros_like(problem.points_in_camera_mm)
    moments_kernels.denoised_points(*_kernel_arguments(problem, state, geometry), points)
    return replace(problem, basis=problem.camera_error.basis(points))


def shot_moments(problem: Problem, state: State, geometry: Geometry, cutoff_mm: float) -> tuple[FloatArray, FloatArray]:
    """Moments (m, v, v) of every shot and its counts (m, 3): sum of weights, sum of r², points."""
    from calibrate import moments_kernels

    size = problem.layout.n_camera + 5
    moments, counts = np.zeros((problem.n_shots, size, size)), np.zeros((problem.n_shots, 3))
    moments_kernels.shot_moments(*_kernel_arguments(problem, state, geometry), cutoff_mm, moments, counts)
    return moments, counts


def patch_sums(problem: Problem, state: State, geometry: Geometry, cutoff_mm: float) -> FloatArray:
    """(m, 12, 3) numbers, sums and sums of squares of the residuals by patch of each shot."""
    from calibrate import moments_kernels

    sums = np.zeros((problem.n_shots, normal.PATCHES, 3))
    moments_kernels.patch_sums(*_kernel_arguments(problem, state, geometry), cutoff_mm, sums)
    return sums


_KernelArguments = tuple[FloatArray, FloatArray, NDArray[np.int64], FloatArray, NDArray[np.int64], FloatArray, FloatArray, bool]


def _kernel_arguments(problem: Problem, state: State, geometry: Geometry) -> _KernelArguments:
    return (
        problem.points_in_camera_mm,
        problem.basis,
        problem.camera_error.axis,
        state.camera_mm,
        problem.starts,
        geometry.centre_in_camera_mm,
        expected_radius_mm(problem, state),
        problem.along_sight,
    )


def _size_mm(problem: Problem, geometry: Geometry, step: FloatArray) -> float:
    """Largest motion of any expected centre that a step causes: gauge directions do not count."""
    return float(np.abs(geometry.columns[:, :3] @ step).max())
