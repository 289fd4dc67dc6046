"""Scenes and candidate shots for tests of the design of poses, and a Monte-Carlo on the solver's own model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from acquire.sphere import fit_fixed_radius
from acquire.visibility import camera_view
from calibrate.camera_error import correction_in_camera_mm
from calibrate.clouds import solve_clouds
from calibrate.design_aim import Aim, aim_at
from calibrate.design_cell import feasible_views, scene_of_cell
from calibrate.design_shots import Expectation, IntArray, Scene, actual_covariance, ideal_caps, layout_of
from calibrate.problem import Problem, State, linearise_geometry
from drivers.kinematics import mdh, se3
from drivers.kinematics.se3 import FloatArray
from tests.support.volume import UNSEEN, volume_cell


@dataclass(frozen=True)
class Case:
    """A scene, candidates for it, and an aim with the views that it is made of."""

    scene: Scene
    joints_rad: FloatArray
    sphere: IntArray
    aim: Aim
    places_in_base_mm: FloatArray
    views_rad: list[FloatArray]


def volume_case(
    artefact: str = "bar3", *, per_sphere: int = 40, camera_error: str = "field", expectation: Expectation | None = None, seed: int = 0
) -> Case:
    """The cell of `tests.support.volume` with an artefact, aimed at its unseen places."""
    volume, rng = volume_cell(seed, artefact), np.random.default_rng([seed, 8])
    scene = scene_of_cell(volume.cell, volume.model, volume.spheres, expectation=expectation, camera_error=camera_error)
    view = camera_view(volume.cell.camera)
    views = [feasible_views(scene, view, centre, per_sphere, rng) for centre in scene.centres_in_base_mm]
    places = np.array(list(UNSEEN.values()))
    looks = [feasible_views(scene, view, place, 6, rng) for place in places]
    sphere = np.repeat(np.arange(len(views)), [len(v) for v in views])
    return Case(scene, np.concatenate(views), sphere, aim_at(scene, places, looks), places, looks)


def random_rows(case: Case, n: int, rng: np.random.Generator) -> IntArray:
    """Rows of n candidates, shared evenly among the spheres."""
    n_spheres = len(case.scene.radius_mm)
    return np.concatenate([rng.permutation(np.flatnonzero(case.sphere == i))[: n // n_spheres] for i in range(n_spheres)])


def drawn_state(scene: Scene, n_scans: int, rng: np.random.Generator) -> State:
    """A truth as large as the design expects it, hand-eye and spheres a little off their guesses."""
    layout = layout_of(scene)
    draw = np.zeros(layout.size)
    known = slice(0, layout.radius_offset.stop)
    draw[known] = np.linalg.cholesky(actual_covariance(scene)[known, known]) @ rng.standard_normal(known.stop)
    draw[layout.hand_eye] = rng.normal(0, 1, 6) * [1, 1, 1, 3e-3, 3e-3, 3e-3]
    draw[layout.centres] = rng.normal(0, 1, 3 * len(scene.radius_mm))
    noise = scene.expectation.noise
    pose = rng.normal(0, 1, (n_scans, 6)) * [*[noise.pose_mm] * 3, *[noise.pose_rad] * 3]
    return scene.nominal_state(n_scans).moved(layout, draw, pose)


def measured_points(problem: Problem, truth: State, unit: FloatArray, noise_mm: float, rng: np.random.Generator) -> FloatArray:
    """(m, t, 3) what a camera of the problem's own error model measures on caps with normals `unit` (m, t, 3)."""
    geometry = linearise_geometry(problem, truth)
    radius = problem.radius_mm[problem.sphere] + truth.radius_offset_mm
    points = geometry.centre_in_camera_mm[:, None] + radius[:, None, None] * unit
    sight = points / np.linalg.norm(points, axis=-1, keepdims=True)
    cosine = -(sight * unit).sum(axis=-1, keepdims=True)
    points = points + sight * rng.normal(0, noise_mm, cosine.shape) / cosine
    measured = points
    for _ in range(20):
        correction = correction_in_camera_mm(problem.camera_error, truth.camera_mm, measured.reshape(-1, 3)).reshape(points.shape)
        measured = points - correction
    return np.asarray(measured)


def solved_length_errors_mm(case: Case, rows: IntArray, rng: np.random.Generator) -> FloatArray:
    """Errors of the aim's lengths after a solve of chosen shots of a drawn truth; the noise model is known to the solver."""
    scene, joints, sphere = case.scene, case.joints_rad[rows], case.sphere[rows]
    expectation = scene.expectation
    blank = scene.problem(joints, sphere)
    truth = drawn_state(scene, blank.n_scans, rng)
    ways = [truth.centres_in_base_mm[c.first] - truth.centres_in_base_mm[c.second] for c in scene.lengths]
    lengths = [
        replace(c, length_mm=float(np.linalg.norm(way)) + float(rng.normal(0, c.sigma_mm))) for c, way in zip(scene.lengths, ways, strict=True)
    ]
    caps = ideal_caps(scene, joints, sphere)
    unit = np.repeat(caps.unit, expectation.n_points // caps.unit.shape[1], axis=1)
    points = measured_points(blank, truth, unit, expectation.noise.point_mm, rng)
    flat = points.reshape(-1, 3)
    problem = replace(
        blank,
        points_in_camera_mm=flat,
        starts=np.arange(len(joints) + 1) * points.shape[1],
        lengths=tuple(lengths),
    )
    start = replace(scene.nominal_state(blank.n_scans), centres_in_base_mm=truth.centres_in_base_mm)
    solution = solve_clouds(problem, start, expectation.noise, estimate_noise=False)
    found = np.array([_measured_place(case, i, truth, solution.state, rng) for i in range(len(case.places_in_base_mm))])
    return np.array([
        np.linalg.norm(found[j] - found[i]) - np.linalg.norm(case.places_in_base_mm[j] - case.places_in_base_mm[i])
        for i in range(len(found))
        for j in range(i)
    ])  # fmt: skip


def _measured_place(case: Case, i: int, truth: State, solved: State, rng: np.random.Generator) -> FloatArray:
    """(3,) centre of a sphere at one of the aim's places, as the solved state measures it on all views together."""
    place, radius = case.places_in_base_mm[i][None], case.scene.radius_mm[:1]
    one = replace(case.scene, centres_in_base_mm=place, radius_mm=radius, radius_sigma_mm=np.ones(1), lengths=())
    joints = case.views_rad[i]
    problem = one.problem(joints, np.zeros(len(joints), dtype=np.int64))
    here = replace(truth, centres_in_base_mm=one.centres_in_base_mm, pose_noise=np.zeros((len(joints), 6)))
    unit = ideal_caps(one, joints, problem.sphere).unit
    points = measured_points(problem, here, unit, 0.0, rng)
    flat = points.reshape(-1, 3)
    corrected = (flat + correction_in_camera_mm(problem.camera_error, solved.camera_mm, flat)).reshape(points.shape)
    base_from_camera = mdh.base_from_flange(case.scene.model, joints, solved.link_twists) @ solved.flange_from_camera
    in_base = se3.apply(base_from_camera[:, None], corrected).reshape(-1, 3)
    return fit_fixed_radius(in_base, float(one.radius_mm[0]) + solved.radius_offset_mm, case.places_in_base_mm[i])[0]
