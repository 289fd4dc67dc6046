"""What a solve needs of the points of every shot, made in one pass over them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.normal import PATCHES, NoiseModel
from calibrate.problem import Geometry, Problem, State, expected_radius_mm
from drivers.kinematics.se3 import FloatArray

POINT_CUTOFF_SIGMAS = 5.0
"""Geman-McClure cutoff in standard deviations: a clean point keeps 92 % of its weight on average."""
_LEAST_CURVATURE = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class ShotSums:
    """Sums over the points of m shots; v rows of a residual's share: normal, camera terms, radius, residual."""

    moments: FloatArray
    """(m, v, v) weighted by incidence and by the robust loss."""
    counts: FloatArray
    """(m, 4): sums of the weights, of r², number of points, and sum of the weights that the curvature of the loss has."""
    patches: FloatArray
    """(m, 12, 7) number of points, sums of r, r², normal and cos² of incidence by patch; (0, 12, 7) where not asked for."""
    range_mm: FloatArray
    """(m,) from the camera to the sphere's centre."""

    @property
    def point_rms_mm(self) -> FloatArray:
        """(m,) rms residual."""
        return np.asarray(np.sqrt(self.counts[:, 1] / self.counts[:, 2]))

    def weight(self, noise: NoiseModel) -> FloatArray:
        """(m,) weight in mm^-2 of one point of each shot."""
        return noise.point_weight(self.counts[:, 2], self.range_mm)

    @property
    def curved_moments(self) -> FloatArray:
        """(m, v, v) as the second derivative of the robust loss sees them: a Newton step needs it, a covariance does not."""
        factor = np.clip(self.counts[:, 3] / np.maximum(self.counts[:, 0], 1e-300), _LEAST_CURVATURE, 1.0)
        curved = self.moments * factor[:, None, None]
        curved[:, -1], curved[:, :, -1] = self.moments[:, -1], self.moments[:, :, -1]
        return np.asarray(curved)


def shot_sums(problem: Problem, state: State, geometry: Geometry, noise: NoiseModel | None, *, patches: bool = False) -> ShotSums:
    """Sums at a state, weighted by a noise model; without one every point counts the same."""
    range_mm = np.linalg.norm(geometry.centre_in_camera_mm, axis=1)
    if noise is None:
        return _sums(problem, state, geometry, np.full(problem.n_shots, np.inf), (1.0, 0.0), range_mm, patches=patches)
    cutoff_mm = POINT_CUTOFF_SIGMAS * np.hypot(noise.point_sigma_mm(range_mm), noise.form_mm)
    return _sums(problem, state, geometry, cutoff_mm, (noise.flat, noise.steep), range_mm, patches=patches)


def shot_moments(problem: Problem, state: State, geometry: Geometry, cutoff_mm: float) -> tuple[FloatArray, FloatArray]:
    """Moments (m, v, v) and counts (m, 4) of every shot, see `ShotSums`, by the robust loss alone."""
    range_mm = np.zeros(problem.n_shots)
    sums = _sums(problem, state, geometry, np.full(problem.n_shots, cutoff_mm), (1.0, 0.0), range_mm, patches=False)
    return sums.moments, sums.counts


def patch_sums(problem: Problem, state: State, geometry: Geometry, cutoff_mm: float) -> FloatArray:
    """(m, 12, 7) sums of each shot by patch, see `ShotSums`."""
    range_mm = np.zeros(problem.n_shots)
    return _sums(problem, state, geometry, np.full(problem.n_shots, cutoff_mm), (1.0, 0.0), range_mm, patches=True).patches


def _sums(
    problem: Problem,
    state: State,
    geometry: Geometry,
    cutoff_mm: FloatArray,
    incidence: tuple[float, float],
    range_mm: FloatArray,
    *,
    patches: bool,
) -> ShotSums:
    from calibrate import moments_kernels

    m, size = problem.n_shots, problem.layout.n_camera + 5
    sums = ShotSums(np.zeros((m, size, size)), np.zeros((m, 4)), np.zeros((m if patches else 0, PATCHES, 7)), range_mm)
    moments_kernels.shot_sums(
        problem.points_in_camera_mm,
        problem.starts,
        problem.camera_error.polynomials,
        state.camera_mm,
        geometry.centre_in_camera_mm,
        expected_radius_mm(problem, state),
        problem.along_sight,
        cutoff_mm,
        np.array(incidence),
        sums.moments,
        sums.counts,
        sums.patches,
    )
    return sums
