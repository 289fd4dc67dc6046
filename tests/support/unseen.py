"""Lengths between places that a calibration never saw: their error, and what the calibration says of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from calibrate import Calibration
from calibrate.problem import Priors
from calibrate.robot_terms import arm_terms, load_basis
from calibrate.solve import CalibrationSettings, calibrate
from drivers.files.session import read_session
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from tests.support.solving import draw_shots, noise_free
from tests.support.synthetic import SyntheticCell, SyntheticShot, paper_cell
from tests.support.synthetic_session import write_session

PLACES = np.array([[900.0, 100.0, 300.0], [820.0, -250.0, 380.0]])
LOW_MM, HIGH_MM = np.array([750.0, -300.0, 250.0]), np.array([950.0, 250.0, 450.0])
"""Corners of the volume that unseen places are drawn from."""


@dataclass(frozen=True)
class UnseenLength:
    """One length between two places."""

    error_mm: float
    sigma_mm: float
    """Standard uncertainty that the calibration's own covariance gives."""
    plain_sigma_mm: float
    """The same before held-out shots widened the covariance, which they may do and never narrow it."""


def places_in_base_mm(calibration: Calibration, shots: Sequence[SyntheticShot]) -> FloatArray:
    """(n, 3) where the points of some shots come out in the stated base."""
    return np.concatenate([calibration.points_in_base_mm(s.points_in_camera_mm, joints_rad=s.joints_rad) for s in shots])


def misses_mm(calibration: Calibration, tests: Sequence[SyntheticShot], cell: SyntheticCell) -> FloatArray:
    """(n,) distance of held-out points from the best-fitting true ones: the stated base is not the true one."""
    found, true = places_in_base_mm(calibration, tests), true_places_mm(cell, tests)
    return np.asarray(np.linalg.norm(se3.apply(se3.fit_rigid(found, true), found) - true, axis=1))


def true_places_mm(cell: SyntheticCell, shots: Sequence[SyntheticShot]) -> FloatArray:
    """(n, 3) where the points of noise-free shots truly are, in the cell's own base."""
    result = []
    for shot in shots:
        true = shot.points_in_camera_mm.copy()
        for _ in range(6):  # the error is a function of the true point; it changes slowly
            true[:, 2] = shot.points_in_camera_mm[:, 2] - cell.camera_error_mm(true)
        result.append(se3.apply(shot.true_base_from_camera, true))
    return np.concatenate(result)


def unseen_length(
    calibration: Calibration, cell: SyntheticCell, place_a: ArrayLike, place_b: ArrayLike, rng: np.random.Generator, n_views: int = 2
) -> UnseenLength:
    """Length between two places, each the mean of one noise-free point from some views."""
    views = [noise_free(replace(cell, centre_in_base_mm=np.asarray(place)), rng, n_views, n_points=1) for place in (place_a, place_b)]
    found_a, found_b = (places_in_base_mm(calibration, shots).mean(axis=0) for shots in views)
    true_a, true_b = (true_places_mm(cell, shots).mean(axis=0) for shots in views)
    jacobians = [np.mean([calibration.point_jacobian(s.points_in_camera_mm, joints_rad=s.joints_rad)[0] for s in shots], axis=0) for shots in views]
    length = float(np.linalg.norm(found_b - found_a))
    row = (found_b - found_a) / length @ (jacobians[1] - jacobians[0])
    covariance = calibration.covariance[: len(row), : len(row)]
    sigma_mm = float(np.sqrt(row @ covariance @ row))
    return UnseenLength(length - float(np.linalg.norm(true_b - true_a)), sigma_mm, sigma_mm / np.sqrt(calibration.statistics.covariance_scale))


def cell_of_the_solvers_own_kind(rng: np.random.Generator) -> SyntheticCell:
    """Random MDH errors, the pillow, a sphere that reads a little large, an arm that yields as its priors say.

    Nothing that the solver has no unknown for, or does not carry in its covariance.
    """
    cell = paper_cell()
    nominal = cell.nominal
    true = replace(
        nominal,
        a_mm=nominal.a_mm + rng.normal(0, 0.2, 6),
        d_mm=nominal.d_mm + rng.normal(0, 0.2, 6),
        alpha_rad=nominal.alpha_rad + rng.normal(0, 5e-4, 6),
        theta_offset_rad=nominal.theta_offset_rad + rng.normal(0, 5e-4, 6),
    )
    terms = arm_terms(nominal)
    coefficients = rng.normal(0, Priors().term_sigma_rad(terms))

    def yields_rad(joints_rad: FloatArray) -> FloatArray:
        # of the link angles, which are the axis angles here: this robot has no coupling
        return np.asarray(load_basis(terms, nominal, joints_rad) @ coefficients)

    return replace(cell, true=true, reads_large_mm=float(rng.normal(0, 0.03)), yields_rad=yields_rad)


def random_unseen_lengths(seed: int, folder: Path, *, n_shots: int, n_points: int, n_lengths: int, method: str = "clouds") -> list[UnseenLength]:
    """Calibrate a random cell on two spheres with their length, and measure lengths between random places of the volume."""
    rng = np.random.default_rng(seed)
    cell = cell_of_the_solvers_own_kind(rng)
    placed = {name: replace(cell, centre_in_base_mm=place) for name, place in zip("AB", PLACES, strict=True)}
    members = {name: draw_shots(at, rng, n_shots // 2, n_points=n_points) for name, at in placed.items()}
    length = ("A", "B", float(np.linalg.norm(PLACES[0] - PLACES[1])) + float(rng.normal(0, 0.0025)), 0.005)
    session = read_session(write_session(folder, cell, members, flange_from_camera=None, lengths=[length]))
    found = calibrate([session], CalibrationSettings(camera_error="pillow", method=method))
    ends = rng.uniform(LOW_MM, HIGH_MM, (n_lengths, 2, 3))
    return [unseen_length(found, cell, a, b, rng) for a, b in ends]
