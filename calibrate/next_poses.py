"""What a plan lacks, in words, and the poses that would tell most next (`calibrate.design` over a pool of feasible ones)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acquire.cell import Cell
from acquire.collision import cell_collisions
from acquire.plan import PlannedPose
from acquire.poses import sphere_candidates
from acquire.visibility import camera_view
from calibrate.clouds import Solution
from calibrate.design import choose_shots, information_of
from calibrate.design_cell import PlacedLength, PlacedSphere, aim_of_cell, scene_of
from calibrate.design_shots import Expectation, IntArray
from calibrate.distinct_views import count_distinct_views
from calibrate.problem import Problem
from drivers.errors import DataError, SettingsError
from drivers.kinematics import se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

N_NEXT = 5
_POOL, _LEAST_POOL = 240, 40
_PLACES, _VIEWS = 8, 5
_ONE_PLACE_SHARE = 0.06
"""Spread of the seen places (standard deviation over depth) below which they count as one."""
_ONE_ORIENTATION_RAD = float(np.radians(4))
_STILL_RAD = float(np.radians(3))
_ENOUGH_SHOTS = 40


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """The shots that a calibration was made from."""

    joints_rad: FloatArray
    """(m, n)."""
    sphere: IntArray
    """(m,) index among the names."""
    names: tuple[str, ...]
    centres_in_base_mm: FloatArray
    """(S, 3) where the solve found the spheres."""
    flange_from_camera: FloatArray
    """(4, 4) of the solve."""
    expectation: Expectation
    """What its shots were like."""


def shortcomings(problem: Problem, solution: Solution, expected_rank: int) -> tuple[str, ...]:
    """What the shots of a problem are too few or too alike in, with what to do; empty where nothing stands out."""
    found = []
    n_sought = expected_rank + 3 * len(problem.radius_mm) - len(problem.lengths)
    n_views = count_distinct_views(problem)
    if 3 * n_views < n_sought:
        few, poses = f"{problem.n_shots}", f"{n_views} distinct pose{'s' * (n_views != 1)}"
        what = f"too few shots: {few}" if n_views == problem.n_shots else f"too few poses: the {few} shots are of {poses} only,"
        found.append(f"{what} for {n_sought} unknowns, each tells three numbers; take {max(_ENOUGH_SHOTS, n_sought)} or more")
    return tuple(found) + (alike(problem, solution) + tuple(_still_axes(problem)) if problem.n_shots else ())


def alike(problem: Problem, solution: Solution) -> tuple[str, ...]:
    """In what all shots of a problem are alike, with what to do: places in the camera's view, orientations."""
    found: list[str] = []
    seen = solution.geometry.centre_in_camera_mm
    if seen.std(axis=0).max() < _ONE_PLACE_SHARE * seen[:, 2].mean():
        depths = f"depth {seen[:, 2].min():.0f} to {seen[:, 2].max():.0f} mm"
        found.append(f"the spheres were seen at one place of the camera's view ({depths}): spread the sphere in depth and across the view")
    turned = _orientation_spread_rad(solution.geometry.base_from_camera[:, :3, :3])
    if turned[1] < _ONE_ORIENTATION_RAD:
        how = "the camera was hardly turned between shots (parallel orientations)" if turned[2] < _ONE_ORIENTATION_RAD else _ONE_AXIS
        found.append(f"{how}: tilt it by 20 to 40 degrees to all sides, and roll it about its view")
    return tuple(found)


_ONE_AXIS = "the camera was turned about one axis only"


def next_best_poses(cell: Cell, model: RobotModel, taken: Taken, *, n: int = N_NEXT) -> tuple[PlannedPose, ...]:
    """The n feasible poses that, one after the other, lower the error of lengths over the work volume most.

    The same shots always give the same poses. They are checked as those of a plan are, with the first guesses replaced
    by what the solve found. Empty where the cell does not tell what the camera sees, where the arm has no closed-form
    inverse, or where too little is within reach.

    Args:
        cell: whose camera, work volume and obstacles count.
        model: the nominal robot.
        taken: the shots so far, and what their solve found.
        n: how many.
    """
    from threadpoolctl import threadpool_limits

    try:
        with threadpool_limits(limits=1, user_api="blas"):
            return _next_best(cell.model_copy(update={"flange_from_camera": taken.flange_from_camera.tolist()}), model, taken, n)
    except (SettingsError, DataError):
        return ()


def pose_text(pose: PlannedPose) -> str:
    """E.g. `A at 12.0, -45.3, ... degrees`."""
    return f"{pose.sphere} at {', '.join(f'{angle:.1f}' for angle in np.degrees(pose.joints_rad))} degrees"


def _next_best(cell: Cell, model: RobotModel, taken: Taken, n: int) -> tuple[PlannedPose, ...]:
    rng = np.random.default_rng(11)
    spheres = [
        PlacedSphere(_triple(centre), cell.spheres[name].diameter_mm, cell.spheres[name].expanded_uncertainty_mm)
        for name, centre in zip(taken.names, taken.centres_in_base_mm, strict=True)
    ]
    scene = scene_of(cell, model, spheres, _lengths(cell, taken.names), expectation=taken.expectation)
    joints, sphere = _pool(cell, model, taken, rng)
    if len(joints) < n:
        return ()
    aim = aim_of_cell(cell, scene, rng, n_places=_PLACES, views_per_place=_VIEWS)
    so_far = information_of(scene, taken.joints_rad, taken.sphere)
    rows = choose_shots(scene, aim, joints, sphere, n, already=so_far, sweeps=0).rows
    return tuple(PlannedPose(f"next{i}", taken.names[sphere[row]], joints[row].round(6)) for i, row in enumerate(rows, start=1))


def _pool(cell: Cell, model: RobotModel, taken: Taken, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """Feasible axis angles (k, n) and the index of the sphere that each looks at (k,)."""
    view, blocked = camera_view(cell.camera), cell_collisions(cell, model)
    per_sphere = max(_LEAST_POOL, _POOL // len(taken.names))
    radii = [cell.spheres[name].radius_mm for name in taken.names]
    joints, sphere = [], []
    for i, (centre, radius) in enumerate(zip(taken.centres_in_base_mm, radii, strict=True)):
        others = [(taken.centres_in_base_mm[k], radii[k]) for k in range(len(radii)) if k != i]
        pool = sphere_candidates(model, taken.flange_from_camera, centre, radius, view, per_sphere, rng, other_spheres=others, blocked=blocked)
        joints.append(pool.joints_rad)
        sphere.append(np.full(len(pool.joints_rad), i, dtype=np.int64))
    return np.concatenate(joints), np.concatenate(sphere)


def _lengths(cell: Cell, names: Sequence[str]) -> list[PlacedLength]:
    row = {name: i for i, name in enumerate(names)}
    return [
        PlacedLength(row[length.between[0]], row[length.between[1]], length.expanded_uncertainty_mm)
        for length in cell.lengths
        if set(length.between) <= set(row)
    ]


def _orientation_spread_rad(rotations: FloatArray) -> FloatArray:
    """(3,) rms turns of orientations (m, 3, 3) about the principal axes of their spread, rising."""
    mean = se3.nearest_rotation(rotations.mean(axis=0))
    turns = se3.log_so3(rotations @ mean.T)
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(turns.T @ turns / len(turns)), 0.0)))


def _still_axes(problem: Problem) -> list[str]:
    if problem.joints_rad is None or problem.n_shots < 2:
        return []
    ranges = np.ptp(problem.joints_rad, axis=0)
    still = np.flatnonzero(ranges < _STILL_RAD)
    return [f"axis {i + 1} moved by {np.degrees(ranges[i]):.1f} degrees only: take shots over a wider range of it" for i in still]


def _triple(values: FloatArray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
