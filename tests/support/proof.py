"""The volume test: a calibrated simulated cell, verified on lengths along seven lines through its work volume."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from acquire.cell import Cell, CertifiedLength, Limits, Sphere
from acquire.poses import PoseLaw, sphere_candidates
from acquire.sphere import fit_fixed_radius
from acquire.visibility import CameraView, camera_view
from calibrate.observations import Observations, SphereShot
from calibrate.result import Calibration
from calibrate.solve import CalibrationSettings
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.draws import PAPER_FLANGE_FROM_CAMERA
from drivers.simulated.truth import SphereTruth
from measure.decision import overall
from measure.proof.judging import gaps_of, judgements
from measure.proof.volume import LENGTHS_PER_LINE, N_LINES, volume_lines
from measure.verify import verify_observations
from measure.verify_result import VerifyResult
from tests.support.volume import DIAMETER_MM, VolumeCell, calibrated, observed, random_shots, volume_cell

VOLUME_BOX_MM = np.array([[660.0, -300.0, 160.0], [1100.0, 300.0, 520.0]])
LENGTH_U_MM = 0.01
"""Of the lengths that judge: a bar moved along a line, or a tracker's."""
LIMIT_OF_U = 4.0
"""A limit on length as a multiple of the test's expanded uncertainty: the four to one of gauging."""
LOOSE_MM = 10.0
"""Limits on what a test is not about."""


@dataclass(frozen=True)
class ProvenCell:
    """One cell, calibrated and verified, and what its errors truly are."""

    seed: int
    result: VerifyResult
    cell: Cell
    true_error_mm: FloatArray
    """(35,) of the same lengths from the same poses without noise, against the true lengths."""
    limit_mm: float

    @property
    def error_mm(self) -> FloatArray:
        """(35,) measured minus certified."""
        return np.array([length.error_mm for length in self.result.lengths])

    @property
    def expanded_mm(self) -> FloatArray:
        """(35,) what verify states beside them."""
        return np.array([length.expanded_uncertainty_mm for length in self.result.lengths])

    @property
    def test_mm(self) -> FloatArray:
        """(35,) standard uncertainties of the test."""
        return np.array([length.test_standard_uncertainty_mm for length in self.result.lengths])

    @property
    def largest_mm(self) -> float:
        """Largest true error: what the limit is about."""
        return float(np.abs(self.true_error_mm).max())

    def judged_against(self, limit_mm: float, guard: str = "reference_and_repeat") -> ProvenCell:
        """The same figures against another limit on length, or by another guard band."""
        limits = limits_on_length(limit_mm).model_copy(update={"guard": guard})
        judged = judgements(limits, self.result.figures, self.result.lengths, self.cell.spheres)
        gaps = gaps_of(limits, self.result.figures, self.result.lengths, line_profile=False, flattery=())
        verdict, reasons = overall(judged, gaps)
        return replace(self, result=replace(self.result, limits=limits, judgements=judged, verdict=verdict, reasons=reasons), limit_mm=limit_mm)

    def enlarged(self, largest_mm: float) -> ProvenCell:
        """The same test of a system whose true errors are larger in proportion, the largest as given, against a limit that this exceeds by 2 %."""
        true = self.true_error_mm * largest_mm / self.largest_mm
        lengths = tuple(
            replace(x, measured_mm=x.measured_mm + t - old) for x, t, old in zip(self.result.lengths, true, self.true_error_mm, strict=True)
        )
        return replace(self, result=replace(self.result, lengths=lengths), true_error_mm=true).judged_against(largest_mm / 1.02)

    @property
    def line(self) -> str:
        """For a log."""
        inside = np.mean(np.abs(self.error_mm) <= self.expanded_mm)
        return (
            f"seed {self.seed}: inside U {100 * inside:.0f} %, U {np.median(self.expanded_mm):.3f}, test u {np.median(self.test_mm):.3f}, "
            f"limit {self.limit_mm:.3f}, largest true {self.largest_mm:.3f}, {self.result.verdict}"
        )


def with_lines(volume: VolumeCell, rng: np.random.Generator) -> tuple[VolumeCell, FloatArray]:
    """The cell with spheres along the seven lines and nothing else; true lengths (35,) beside the certified ones."""
    lines = volume_lines(VOLUME_BOX_MM)
    places = {f"L{i}P{k}": lines[i, k] for i in range(N_LINES) for k in range(LENGTHS_PER_LINE + 1)}
    offset = next(iter(volume.simulated.truth.spheres.values())).optical_offset_mm
    spheres = {name: SphereTruth((p[0], p[1], p[2]), DIAMETER_MM, offset) for name, p in places.items()}
    truth = volume.simulated.truth.__class__(
        **{k: getattr(volume.simulated.truth, k) for k in volume.simulated.truth.__slots__} | {"spheres": spheres}
    )
    true, lengths = [], []
    for i in range(N_LINES):
        for k in range(1, LENGTHS_PER_LINE + 1):
            true.append(float(np.linalg.norm(lines[i, k] - lines[i, 0])))
            lengths.append(
                CertifiedLength(
                    between=(f"L{i}P0", f"L{i}P{k}"), length_mm=true[-1] + rng.normal(0, LENGTH_U_MM / 2), expanded_uncertainty_mm=LENGTH_U_MM
                )
            )
    certified = {n: Sphere(diameter_mm=DIAMETER_MM, expanded_uncertainty_mm=0.001, centre_in_base_mm=(p[0], p[1], p[2])) for n, p in places.items()}
    box = ((*VOLUME_BOX_MM[0],), (*VOLUME_BOX_MM[1],))
    cell = volume.cell.model_copy(update={"spheres": certified, "lengths": tuple(lengths), "work_volume_mm": box})
    return VolumeCell(SimulatedCell(truth, volume.model), cell, volume.model, tuple(places)), np.array(true)


def views_of_places(volume: VolumeCell, per_place: int, rng: np.random.Generator) -> list[tuple[str, FloatArray]]:
    """Views (place, axis angles) of every sphere: random directions, a random branch of the arm for each."""
    view = camera_view(volume.cell.camera)
    return [(name, q) for name in volume.spheres for q in _poses(volume, name, view, per_place, rng)]


def _poses(volume: VolumeCell, sphere: str, view: CameraView, n: int, rng: np.random.Generator) -> list[FloatArray]:
    centre = np.array(volume.cell.spheres[sphere].centre_in_base_mm)
    found: list[FloatArray] = []
    while len(found) < n:
        pool = sphere_candidates(
            volume.model, np.array(PAPER_FLANGE_FROM_CAMERA), centre, DIAMETER_MM / 2, view, 12 * n, rng, law=PoseLaw(floor_mm=-200.0)
        )
        rows = rng.permutation(np.unique(pool.view, return_index=True)[1])[: n - len(found)]
        found += [pool.joints_rad[rng.choice(np.flatnonzero(pool.view == pool.view[row]))] for row in rows]
    return found


def seen(
    volume: VolumeCell, views: list[tuple[str, FloatArray]], rng: np.random.Generator, *, noise: bool = True, n_points: int = 300
) -> Observations:
    """Views as observations."""
    return Observations(tuple(observed(volume, name, q, rng, index=i, n_points=n_points, noise=noise) for i, (name, q) in enumerate(views)), ())


def proven_cell(seed: int, *, n_shots: int = 120, per_place: int = 4, settings: CalibrationSettings | None = None) -> ProvenCell:
    """Draw a cell, calibrate it on its bar, verify it on 35 unseen lengths against a limit of four expanded test uncertainties."""
    volume = volume_cell(seed, "bar3")
    rng = np.random.default_rng([seed, 6])
    found = calibrated(volume, random_shots(volume, volume.spheres, n_shots // len(volume.spheres), rng), settings)
    lined, true = with_lines(volume, rng)
    views = views_of_places(lined, per_place, rng)
    noisy, exact = seen(lined, views, rng), seen(lined, views, rng, noise=False)
    result = verify_observations(found, noisy, lined.cell, limits=None)
    limit = LIMIT_OF_U * 2.0 * float(np.median([length.test_standard_uncertainty_mm for length in result.lengths]))
    return ProvenCell(seed, result, lined.cell, true_errors_mm(found, exact, lined, true), limit).judged_against(limit)


def limits_on_length(limit_mm: float) -> Limits:
    """Limits that only lengths can miss."""
    return Limits(centre_rms_mm=LOOSE_MM, length_error_mm=limit_mm, diameter_error_mm=LOOSE_MM, form_mm=LOOSE_MM)


def true_errors_mm(calibration: Calibration, exact: Observations, volume: VolumeCell, true_mm: FloatArray) -> FloatArray:
    """(l,) errors of the lengths between commonly fitted centres of noise-free views."""
    radius = DIAMETER_MM / 2 + calibration.radius_offset_mm
    centres = {}
    for name in volume.spheres:
        shots: list[SphereShot] = [shot for shot in exact.shots if shot.sphere == name]
        points = np.concatenate([calibration.points_in_base_mm(s.points_in_camera_mm, joints_rad=s.joints_rad) for s in shots])
        centres[name], _ = fit_fixed_radius(points, radius, np.array(volume.cell.spheres[name].centre_in_base_mm))
    ends = [length.between for length in volume.cell.lengths]
    return np.array([np.linalg.norm(centres[a] - centres[b]) for a, b in ends]) - true_mm
