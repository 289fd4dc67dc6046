"""Data sets for the comparison with peers: the same shots for everybody, and a score that knows the truth.

Clean, pillow and outliers: one sphere, METHOD.md 4's pose law and noise (0.08 mm in depth, 0.01 mm and 0.1 mrad of pose),
24 MDH errors of 0.3 mm and 0.05 degrees, scored by the centre rms about the mean on noise-free shots that nobody saw.
Volume: tests.support.volume's mismatched truth with one 500 mm bar in three orientations, scored by unseen lengths.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from acquire.cell import Cell, parse_cell
from acquire.sphere import fit_fixed_radius
from calibrate.observations import Observations, SphereShot
from drivers.files.yaml import dump_yaml
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from tests.support.solving import draw_shots, noise_free
from tests.support.synthetic import SyntheticCell, SyntheticShot, paper_cell
from tests.support.synthetic_session import cell_data
from tests.support.volume import UNSEEN, random_shots, unseen_lengths, volume_cell

N_SHOTS, N_TESTS, N_POINTS = 100, 60, 1000
N_SPOILED, SPOILED_MM = 5, 2.0
VOLUME_SHOTS_A_SPHERE, VOLUME_TESTS_A_PLACE = 20, 10
NAMES = ("clean", "pillow", "outliers", "volume")


@dataclass(frozen=True, eq=False)
class DataSet:
    """Shots to calibrate on, shots to judge by."""

    name: str
    model: RobotModel
    cell: Cell
    train: Observations
    test: Observations

    @property
    def hand_eye_guess(self) -> FloatArray:
        """(4, 4) what the cell file says of flange_from_camera."""
        assert self.cell.flange_from_camera is not None
        return self.cell.flange_from_camera

    @property
    def test_joints_rad(self) -> FloatArray:
        """(k, n)."""
        return np.array([shot.joints_rad for shot in self.test.shots])


@dataclass(frozen=True, eq=False)
class Found:
    """What a solver makes of the shots it is judged by."""

    base_from_camera: FloatArray
    """(k, 4, 4) of the test shots."""
    correction_in_camera_mm: tuple[FloatArray, ...] | None = None
    """Of the points of every test shot; None without a camera model."""
    radius_offset_mm: float = 0.0
    seconds: float = 0.0
    note: str = ""


def data_set(name: str, seed: int) -> DataSet:
    """One data set; the seed draws truth, noise and poses, and is not one that another test uses."""
    rng = np.random.default_rng([seed, 77, NAMES.index(name)])
    return _volume(seed, rng) if name == "volume" else _one_sphere(name, rng)


def score_mm(data: DataSet, found: Found) -> FloatArray:
    """Errors (n,): distances of the test shots' centres from their mean, or errors of the lengths between unseen places."""
    shifts = found.correction_in_camera_mm or (np.zeros(3),) * len(data.test.shots)
    points = [
        se3.apply(pose, shot.points_in_camera_mm + shift) for pose, shot, shift in zip(found.base_from_camera, data.test.shots, shifts, strict=True)
    ]
    starts = [se3.apply(pose, _centre(shot)) for pose, shot in zip(found.base_from_camera, data.test.shots, strict=True)]
    radius = data.test.shots[0].radius_mm + found.radius_offset_mm
    if data.name != "volume":
        centres = np.array([fit_fixed_radius(p, radius, start)[0] for p, start in zip(points, starts, strict=True)])
        return np.asarray(np.linalg.norm(centres - centres.mean(axis=0), axis=1))
    rows = {place: [j for j, shot in enumerate(data.test.shots) if shot.sphere == place] for place in UNSEEN}
    pooled = {
        place: fit_fixed_radius(np.concatenate([points[j] for j in js]), radius, np.mean([starts[j] for j in js], axis=0))[0]
        for place, js in rows.items()
    }
    return unseen_lengths(pooled)


def rms(errors: ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(errors)))))


def _one_sphere(name: str, rng: np.random.Generator) -> DataSet:
    cell = paper_cell()
    nominal = cell.nominal
    true = replace(
        nominal,
        a_mm=nominal.a_mm + rng.normal(0, 0.3, 6),
        d_mm=nominal.d_mm + rng.normal(0, 0.3, 6),
        alpha_rad=nominal.alpha_rad + rng.normal(0, np.radians(0.05), 6),
        theta_offset_rad=nominal.theta_offset_rad + rng.normal(0, np.radians(0.05), 6),
    )
    cell = replace(cell, true=true)
    if name != "pillow":
        cell = replace(cell, camera_error_mm=lambda points: np.zeros(len(points)))
    train = draw_shots(cell, rng, N_SHOTS, n_points=N_POINTS)
    if name == "outliers":
        train = _spoiled(train, rng)
    test = noise_free(cell, rng, N_TESTS, n_points=N_POINTS // 2)
    guess = cell.flange_from_camera @ se3.exp(np.concatenate([rng.normal(0, 1.15, 3), rng.normal(0, 4e-3, 3)]))
    parsed = parse_cell(dump_yaml(cell_data(cell, ("A",), guess, (), None)).encode(), path=Path(f"{name}.yaml"))
    return DataSet(name, nominal, parsed, _observations(cell, train), _observations(cell, test))


def _volume(seed: int, rng: np.random.Generator) -> DataSet:
    volume = volume_cell(seed, "bar3")
    train = random_shots(volume, volume.spheres, VOLUME_SHOTS_A_SPHERE, rng)
    test = random_shots(volume, list(UNSEEN), VOLUME_TESTS_A_PLACE, rng, noise=False)
    return DataSet("volume", volume.model, volume.cell, train, test)


def _spoiled(shots: list[SyntheticShot], rng: np.random.Generator) -> list[SyntheticShot]:
    """Some shots 2 mm off as a whole, in random directions: somebody touched the sphere, or the arm still swung."""
    result = list(shots)
    for j in rng.choice(len(shots), N_SPOILED, replace=False):
        direction = rng.normal(size=3)
        shift = SPOILED_MM * direction / np.linalg.norm(direction)
        result[j] = replace(shots[j], points_in_camera_mm=shots[j].points_in_camera_mm + shift)
    return result


def _observations(cell: SyntheticCell, shots: list[SyntheticShot]) -> Observations:
    return Observations(tuple(_observed(cell, shot, i) for i, shot in enumerate(shots)), ())


def _observed(cell: SyntheticCell, shot: SyntheticShot, index: int) -> SphereShot:
    points = shot.points_in_camera_mm
    mean = points.mean(axis=0)
    centre, _ = fit_fixed_radius(points, cell.radius_mm, mean * (1 + 0.6 * cell.radius_mm / np.linalg.norm(mean)))
    return SphereShot(
        session="s",
        index=index,
        sphere="A",
        scan_sha256=f"{index:064d}",
        joints_rad=shot.joints_rad,
        base_from_flange=mdh.base_from_flange(cell.nominal, shot.joints_rad),
        points_in_camera_mm=points,
        radius_mm=cell.radius_mm,
        centre_in_camera_mm=centre,
    )


def _centre(shot: SphereShot) -> FloatArray:
    assert shot.centre_in_camera_mm is not None
    return shot.centre_in_camera_mm
