"""Which artefact is worth buying: expected accuracy of a cell with spheres that nobody has yet, for several numbers of shots.

Virtual spheres are put into the work volume, shots are designed for them as `spherecal plan` would (greedily), and the
figures of `calibrate.design` tell what lengths over the work volume would then be good for. Nothing is moved.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from acquire.cell import Cell
from acquire.visibility import camera_view
from calibrate.design import Predicted, choose_shots
from calibrate.design_cell import PlacedLength, PlacedSphere, aim_of_cell, feasible_views, placed_in_cell, scene_of, work_box_mm
from calibrate.design_shots import Expectation, IntArray, Scene
from drivers.errors import DataError, SettingsError
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

DEFAULT_SHOTS = (30, 60, 120)
DEFAULT_DIAMETER_MM = 38.1
DEFAULT_LENGTH_MM = 500.0
_LENGTH_U_MM = 0.005
_POOL_PER_SHOT = 2.5
_LEAST_POOL = 150
_FEWEST_VIEWS = 4
_ACROSS, _ALONG, _UP, _SLANTED = (0.0, 1.0, 0.0), (1.0, 0.1, 0.0), (-0.1, 0.55, 0.83), (0.4, 0.8, 0.4)
# corners of a frame, in units of its longest side
_FRAME = ((-0.36, -0.4, -0.2), (0.38, -0.34, -0.11), (0.02, 0.43, 0.27), (0.34, 0.36, -0.24), (-0.33, 0.11, 0.31))


@dataclass(frozen=True, slots=True)
class Artefact:
    """Spheres and certified lengths, standing somewhere in the base."""

    name: str
    description: str
    spheres: tuple[PlacedSphere, ...]
    lengths: tuple[PlacedLength, ...] = ()


@dataclass(frozen=True, slots=True)
class ArtefactPrediction:
    """What an artefact and a number of shots would be good for."""

    artefact: Artefact
    n_shots: int
    predicted: Predicted | None
    reason: str | None = None
    """Why there is no prediction."""

    def to_json_dict(self) -> Mapping[str, object]:
        """One entry of `spherecal predict --json`."""
        figures: Mapping[str, object] = {"centre_rms_mm": None, "length_rms_mm": None} if self.predicted is None else self.predicted.to_json_dict()
        return {
            "artefact": self.artefact.name,
            "description": self.artefact.description,
            "n_spheres": len(self.artefact.spheres),
            "n_lengths": len(self.artefact.lengths),
            "n_shots": self.n_shots,
            **figures,
            "reason": self.reason,
        }


def usual_artefacts(box_in_base_mm: FloatArray, *, length_mm: float, diameter_mm: float) -> tuple[Artefact, ...]:
    """The artefacts that are compared, around the middle of a work volume (2, 3) (METHOD.md 4's table).

    Args:
        box_in_base_mm: lower and upper corner.
        length_mm: of the bar, and of a frame's longest side.
        diameter_mm: of the spheres.
    """
    middle = box_in_base_mm.mean(axis=0)
    one_bar = _bar(middle, _SLANTED, length_mm, diameter_mm)
    rise = 0.08 * length_mm * np.array([0.0, 0.0, 1.0])
    three_bars = [
        sphere
        for offset, direction in ((-rise, _ACROSS), (0 * rise, _ALONG), (1.5 * rise, _UP))
        for sphere in _bar(middle + offset, direction, length_mm, diameter_mm)
    ]
    frame = [_sphere(middle + length_mm * np.array(corner), diameter_mm) for corner in _FRAME]
    other = _sphere(np.array(one_bar[1].centre_in_base_mm), diameter_mm / 1.5)
    bars = tuple(PlacedLength(i, i + 1, _LENGTH_U_MM) for i in (0, 2, 4))
    made = f"{length_mm:g} mm"
    return (
        Artefact("one sphere", "one sphere, no length", (_sphere(middle, diameter_mm),)),
        Artefact("two spheres", f"two spheres {made} apart, the length not certified", one_bar),
        Artefact("two diameters", f"two spheres of {diameter_mm:g} and {diameter_mm / 1.5:.3g} mm, {made} apart, no length", (one_bar[0], other)),
        Artefact("six places", "six places, no length", tuple(three_bars)),
        Artefact("one bar", f"two spheres, one certified {made} bar", one_bar, bars[:1]),
        Artefact("bar in three orientations", f"one certified {made} bar put in three orientations", tuple(three_bars), bars),
        Artefact("three spheres", f"three spheres of a {made} frame, three certified lengths", tuple(frame[:3]), _all_lengths(3)),
        Artefact("five spheres", f"five spheres of a {made} frame, ten certified lengths", tuple(frame), _all_lengths(5)),
    )


def own_artefact(cell: Cell, names: Sequence[str]) -> Artefact:
    """Spheres of a cell as they stand, with the certified lengths between them.

    Raises:
        SettingsError: an unknown sphere, or one of unknown place.
    """
    spheres, lengths = placed_in_cell(cell, names)
    return Artefact("this cell", f"spheres {', '.join(names)} of the cell, {len(lengths)} certified lengths", spheres, lengths)


def box_of(cell: Cell) -> FloatArray:
    """(2, 3) where accuracy matters: the work volume, or the box around the spheres of known place.

    Raises:
        SettingsError: neither is known.
    """
    placed = [sphere.centre_in_base_mm for sphere in cell.spheres.values() if sphere.centre_in_base_mm is not None]
    if cell.work_volume_box_mm is None and not placed:
        remedy = "Add work_volume_mm: [[x0, y0, z0], [x1, y1, z1]], in the base."
        raise SettingsError("it is not known where accuracy matters", file=cell.path, where="work_volume_mm", remedy=remedy)
    return work_box_mm(cell, np.array(placed, dtype=np.float64).reshape(-1, 3))


def artefacts_of(cell: Cell, names: Sequence[str] = ()) -> tuple[Artefact, ...]:
    """The usual artefacts in a cell's work volume, and the cell's own spheres (some, or all of known place).

    Raises:
        SettingsError: neither a work volume nor a sphere's place is known; or as `own_artefact`.
    """
    box = box_of(cell)
    placed = [name for name, sphere in cell.spheres.items() if sphere.centre_in_base_mm is not None]
    own = (own_artefact(cell, names or placed),) if names or placed else ()
    diameters = [cell.spheres[name].diameter_mm for name in placed]
    return own + usual_artefacts(
        box,
        length_mm=cell.lengths[0].length_mm if cell.lengths else DEFAULT_LENGTH_MM,
        diameter_mm=float(np.median(diameters)) if diameters else DEFAULT_DIAMETER_MM,
    )


def predict_artefact(
    cell: Cell,
    model: RobotModel,
    artefact: Artefact,
    n_shots: Sequence[int],
    *,
    seed: int = 0,
    expectation: Expectation | None = None,
    camera_error: str = "field",
) -> tuple[ArtefactPrediction, ...]:
    """What an artefact would be good for, with shots chosen for it; one result per number of shots.

    An artefact that does not fit into the robot's reach has a reason instead of figures.

    Raises:
        SettingsError: the cell lacks what planning needs.
        DataError: the work volume cannot be reached.
    """
    scene = scene_of(cell, model, artefact.spheres, artefact.lengths, expectation=expectation, camera_error=camera_error)
    # the same places and views for every artefact: what differs is the artefact
    aim = aim_of_cell(cell, scene, np.random.default_rng([seed, 1]), box_in_base_mm=box_of(cell))
    try:
        joints, sphere = _pool(cell, scene, max(n_shots), np.random.default_rng([seed, 2]))
    except DataError as error:
        return tuple(ArtefactPrediction(artefact, n, None, error.message) for n in n_shots)
    return tuple(ArtefactPrediction(artefact, n, choose_shots(scene, aim, joints, sphere, n, sweeps=1).predicted) for n in n_shots)


def ranked(found: Iterable[Sequence[ArtefactPrediction]]) -> tuple[ArtefactPrediction, ...]:
    """Predictions by artefact, the best (with most shots) first; those out of reach last."""
    groups = sorted(found, key=lambda group: group[-1].predicted.length_rms_mm if group[-1].predicted else np.inf)
    return tuple(prediction for group in groups for prediction in group)


def _pool(cell: Cell, scene: Scene, n: int, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """Feasible views of every sphere, as many as a choice of n wants; DataError where a sphere is out of reach."""
    per_sphere = int(max(_LEAST_POOL, _POOL_PER_SHOT * n)) // len(scene.radius_mm)
    view = camera_view(cell.camera)
    views = [feasible_views(scene, view, centre, per_sphere, rng) for centre in scene.centres_in_base_mm]
    for i, found in enumerate(views):
        if len(found) < _FEWEST_VIEWS:
            place = ", ".join(f"{x:.0f}" for x in scene.centres_in_base_mm[i])
            raise DataError(f"only {len(found)} views of a sphere at ({place}) mm are feasible", remedy="Move the work volume towards the robot.")
    return np.concatenate(views), np.repeat(np.arange(len(views)), [len(found) for found in views])


def _bar(middle_mm: FloatArray, direction: tuple[float, float, float], length_mm: float, diameter_mm: float) -> tuple[PlacedSphere, PlacedSphere]:
    half = np.array(direction) / np.linalg.norm(direction) * length_mm / 2
    return _sphere(middle_mm - half, diameter_mm), _sphere(middle_mm + half, diameter_mm)


def _sphere(centre_mm: FloatArray, diameter_mm: float) -> PlacedSphere:
    return PlacedSphere((float(centre_mm[0]), float(centre_mm[1]), float(centre_mm[2])), diameter_mm)


def _all_lengths(n: int) -> tuple[PlacedLength, ...]:
    return tuple(PlacedLength(i, j, _LENGTH_U_MM) for i, j in combinations(range(n), 2))
