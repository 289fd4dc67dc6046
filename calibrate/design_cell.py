"""Designing for a cell: its scene, its work volume, and the views from which spheres there would be measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acquire.cell import Cell
from acquire.poses import PoseLaw, sphere_candidates
from acquire.visibility import CameraView, camera_view
from calibrate.camera_error import camera_error_models
from calibrate.design_aim import Aim, aim_at
from calibrate.design_shots import Expectation, IntArray, Scene
from calibrate.problem import LengthConstraint
from calibrate.result import Calibration
from drivers.errors import SettingsError
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

N_PLACES = 14
VIEWS_PER_PLACE = 10
_DRAWN_PER_VIEW = 12
_LEAST_SIDE_MM = 300.0
_SMALLEST_RADIUS_SIGMA_MM = 1e-5
_DEFAULT_SIGHT_CROSSING_MM = (60.0, 0.0, 500.0)


@dataclass(frozen=True, slots=True)
class PlacedSphere:
    """A sphere that stands, or might stand, in the work volume."""

    centre_in_base_mm: tuple[float, float, float]
    diameter_mm: float
    diameter_u_mm: float = 0.001
    """Expanded uncertainty (k = 2) of the diameter."""


@dataclass(frozen=True, slots=True)
class PlacedLength:
    """A certified length between two placed spheres (indices)."""

    first: int
    second: int
    expanded_uncertainty_mm: float = 0.005


def scene_of(
    cell: Cell,
    model: RobotModel,
    spheres: Sequence[PlacedSphere],
    lengths: Sequence[PlacedLength],
    *,
    expectation: Expectation | None = None,
    camera_error: str = "field",
) -> Scene:
    """The scene of a cell's robot and camera with some spheres.

    Args:
        cell: robot, camera, first guess of the hand-eye transform.
        model: the nominal robot.
        spheres: real or virtual.
        lengths: certified, between them.
        expectation: noise, priors and unmodelled physics; stated defaults if None.
        camera_error: none, affine, pillow or field; `field` insures against a camera that no pillow describes. Line profiles have none.

    Raises:
        SettingsError: the cell lacks a hand-eye guess or what the camera sees, or the camera model is unknown.
    """
    if cell.flange_from_camera is None:
        remedy = "Give a first guess, from a drawing: a few mm and degrees are near enough."
        raise SettingsError("shots cannot be designed without a hand-eye guess", file=cell.path, where="flange_from_camera", remedy=remedy)
    box = _view_box_mm(camera_view(cell.camera))
    crossing = cell.camera.sight_crossing_mm or _DEFAULT_SIGHT_CROSSING_MM
    is_area = cell.camera.kind == "area"
    name = camera_error if is_area else "none"
    centres = np.array([sphere.centre_in_base_mm for sphere in spheres], dtype=np.float64).reshape(-1, 3)
    return Scene(
        model=model,
        flange_from_camera=np.asarray(cell.flange_from_camera, dtype=np.float64),
        centres_in_base_mm=centres,
        radius_mm=np.array([sphere.diameter_mm / 2 for sphere in spheres]),
        radius_sigma_mm=np.array([max(sphere.diameter_u_mm / 4, _SMALLEST_RADIUS_SIGMA_MM) for sphere in spheres]),
        lengths=tuple(_constraint(length, centres) for length in lengths),
        camera_error=camera_error_models([name], points_in_camera_mm=box, sight_crossing_mm=crossing)[0],
        camera_box_mm=box,
        expectation=expectation or Expectation(),
        along_sight=is_area,
    )


def placed_in_cell(cell: Cell, names: Sequence[str]) -> tuple[tuple[PlacedSphere, ...], tuple[PlacedLength, ...]]:
    """Some of a cell's own spheres as they stand, and the certified lengths between them.

    Raises:
        SettingsError: an unknown sphere, or one of unknown place.
    """
    spheres = []
    for name in names:
        if name not in cell.spheres:
            known = ", ".join(cell.spheres) or "none"
            raise SettingsError(f"there is no sphere {name!r}", file=cell.path, where="spheres", remedy=f"Spheres of the cell: {known}.")
        sphere = cell.spheres[name]
        if sphere.centre_in_base_mm is None:
            remedy = "Add centre_in_base_mm: [x, y, z], known to a few mm."
            raise SettingsError("the place of a sphere is not known", file=cell.path, where=f"spheres.{name}", remedy=remedy)
        spheres.append(PlacedSphere(sphere.centre_in_base_mm, sphere.diameter_mm, sphere.expanded_uncertainty_mm))
    order = {name: i for i, name in enumerate(names)}
    lengths = tuple(
        PlacedLength(order[length.between[0]], order[length.between[1]], length.expanded_uncertainty_mm)
        for length in cell.lengths
        if set(length.between) <= set(order)
    )
    return tuple(spheres), lengths


def scene_of_cell(
    cell: Cell, model: RobotModel, names: Sequence[str], *, expectation: Expectation | None = None, camera_error: str = "field"
) -> Scene:
    """The scene of some of a cell's own spheres, of known place, and of the certified lengths between them.

    Raises:
        SettingsError: as `scene_of`, or a sphere's place is not known.
    """
    spheres, lengths = placed_in_cell(cell, names)
    return scene_of(cell, model, spheres, lengths, expectation=expectation, camera_error=camera_error)


def expectation_of(calibration: Calibration) -> Expectation:
    """What shots of a cell are like, from an earlier calibration of it: noise, pose noise, form error, points a shot."""
    counts = [float(shot.n_points) for shot in calibration.shots]
    return Expectation(noise=calibration.noise, n_points=int(np.median(counts)) if counts else Expectation().n_points)


def work_box_mm(cell: Cell, centres_in_base_mm: FloatArray) -> FloatArray:
    """(2, 3) where accuracy matters: the cell's work volume, or the box around spheres (S, 3), at least 300 mm wide."""
    if cell.work_volume_box_mm is not None:
        return cell.work_volume_box_mm
    lower, upper = centres_in_base_mm.min(axis=0), centres_in_base_mm.max(axis=0)
    half = np.maximum(upper - lower, _LEAST_SIDE_MM) / 2
    return np.array([(lower + upper) / 2 - half, (lower + upper) / 2 + half])


def aim_of_cell(
    cell: Cell,
    scene: Scene,
    rng: np.random.Generator,
    *,
    box_in_base_mm: FloatArray | None = None,
    n_places: int = N_PLACES,
    views_per_place: int = VIEWS_PER_PLACE,
) -> Aim:
    """Lengths between random places of the work volume, each seen from feasible views of all arm branches.

    Args:
        cell: whose work volume and camera count.
        scene: robot, camera and spheres.
        rng: seeded by the caller.
        box_in_base_mm: (2, 3) where accuracy matters; `work_box_mm` if None.
        n_places: places that spheres would be measured at.
        views_per_place: views of each.

    Raises:
        DataError: fewer than two places are reachable.
        SettingsError: the cell does not tell what the camera sees.
    """
    box = work_box_mm(cell, scene.centres_in_base_mm) if box_in_base_mm is None else box_in_base_mm
    # towards the faces (arcsine law): long lengths count, and errors are largest where the volume ends
    places = box[0] + np.sin(np.pi / 2 * rng.random((n_places, 3))) ** 2 * (box[1] - box[0])
    view = camera_view(cell.camera)
    views = [feasible_views(scene, view, place, views_per_place, rng) for place in places]
    return aim_at(scene, places, views)


def feasible_views(scene: Scene, view: CameraView, place_in_base_mm: FloatArray, n: int, rng: np.random.Generator) -> FloatArray:
    """Up to n axis angles (v, n_axes) that see a sphere at a place (3,): random views, a random arm branch of each."""
    radius = float(scene.radius_mm.mean())
    law = PoseLaw(floor_mm=min(0.0, float(place_in_base_mm[2]) - radius))
    pool = sphere_candidates(scene.model, scene.flange_from_camera, place_in_base_mm, radius, view, _DRAWN_PER_VIEW * n, rng, law=law)
    shuffled = rng.permutation(len(pool.view))
    _, first = np.unique(pool.view[shuffled], return_index=True)
    return pool.joints_rad[np.sort(shuffled[first])[:n]]


def indices_of(names: Sequence[str], spheres: Sequence[str]) -> IntArray:
    """(m,) index among some names of each shot's sphere."""
    return np.array([names.index(sphere) for sphere in spheres], dtype=np.int64)


def _view_box_mm(view: CameraView) -> FloatArray:
    """(2, 3) of the camera frame, around everything in view."""
    near, far = view.working_range_mm
    x, y = (far * float(np.tan(half)) for half in view.half_angle_rad)
    return np.array([[-x, -y, near], [x, y, far]])


def _constraint(length: PlacedLength, centres: FloatArray) -> LengthConstraint:
    distance = float(np.linalg.norm(centres[length.first] - centres[length.second]))
    return LengthConstraint(length.first, length.second, distance, length.expanded_uncertainty_mm / 2)
