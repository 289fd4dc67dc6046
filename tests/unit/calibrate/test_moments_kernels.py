"""The compiled pass over all points against plain numpy: moments, counts, patches, denoised points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from calibrate.camera_error import CameraError, NoCameraError, PillowError, PolynomialError
from calibrate.normal import NoiseModel
from calibrate.polynomials import Polynomials, monomials
from calibrate.problem import Geometry, Problem, State, linearise_geometry
from calibrate.sums import POINT_CUTOFF_SIGMAS, patch_sums, shot_moments, shot_sums
from drivers.kinematics.se3 import FloatArray
from tests.support.solving import cosines, draw_shots, noise_free, point_rows, problem_of, start_of
from tests.support.synthetic import paper_cell


@dataclass(frozen=True)
class ThreeAxes:
    """A camera error that moves points along all three axes; its basis is the point itself, in metres."""

    name: str = "three"

    @property
    def axis(self) -> NDArray[np.int64]:
        return np.array([0, 1, 2])

    @property
    def prior_sigma_mm(self) -> FloatArray:
        return np.full(3, 0.5)

    def basis(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        return np.asarray(points_in_camera_mm, dtype=np.float64) / 1000.0

    @property
    def polynomials(self) -> Polynomials:
        return monomials([(axis, [(1.0, degrees)]) for axis, degrees in enumerate([(1, 0, 0), (0, 1, 0), (0, 0, 1)])], [0.0] * 3, [1000.0] * 3)

    def settings(self) -> dict[str, object]:
        return {"model": "three"}


FIELD = PolynomialError((0.0, 10.0, 320.0), (60.0, 40.0, 50.0), 3, 2)
"""Its box leaves part of the points outside."""
MODELS: list[CameraError] = [NoCameraError(), PillowError(), ThreeAxes(), FIELD]


def noisy(camera_error: CameraError, along_sight: bool, seed: int = 0) -> tuple[Problem, State, Geometry]:
    """A few shots of different sizes at a state some tenths of a mm off."""
    cell, rng = paper_cell(), np.random.default_rng(seed)
    shots = [shot for n in (7, 60, 1, 33) for shot in draw_shots(cell, rng, 1, n_points=n)]
    problem = replace(problem_of(cell, shots, camera_error), along_sight=along_sight)
    camera_mm, pose_noise = rng.normal(0, 0.1, problem.layout.n_camera), rng.normal(0, 1e-3, (problem.n_scans, 6))
    state = replace(start_of(problem, cell), camera_mm=camera_mm, radius_offset_mm=0.03, pose_noise=pose_noise)
    return problem, state, linearise_geometry(problem, state)


cases = pytest.mark.parametrize(("camera_error", "along_sight"), [(m, s) for m in MODELS for s in (True, False)], ids=lambda v: getattr(v, "name", v))


@cases
@pytest.mark.parametrize("cutoff_mm", [np.inf, 0.3, 2.0])
def test_moments_are_the_weighted_sums_over_the_points(camera_error: CameraError, along_sight: bool, cutoff_mm: float) -> None:
    problem, state, geometry = noisy(camera_error, along_sight)
    moments, counts = shot_moments(problem, state, geometry, cutoff_mm)
    rows = point_rows(problem, state, geometry)
    for j in range(problem.n_shots):
        v = rows[problem.starts[j] : problem.starts[j + 1]]
        weight = (1 + (v[:, -1] / cutoff_mm) ** 2) ** -2.0
        np.testing.assert_allclose(moments[j], (v * weight[:, None]).T @ v, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(counts[j, :3], [weight.sum(), (v[:, -1] ** 2).sum(), len(v)], rtol=1e-9)


@cases
def test_the_order_of_points_in_a_shot_changes_nothing(camera_error: CameraError, along_sight: bool) -> None:
    problem, state, geometry = noisy(camera_error, along_sight)
    rng = np.random.default_rng(9)
    order = np.concatenate([a + rng.permutation(b - a) for a, b in zip(problem.starts[:-1], problem.starts[1:], strict=True)])
    shuffled = replace(problem, points_in_camera_mm=problem.points_in_camera_mm[order])
    for ours, theirs in zip(shot_moments(problem, state, geometry, 0.5), shot_moments(shuffled, state, geometry, 0.5), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-10)


@cases
def test_patches_share_out_every_point_within_the_cutoff(camera_error: CameraError, along_sight: bool) -> None:
    problem, state, geometry = noisy(camera_error, along_sight)
    residual = point_rows(problem, state, geometry)[:, -1]
    shot = np.repeat(np.arange(problem.n_shots), np.diff(problem.starts))
    for cutoff_mm in (np.inf, 1.001 * float(np.median(np.abs(residual)))):
        sums = patch_sums(problem, state, geometry, cutoff_mm)
        assert sums.shape == (problem.n_shots, 12, 7)
        kept = np.abs(residual) <= cutoff_mm
        for power in range(3):
            expected = np.bincount(shot[kept], weights=residual[kept] ** power, minlength=problem.n_shots)
            np.testing.assert_allclose(sums[:, :, power].sum(axis=1), expected, rtol=1e-9, atol=1e-9)


def test_a_whole_cap_fills_all_patches_about_evenly() -> None:
    cell = paper_cell()
    problem = problem_of(cell, noise_free(cell, np.random.default_rng(1), 4, n_points=3000))
    state = start_of(problem, cell)
    counts = patch_sums(problem, state, linearise_geometry(problem, state), np.inf)[:, :, 0]
    assert counts.min() > 60
    assert counts.max() < 900


def test_the_sight_residual_is_the_radial_one_to_first_order() -> None:
    """For an error e along the sight both are e times the cosine of incidence; what is left is of order e² / R."""
    cell = paper_cell()
    problem = problem_of(cell, noise_free(replace(cell, true=cell.nominal, camera_error_mm=lambda p: np.zeros(len(p))), np.random.default_rng(2), 3))
    state = start_of(problem, cell)
    geometry = linearise_geometry(problem, state)
    differences = []
    for error_mm in (0.2, 0.02):
        sight = problem.points_in_camera_mm / np.linalg.norm(problem.points_in_camera_mm, axis=1, keepdims=True)
        off = replace(problem, points_in_camera_mm=problem.points_in_camera_mm + error_mm * sight)
        along = point_rows(off, state, geometry)
        radial = point_rows(replace(off, along_sight=False), state, geometry)
        for each, flag in ((along, True), (radial, False)):
            moments, _ = shot_moments(replace(off, along_sight=flag), state, geometry, np.inf)
            np.testing.assert_allclose(moments[:, -1, -1].sum(), (each[:, -1] ** 2).sum(), rtol=1e-9)
        assert np.abs(along[:, -1]).max() > 0.9 * error_mm
        differences.append(np.abs(along[:, -1] - radial[:, -1]).max())
    assert differences[0] < 0.2**2 / 19.05 * 2
    assert differences[1] < 1.5e-2 * differences[0]


def test_rays_that_miss_the_sphere_have_the_radial_residual() -> None:
    cell = paper_cell()
    problem = problem_of(cell, noise_free(cell, np.random.default_rng(3), 1, n_points=50))
    state = start_of(problem, cell)
    geometry = linearise_geometry(problem, state)
    across = np.cross(geometry.centre_in_camera_mm[0], [1.0, 0.0, 0.0])
    points = geometry.centre_in_camera_mm[0] + across / np.linalg.norm(across) * np.linspace(18.9, 25.0, 50)[:, None]
    beside = replace(problem, points_in_camera_mm=points)
    moments, counts = shot_moments(beside, state, geometry, np.inf)
    expected = np.linspace(18.9, 25.0, 50) - cell.radius_mm
    np.testing.assert_allclose(counts[0, 1], (expected**2).sum(), rtol=1e-9)
    np.testing.assert_allclose(moments[0, -2, -1], -expected.sum(), rtol=1e-9)


@cases
def test_the_curvature_is_the_derivative_of_the_gradient(camera_error: CameraError, along_sight: bool) -> None:
    """Sum of the weights of the second derivative: how the sum of weight times residual follows the radius at unit moments."""
    problem, state, geometry = noisy(camera_error, along_sight)
    noise, step_mm = NoiseModel(point_mm=0.05, pose_mm=0.01, pose_rad=1e-4), 1e-5
    sides = [shot_sums(problem, replace(state, radius_offset_mm=state.radius_offset_mm + d), geometry, noise) for d in (-step_mm, step_mm)]
    slope = (sides[0].moments[:, -2, -1] - sides[1].moments[:, -2, -1]) / (2 * step_mm)
    if not camera_error.axis.size and not along_sight:
        expected = shot_sums(problem, state, geometry, noise).counts[:, 3]
        np.testing.assert_allclose(-slope, expected, rtol=1e-5, atol=1e-5)


def weighted_by(noise: NoiseModel, rows: FloatArray, cosine: FloatArray, range_mm: float) -> FloatArray:
    variance = noise.flat + noise.steep * cosine**2
    cutoff = POINT_CUTOFF_SIGMAS * np.hypot(noise.point_mm * (range_mm / noise.range_mm) ** noise.range_power, noise.form_mm)
    return np.asarray((1 + rows[:, -1] ** 2 / variance / cutoff**2) ** -2.0 / variance)


@cases
def test_points_weigh_by_their_incidence_and_range(camera_error: CameraError, along_sight: bool) -> None:
    problem, state, geometry = noisy(camera_error, along_sight)
    noise = NoiseModel(0.1, 0.01, 1e-4, form_mm=0.02, flat=0.4, steep=1.1, range_power=2.0, range_mm=300.0)
    sums = shot_sums(problem, state, geometry, noise)
    rows = point_rows(problem, state, geometry)
    cosine = cosines(problem, state, geometry)
    for j in range(problem.n_shots):
        own = slice(problem.starts[j], problem.starts[j + 1])
        weight = weighted_by(noise, rows[own], cosine[own], float(np.linalg.norm(geometry.centre_in_camera_mm[j])))
        np.testing.assert_allclose(sums.moments[j], (rows[own] * weight[:, None]).T @ rows[own], rtol=1e-9, atol=1e-9)


def test_patches_hold_the_sums_of_normals_and_incidence() -> None:
    problem, state, geometry = noisy(PillowError(), True)
    patches = shot_sums(problem, state, geometry, None, patches=True).patches
    normals, cosine = point_rows(problem, state, geometry)[:, :3], cosines(problem, state, geometry)
    for j in range(problem.n_shots):
        own = slice(problem.starts[j], problem.starts[j + 1])
        np.testing.assert_allclose(patches[j, :, 3:6].sum(axis=0), normals[own].sum(axis=0), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(patches[j, :, 6].sum(), (cosine[own] ** 2).sum(), rtol=1e-9)


def test_threads_change_nothing() -> None:
    import numba

    problem, state, geometry = noisy(FIELD, True)
    before = numba.get_num_threads()
    many = shot_moments(problem, state, geometry, 0.5)
    try:
        numba.set_num_threads(1)
        one = shot_moments(problem, state, geometry, 0.5)
    finally:
        numba.set_num_threads(before)
    for a, b in zip(many, one, strict=True):
        np.testing.assert_array_equal(a, b)
