"""Problems, starts and a slow reference of the whole-cloud residuals for tests of the solver, from synthetic shots."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from calibrate.camera_error import CameraError, NoCameraError, correction_in_camera_mm, correction_of_basis
from calibrate.problem import Geometry, LengthConstraint, Priors, Problem, State, expected_radius_mm
from calibrate.start import initial_state
from drivers.kinematics import mdh, se3
from drivers.kinematics.se3 import FloatArray
from tests.support.synthetic import SyntheticCell, SyntheticShot, draw_shot

GRAZING_COSINE = 0.3


@contextmanager
def one_thread() -> Iterator[None]:
    """BLAS on one thread, as `calibrate` itself does it: on matrices this small more only wait for each other."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


def draw_shots(
    cell: SyntheticCell,
    rng: np.random.Generator,
    n_shots: int,
    *,
    n_points: int = 60,
    depth_noise_mm: float = 0.08,
    pose_noise: tuple[float, float] = (0.01, 1e-4),
) -> list[SyntheticShot]:
    """Shots of one sphere by METHOD's pose law."""
    return [draw_shot(cell, rng, n_points=n_points, depth_noise_mm=depth_noise_mm, pose_noise=pose_noise) for _ in range(n_shots)]


def noise_free(cell: SyntheticCell, rng: np.random.Generator, n_shots: int, *, n_points: int = 60) -> list[SyntheticShot]:
    """Shots that know their pose and their points exactly."""
    return draw_shots(cell, rng, n_shots, n_points=n_points, depth_noise_mm=0.0, pose_noise=(0.0, 0.0))


def problem_of(
    cell: SyntheticCell,
    shots: Mapping[str, Sequence[SyntheticShot]] | Sequence[SyntheticShot],
    camera_error: CameraError | None = None,
    *,
    pose_only: bool = False,
    lengths: Sequence[LengthConstraint] = (),
    priors: Priors | None = None,
) -> Problem:
    """A problem with a scan a shot; spheres in the order of the mapping."""
    named = shots if isinstance(shots, Mapping) else {"A": shots}
    flat = [shot for members in named.values() for shot in members]
    camera = camera_error or NoCameraError()
    joints = np.array([shot.joints_rad for shot in flat])
    points = np.concatenate([shot.points_in_camera_mm for shot in flat])
    true_flange = np.array([shot.true_base_from_camera for shot in flat]) @ se3.inverse(cell.flange_from_camera)
    return Problem(
        model=None if pose_only else cell.nominal,
        joints_rad=None if pose_only else joints,
        base_from_flange=true_flange if pose_only else mdh.base_from_flange(cell.nominal, joints),
        scan=np.arange(len(flat)),
        sphere=np.repeat(np.arange(len(named)), [len(members) for members in named.values()]),
        points_in_camera_mm=points,
        starts=np.concatenate([[0], np.cumsum([len(shot.points_in_camera_mm) for shot in flat])]).astype(np.int64),
        camera_error=camera,
        radius_mm=np.full(len(named), cell.radius_mm),
        radius_sigma_mm=np.full(len(named), 0.00025),
        lengths=tuple(lengths),
        priors=priors or Priors(),
    )


def off_by(transform: FloatArray, rng: np.random.Generator, mm: float = 2.0, rad: float = 7e-3) -> FloatArray:
    """A transform (4, 4) that is wrong by a given length and angle in random directions."""
    directions = rng.normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(transform @ se3.exp(np.concatenate([mm * directions[0], rad * directions[1]])))


def start_of(problem: Problem, cell: SyntheticCell, rng: np.random.Generator | None = None) -> State:
    """A start at the truth of hand-eye and centre, or 2 mm and 7 mrad off where a generator is given."""
    hand_eye = cell.flange_from_camera if rng is None else off_by(cell.flange_from_camera, rng)
    return initial_state(problem, hand_eye, np.tile(cell.centre_in_base_mm, (len(problem.radius_mm), 1)))


def bent_state(problem: Problem, cell: SyntheticCell, rng: np.random.Generator) -> State:
    """A state with every unknown away from zero by about its prior; no pose noise."""
    state = start_of(problem, cell, rng)
    layout = problem.layout
    twists = rng.normal(size=(layout.n_links, 6)) * [0.5, 0.5, 0.5, 2e-3, 2e-3, 2e-3]
    return replace(
        state,
        link_twists=twists,
        camera_mm=rng.normal(0, 0.1, layout.n_camera),
        radius_offset_mm=0.02,
        sphere_radius_deviation_mm=rng.normal(0, 0.01, layout.n_spheres),
        centres_in_base_mm=state.centres_in_base_mm + rng.normal(0, 1.0, state.centres_in_base_mm.shape),
    )


def point_rows(problem: Problem, state: State, geometry: Geometry) -> FloatArray:
    """(N, k + 5) rows (u, basis * u[axis], -1, residual) of every point in plain numpy: the reference of the kernels.

    The residual runs along the line of sight to where it meets the sphere, projected on the normal there; where it
    misses or grazes, it is radial.
    """
    basis, (u, residual, _) = _at_denoised(problem, state, geometry)
    return np.concatenate([u, basis * u[:, problem.camera_error.axis], -np.ones((len(u), 1)), residual[:, None]], axis=1)


def cosines(problem: Problem, state: State, geometry: Geometry) -> FloatArray:
    """(N,) cosine of the incidence of every point's sight on its sphere; zero where its residual is radial."""
    return _at_denoised(problem, state, geometry)[1][2]


def _at_denoised(problem: Problem, state: State, geometry: Geometry) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray]]:
    """Camera terms (N, k) where the points would be without their noise, and the residuals that they leave."""
    shot = np.repeat(np.arange(problem.n_shots), np.diff(problem.starts))
    measured, radius, centre = problem.points_in_camera_mm, expected_radius_mm(problem, state)[shot], geometry.centre_in_camera_mm[shot]
    model = problem.camera_error
    first = measured + correction_in_camera_mm(model, state.camera_mm, measured)
    basis = model.basis(denoised(measured, *residuals(problem, measured, first - centre, radius)))
    return basis, residuals(problem, measured, measured + correction_of_basis(model, state.camera_mm, basis) - centre, radius)


def residuals(problem: Problem, measured: FloatArray, away: FloatArray, radius: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Normals (N, 3), residuals (N,) and cosines of incidence (N,; zero where radial) of points `away` from their sphere's centre."""
    distance = np.linalg.norm(away, axis=1)
    u, residual, cosine = away / distance[:, None], distance - radius, np.zeros(len(away))
    if problem.along_sight:
        to_camera = -measured / np.linalg.norm(measured, axis=1, keepdims=True)
        along = (away * to_camera).sum(axis=1)
        depth2 = along**2 - distance**2 + radius**2
        hit = depth2 > (GRAZING_COSINE * radius) ** 2
        depth = np.sqrt(np.maximum(depth2, 0.0))
        past = along - depth
        u[hit] = (away - past[:, None] * to_camera)[hit] / radius[hit, None]
        residual[hit] = (past * depth / radius)[hit]
        cosine[hit] = (depth / radius)[hit]
    return u, residual, cosine


def denoised(measured: FloatArray, u: FloatArray, residual: FloatArray, cosine: FloatArray) -> FloatArray:
    """Measured points (N, 3) moved onto their sphere: along the sight where it meets it steeply, else radially."""
    sight = measured / np.linalg.norm(measured, axis=1, keepdims=True)
    hit = cosine > 0
    return np.where(hit[:, None], measured + sight * (residual / np.where(hit, cosine, 1.0))[:, None], measured - residual[:, None] * u)
