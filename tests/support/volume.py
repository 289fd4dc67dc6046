"""Volume accuracy: a bar in a simulated cell whose errors are not the calibrator's models, judged on unseen lengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from acquire.cell import Cell, parse_cell
from acquire.poses import PoseLaw, sphere_candidates
from acquire.sphere import fit_fixed_radius
from acquire.visibility import CameraView, camera_view
from calibrate.camera_error import correction_in_camera_mm
from calibrate.observations import Observations, SphereShot
from calibrate.report_figures import make_result
from calibrate.result import Calibration
from calibrate.robot_terms import deflection_rad
from calibrate.solve import CalibrationSettings, Solved, solve_observations
from drivers.files.yaml import dump_yaml
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.draws import PAPER_FLANGE_FROM_CAMERA, Sizes, random_truth
from drivers.simulated.sampling import observe_sphere
from drivers.simulated.truth import SphereTruth
from tests.support.solving import one_thread

DIAMETER_MM = 38.1
LENGTH_U_MM = 0.005
_MIDDLE = np.array([880.0, 0.0, 330.0])
_BARS = {
    "bar3": [((0, 0, -40), (0, 1, 0)), ((0, 40, 0), (1, 0.1, 0)), ((20, -20, 60), (-0.1, 0.55, 0.83))],
    "bar1": [((0, 0, 0), (0.4, 0.8, 0.4))],
}
_CORNERS = [(-200, -220, -110), (210, -190, -60), (10, 240, 150), (190, 200, -130), (-180, 60, 170)]
ARTEFACTS = ("one", "two", "bar1", "six", "bar3", "three", "five")
"""METHOD.md 4's: a single sphere, a bar whose length nobody knows, one bar, the six places of bar3 without its lengths,
a bar in three orientations, three and five spheres of a frame with all their lengths."""
UNSEEN = {
    "T": (640.0, -330.0, 130.0),
    "U": (1120.0, -320.0, 190.0),
    "V": (1100.0, 330.0, 150.0),
    "W": (660.0, 320.0, 200.0),
    "X": (680.0, -280.0, 560.0),
    "Y": (1060.0, 250.0, 530.0),
    "Z": (870.0, 20.0, 300.0),
    "S": (1000.0, -120.0, 480.0),
}


@dataclass(frozen=True)
class VolumeCell:
    """One simulated cell and what its cell file says."""

    simulated: SimulatedCell
    cell: Cell
    model: RobotModel
    spheres: tuple[str, ...]
    text: str = ""
    """The cell file."""


def volume_cell(
    seed: int, artefact: str = "bar3", *, model_name: str = "abb_irb1410", sizes: Sizes | None = None, bar_mm: float = 500.0
) -> VolumeCell:
    """A random truth with the spheres of an artefact and the unseen places."""
    rng = np.random.default_rng([seed, 35])
    model = load_robot_model(model_name)
    places, lengths = _artefact(artefact, bar_mm)
    calibration = tuple(places)
    places |= {name: np.array(place) for name, place in UNSEEN.items()}
    truth = random_truth(model, rng, spheres={n: SphereTruth((p[0], p[1], p[2]), DIAMETER_MM) for n, p in places.items()}, sizes=sizes)
    # a bar is one artefact with one certificate; the lengths of a frame are measured one by one
    error_mm = np.full(len(lengths), rng.normal(0, LENGTH_U_MM / 2))
    if artefact in {"three", "five"}:
        error_mm = rng.normal(0, LENGTH_U_MM / 2, len(lengths))
    certified = [(a, b, float(np.linalg.norm(places[a] - places[b]) + error)) for (a, b), error in zip(lengths, error_mm, strict=True)]
    text = _cell_text(model_name, places, certified)
    return VolumeCell(SimulatedCell(truth, model), parse_cell(text.encode(), path=Path("volume.yaml")), model, calibration, text)


def _artefact(name: str, bar_mm: float) -> tuple[dict[str, FloatArray], list[tuple[str, str]]]:
    """Places of an artefact's spheres, and which of them have a certified length between them."""
    if name in {"one", "three", "five"}:
        n = {"one": 1, "three": 3, "five": 5}[name]
        frame = {letter: _MIDDLE + corner for letter, corner in zip("ABCDE"[:n], _CORNERS, strict=False)}
        return ({"A": _MIDDLE}, []) if n == 1 else (frame, list(combinations(frame, 2)))
    bars = _BARS[{"two": "bar1", "six": "bar3"}.get(name, name)]
    places: dict[str, FloatArray] = {}
    for i, (offset, direction) in enumerate(bars):
        half = np.array(direction, dtype=np.float64) / np.linalg.norm(direction) * bar_mm / 2
        places["ACE"[i]], places["BDF"[i]] = _MIDDLE + offset - half, _MIDDLE + offset + half
    return places, [] if name in {"two", "six"} else [("ACE"[i], "BDF"[i]) for i in range(len(bars))]


def random_shots(
    volume: VolumeCell, spheres: Sequence[str], per_sphere: int, rng: np.random.Generator, *, n_points: int = 500, noise: bool = True
) -> Observations:
    """Feasible random views of some spheres, as observations (no sphere finding, no files)."""
    shots: list[SphereShot] = []
    view = camera_view(volume.cell.camera)
    for name in spheres:
        joints = _poses(volume, name, view, per_sphere, rng)
        for q in joints:
            shots.append(observed(volume, name, q, rng, index=len(shots), n_points=n_points, noise=noise))
    return Observations(tuple(shots), ())


def observed(
    volume: VolumeCell, sphere: str, joints: FloatArray, rng: np.random.Generator, *, index: int, n_points: int, noise: bool = True
) -> SphereShot:
    """One shot as calibrate sees it."""
    points = observe_sphere(volume.simulated, joints, sphere, n_points, rng, noise=noise)
    nominal = mdh.base_from_flange(volume.model, joints)
    mean = points.mean(axis=0)
    centre, _ = fit_fixed_radius(points, DIAMETER_MM / 2, mean * (1 + 0.6 * DIAMETER_MM / 2 / np.linalg.norm(mean)))
    cosine = -np.einsum("ni,ni->n", points - centre, points) / np.linalg.norm(points - centre, axis=1) / np.linalg.norm(points, axis=1)
    points = points[cosine > 0.5]  # what sphere finding keeps
    return SphereShot(
        session="s",
        index=index,
        sphere=sphere,
        scan_sha256=f"{index:064d}",
        joints_rad=joints,
        base_from_flange=nominal,
        points_in_camera_mm=points,
        radius_mm=DIAMETER_MM / 2,
        centre_in_camera_mm=centre,
    )


def calibrated(volume: VolumeCell, shots: Observations, settings: CalibrationSettings | None = None, *, cell: Cell | None = None) -> Calibration:
    """The calibration of some shots, as `calibrate` makes it of a session that holds them."""
    settings = settings or CalibrationSettings()
    with one_thread():
        solved, compared = solve_observations(shots, cell or volume.cell, volume.model, settings)
        return make_result(
            solved,
            method=settings.method,
            cell=cell or volume.cell,
            sessions=[],
            n_shots=len(shots.shots),
            notes=(),
            compared=compared,
            rejected=shots.rejected + solved.rejected,
            created_utc="2026-01-01T00:00:00Z",
            software="tests",
            began=0.0,
            like=settings.datum,
        )


def measured_centres(solved: Solved, observations: Observations) -> dict[str, FloatArray]:
    """Centres (3,) of spheres as `verify` measures them: all calibrated points of all views together, solver base."""
    problem, state = solved.assembled.problem, solved.solution.state
    points: dict[str, list[FloatArray]] = {}
    starts: dict[str, list[FloatArray]] = {}
    for shot in observations.shots:
        flange = shot.base_from_flange
        if problem.model is not None and shot.joints_rad is not None:
            deflection = deflection_rad(problem.terms, state.terms_rad, problem.model, shot.joints_rad)
            flange = mdh.base_from_flange(problem.model, shot.joints_rad, state.link_twists, deflection)
        base_from_camera = flange @ state.flange_from_camera
        corrected = shot.points_in_camera_mm + correction_in_camera_mm(problem.camera_error, state.camera_mm, shot.points_in_camera_mm)
        points.setdefault(shot.sphere, []).append(se3.apply(base_from_camera, corrected))
        if shot.centre_in_camera_mm is not None:
            starts.setdefault(shot.sphere, []).append(se3.apply(base_from_camera, shot.centre_in_camera_mm))
    radius = DIAMETER_MM / 2 + state.radius_offset_mm
    return {name: fit_fixed_radius(np.concatenate(p), radius, np.mean(starts[name], axis=0))[0] for name, p in points.items()}


def unseen_lengths(centres: Mapping[str, FloatArray]) -> FloatArray:
    """(n,) signed errors of all lengths between the unseen places."""
    errors = []
    for a, b in combinations(UNSEEN, 2):
        true = np.linalg.norm(np.subtract(UNSEEN[a], UNSEEN[b]))
        errors.append(np.linalg.norm(centres[a] - centres[b]) - true)
    return np.array(errors)


def _poses(volume: VolumeCell, sphere: str, view: CameraView, n: int, rng: np.random.Generator) -> FloatArray:
    centre = np.array(volume.cell.spheres[sphere].centre_in_base_mm)
    found: list[FloatArray] = []
    while len(found) < n:
        pool = sphere_candidates(
            volume.model, np.array(PAPER_FLANGE_FROM_CAMERA), centre, DIAMETER_MM / 2, view, 20 * n, rng, law=PoseLaw(floor_mm=-200.0)
        )
        _, first = np.unique(pool.view, return_index=True)
        rows = rng.permutation(first)[: n - len(found)]
        # one branch of each view at random
        found += [pool.joints_rad[rng.choice(np.flatnonzero(pool.view == pool.view[row]))] for row in rows]
    return np.array(found)


def _cell_text(model_name: str, places: Mapping[str, FloatArray], lengths: Sequence[tuple[str, str, float]]) -> str:
    data = {
        "format": "spherecal-cell/1",
        "name": "volume",
        "robot": {"driver": "simulated", "model": model_name},
        "camera": {
            "driver": "simulated",
            "kind": "area",
            "working_range_mm": [250, 430],
            "field_of_view_deg": [55, 36],
            "sight_crossing_mm": [60, 0, 500],
        },
        "flange_from_camera": [list(row) for row in PAPER_FLANGE_FROM_CAMERA],
        "spheres": {n: {"diameter_mm": DIAMETER_MM, "expanded_uncertainty_mm": 0.001, "centre_in_base_mm": p.tolist()} for n, p in places.items()},
        "lengths": [{"between": [a, b], "length_mm": length, "expanded_uncertainty_mm": LENGTH_U_MM} for a, b, length in lengths],
        "work_volume_mm": np.array([np.min(list(UNSEEN.values()), axis=0), np.max(list(UNSEEN.values()), axis=0)]).tolist(),
    }
    return dump_yaml(data)
