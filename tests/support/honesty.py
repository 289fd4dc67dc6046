"""Whether a calibration tells the truth about itself: intervals of unseen lengths, and verdicts against limits, over many cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from acquire.cell import Limits
from acquire.sphere import fit_fixed_radius
from calibrate.observations import Observations
from calibrate.result import Calibration
from calibrate.solve import CalibrationSettings
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.draws import Sizes
from tests.support.volume import DIAMETER_MM, UNSEEN, calibrated, random_shots, volume_cell

_LOOSE_MM = 10.0
"""Limits on what this is not about."""


@dataclass(frozen=True)
class HonestCell:
    """One calibrated cell, judged at places that it never saw, by shots without noise."""

    seed: int
    camera_error: str
    verdict: str
    limit_mm: float
    error_mm: FloatArray
    """(l,) of lengths between the unseen places."""
    sigma_mm: FloatArray
    """(l,) standard uncertainty that the calibration states."""

    @property
    def ratio(self) -> float:
        """Seen over predicted rms."""
        return float(np.sqrt((self.error_mm**2).mean() / (self.sigma_mm**2).mean()))

    @property
    def largest_mm(self) -> float:
        """What a limit on length is held against."""
        return float(np.abs(self.error_mm).max())


def honest_cell(
    seed: int, artefact: str = "bar3", *, limit_mm: float = 0.1, n_shots: int = 120, camera_error: str = "auto", sizes: Sizes | None = None
) -> HonestCell:
    """Draw a cell whose errors are not the solver's models, calibrate it against a limit on length, and look where it is wrong."""
    volume = volume_cell(seed, artefact, sizes=sizes)
    limits = Limits(centre_rms_mm=_LOOSE_MM, length_error_mm=limit_mm, diameter_error_mm=_LOOSE_MM, form_mm=_LOOSE_MM)
    rng = np.random.default_rng([seed, 1])
    shots = random_shots(volume, volume.spheres, n_shots // len(volume.spheres), rng)
    test = random_shots(volume, tuple(UNSEEN), 10, rng, noise=False, n_points=200)
    cell = volume.cell.model_copy(update={"limits": limits})
    found = calibrated(volume, shots, CalibrationSettings(camera_error), cell=cell)
    errors, sigmas = lengths_of(found, test)
    return HonestCell(seed, found.camera_error.name, found.verdict, limit_mm, errors, sigmas)


def lengths_of(calibration: Calibration, test: Observations) -> tuple[FloatArray, FloatArray]:
    """Errors (l,) of the lengths between unseen places as verify measures them, and their standard uncertainties."""
    centres, motion = {}, {}
    offset = calibration.parameter_names.index("radius_offset_mm")
    for name in UNSEEN:
        shots = [shot for shot in test.shots if shot.sphere == name]
        points = [calibration.points_in_base_mm(s.points_in_camera_mm, joints_rad=s.joints_rad) for s in shots]
        columns = np.concatenate([calibration.point_jacobian(s.points_in_camera_mm, joints_rad=s.joints_rad) for s in shots])
        together = np.concatenate(points)
        centre, _ = fit_fixed_radius(together, DIAMETER_MM / 2 + calibration.radius_offset_mm, np.array(UNSEEN[name]))
        unit = (together - centre) / np.linalg.norm(together - centre, axis=1, keepdims=True)
        rows = np.concatenate([np.einsum("ni,nij->nj", unit, columns), -np.ones((len(unit), 1))], axis=1)
        centres[name], motion[name] = centre, np.linalg.solve(unit.T @ unit, unit.T @ rows)
    covariance = calibration.covariance[: offset + 1, : offset + 1]
    errors, sigmas = [], []
    for a, b in combinations(UNSEEN, 2):
        way = centres[b] - centres[a]
        length = float(np.linalg.norm(way))
        row = way / length @ (motion[b] - motion[a])
        errors.append(length - float(np.linalg.norm(np.subtract(UNSEEN[a], UNSEEN[b]))))
        sigmas.append(float(np.sqrt(row @ covariance @ row)))
    return np.array(errors), np.array(sigmas)


@dataclass(frozen=True)
class Honesty:
    """What many cells show together."""

    covered: float
    ratio_median: float
    ratio_95: float
    false_pass: float
    """Share of all cells that pass although a length is beyond the limit."""
    pass_when_good: float
    """Share of passes among cells that are twice as good as the limit; NaN without any."""

    @property
    def line(self) -> str:
        """For a log."""
        return (
            f"covered {100 * self.covered:.1f} %, seen / predicted median {self.ratio_median:.2f}, 95 % {self.ratio_95:.2f}, "
            f"false pass {100 * self.false_pass:.1f} %, pass of cells twice as good as the limit {100 * self.pass_when_good:.0f} %"
        )


def judged(cells: Sequence[HonestCell]) -> Honesty:
    """The figures of the issue: coverage of 95 % intervals, seen over predicted, and how verdicts err."""
    ratios = [cell.ratio for cell in cells]
    good = [cell for cell in cells if cell.largest_mm <= cell.limit_mm / 2]
    return Honesty(
        covered=float(np.mean(np.concatenate([np.abs(cell.error_mm) <= 1.96 * cell.sigma_mm for cell in cells]))),
        ratio_median=float(np.median(ratios)),
        ratio_95=float(np.quantile(ratios, 0.95)),
        false_pass=float(np.mean([cell.verdict == "pass" and cell.largest_mm > cell.limit_mm for cell in cells])),
        pass_when_good=float(np.mean([cell.verdict == "pass" for cell in good])) if good else float("nan"),
    )
