"""What a simulated cell truly is, drawn for any cell file: so that plans, adapters and robot programs can be tried without hardware."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.cell import Cell, robot_model_of
from drivers.errors import SettingsError
from drivers.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from drivers.simulated.truth import BoxTruth, Truth

MISPLACED_MM = 1.0
"""How far spheres stand from where the cell file puts them, one sigma an axis."""
_FARTHEST_MM = 20.0
_ROUNDS = 500
_UR_HOME_RAD = (0.0, -1.57, 1.2, -1.2, -1.57, 0.0)
"""With all axes at zero a UR lies stretched out."""


def truth_of_cell(cell: Cell, seed: int) -> Truth:
    """Robot, camera and spheres with errors of their own; certified diameters and lengths hold within their uncertainty.

    Nothing hangs on the clock (no drift), so that a robot behind a controller and a plain simulated one measure the same.

    Raises:
        SettingsError: no robot model, a sphere without a place, or lengths that contradict the places.
    """
    from dataclasses import replace

    from drivers.simulated.draws import PAPER_FLANGE_FROM_CAMERA, random_truth
    from drivers.simulated.truth import SphereTruth

    model = robot_model_of(cell)
    if model is None:
        raise SettingsError("the cell names no robot model", file=cell.path, where="robot.model", remedy="Name one, e.g. ur5e.")
    rng = np.random.default_rng([seed, 6])
    centres = true_centres_mm(cell, rng)
    certified = ((name, cell.spheres[name]) for name in centres)
    sizes_mm = {name: float(rng.normal(sphere.diameter_mm, sphere.expanded_uncertainty_mm / 2)) for name, sphere in certified}
    spheres = {name: SphereTruth((float(x), float(y), float(z)), sizes_mm[name]) for name, (x, y, z) in centres.items()}
    guess = PAPER_FLANGE_FROM_CAMERA if cell.flange_from_camera is None else cell.flange_from_camera
    truth = random_truth(model, rng, spheres=spheres, flange_from_camera=guess, boxes=_boxes(cell))
    home = _UR_HOME_RAD if model.name.startswith("ur") and model.n_joints == len(_UR_HOME_RAD) else ()
    return replace(truth, robot=replace(truth.robot, drift_per_hour=(0.0,) * 6, home_rad=home))


def true_centres_mm(cell: Cell, rng: np.random.Generator) -> dict[str, FloatArray]:
    """Where the spheres stand (3,): near the places of the cell file, and as far apart as their certificates say.

    Raises:
        SettingsError: a sphere without a place, or lengths that contradict the places.
    """
    centres: dict[str, FloatArray] = {}
    for name, sphere in cell.spheres.items():
        if sphere.centre_in_base_mm is None:
            where = f"spheres.{name}.centre_in_base_mm"
            raise SettingsError(f"sphere {name} has no place", file=cell.path, where=where, remedy="Write where it stands, e.g. [400, 0, 150].")
        centres[name] = np.asarray(sphere.centre_in_base_mm) + rng.normal(0, MISPLACED_MM, 3)
    placed = {name: centre.copy() for name, centre in centres.items()}
    wanted = [(length.between, rng.normal(length.length_mm, length.expanded_uncertainty_mm / 2)) for length in cell.lengths]
    for _ in range(_ROUNDS):
        for (first, second), length_mm in wanted:
            way = centres[second] - centres[first]
            share = way * (1 - length_mm / max(float(np.linalg.norm(way)), 1e-9)) / 2
            centres[first] = centres[first] + share
            centres[second] = centres[second] - share
    for (first, second), length_mm in wanted:
        error_mm = abs(float(np.linalg.norm(centres[second] - centres[first])) - length_mm)
        moved_mm = max(float(np.linalg.norm(centres[name] - placed[name])) for name in (first, second))
        if error_mm > 1e-6 or moved_mm > _FARTHEST_MM:
            found = f"the length {first}-{second} of {length_mm:.3f} mm does not fit the places of its spheres"
            raise SettingsError(found, file=cell.path, where="lengths", remedy="Correct centre_in_base_mm or length_mm.")
    return centres


def _boxes(cell: Cell) -> tuple[BoxTruth, ...]:
    from drivers.simulated.draws import transform_rows
    from drivers.simulated.truth import BoxTruth

    return tuple(BoxTruth(obstacle.size_mm, transform_rows(obstacle.base_from_obstacle)) for obstacle in cell.obstacles if obstacle.kind == "box")
