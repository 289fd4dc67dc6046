"""A few shots of spheres that stand where the calibration saw them: what is left of their centres, and what that ought to be.

Residual of shot j: its own fixed-radius centre through the calibration, less the centre of its sphere in the calibration.
If nothing changed, the residuals of all shots together are normal about zero with covariance `S C S' + points + pose`: C
the calibration's own (centres and what no model holds included; robot errors that the centres share cancel in it), S the
motion of the residuals per unknown, and the noise of points and poses that the calibration found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrate.observations import SphereShot
from calibrate.problem import Geometry, Problem, State, linearise_geometry
from calibrate.result import Calibration
from calibrate.robot_terms import load_basis
from calibrate.sums import shot_sums
from calibrate.validation import shot_centres_in_base_mm
from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

_SMALLEST_RADIUS_SIGMA_MM = 1e-5
_LEAST_FREEDOM = 5
SAME_POSE_RAD = 0.01
"""Axis angles nearer than this on every axis are the same pose, planned once and driven to again."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckResiduals:
    """What m shots say about a calibration; axes of the solver's base, shot after shot."""

    problem: Problem
    geometry: Geometry
    residual_mm: FloatArray
    """(m, 3) own centre less the calibration's."""
    covariance_mm2: FloatArray
    """(3 m, 3 m) of the residuals where nothing changed."""
    sensitivity: FloatArray
    """(m, 3, P) motion of a residual per unknown of the calibration."""
    noise_freedom: float
    """Degrees of freedom that the calibration's noise was estimated with: few make the tails of every test heavier."""

    @property
    def n_shots(self) -> int:
        """Number of shots m."""
        return len(self.residual_mm)

    @property
    def rms_mm(self) -> float:
        """Root of the mean squared distance of the shots' centres from where the calibration has them."""
        return float(np.sqrt((self.residual_mm**2).sum(axis=1).mean()))

    @property
    def expected_rms_mm(self) -> float:
        """What `rms_mm` is on average where nothing changed."""
        return float(np.sqrt(np.trace(self.covariance_mm2) / self.n_shots))


def known_system(calibration: Calibration, shots: Sequence[SphereShot]) -> tuple[Problem, State]:
    """Shots of a calibration's own spheres as a problem whose unknowns are those of the calibration, and its state.

    Raises:
        DataError: a sphere that the calibration has not seen; line profiles, which have no centre of their own.
    """
    names = tuple(calibration.sphere_centres_in_base_mm)
    unknown = sorted({shot.sphere for shot in shots} - set(names))
    if unknown:
        raise DataError(
            f"the calibration has not seen sphere {unknown[0]}, so that nothing is known of where it stood",
            remedy=f"Check on spheres that still stand as they were calibrated: {', '.join(names) or 'none'}.",
        )
    if any(shot.centre_in_camera_mm is None for shot in shots):
        raise DataError("a line profile shows no centre of its own", remedy="Verify with `spherecal verify` instead.")
    radius = dict.fromkeys(names, 1.0) | {shot.sphere: shot.radius_mm for shot in shots}
    sizes = [len(shot.points_in_camera_mm) for shot in shots]
    model = calibration.model
    joints = None if model is None else np.array([shot.joints_rad for shot in shots], dtype=np.float64)
    scans = {key: i for i, key in enumerate(dict.fromkeys((shot.session, shot.scan_sha256) for shot in shots))}
    problem = Problem(
        model=model,
        joints_rad=joints,
        base_from_flange=np.array([shot.base_from_flange for shot in shots]),
        scan=np.array([scans[shot.session, shot.scan_sha256] for shot in shots], dtype=np.int64),
        sphere=np.array([names.index(shot.sphere) for shot in shots], dtype=np.int64),
        points_in_camera_mm=np.concatenate([shot.points_in_camera_mm for shot in shots]),
        starts=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        camera_error=calibration.camera_error,
        radius_mm=np.array([radius[name] for name in names]),
        radius_sigma_mm=np.full(len(names), _SMALLEST_RADIUS_SIGMA_MM),
        terms=calibration.terms,
        load=np.zeros((len(shots), 0, 0)) if model is None or joints is None else load_basis(calibration.terms, model, joints),
    )
    return problem, known_state(calibration, problem.n_scans)


def known_state(calibration: Calibration, n_scans: int) -> State:
    """A calibration's values of all unknowns, no pose noise, in the solver's base."""
    solver_from_base = se3.inverse(calibration.datum.base_from_solver)
    centres = np.array(list(calibration.sphere_centres_in_base_mm.values())).reshape(-1, 3)
    offsets = np.array(list(calibration.sphere_radius_offsets_mm.values()))
    return State(
        link_twists=calibration.link_twists,
        flange_from_camera=calibration.flange_from_camera,
        camera_mm=calibration.camera_mm,
        terms_rad=calibration.terms_rad,
        radius_offset_mm=calibration.radius_offset_mm,
        sphere_radius_deviation_mm=offsets - calibration.radius_offset_mm,
        centres_in_base_mm=se3.apply(solver_from_base, centres),
        pose_noise=np.zeros((n_scans, 6)),
    )


def check_residuals(calibration: Calibration, shots: Sequence[SphereShot]) -> CheckResiduals:
    """Residuals of shots (at least one) of a calibration's own spheres, with their covariance; raises as `known_system`."""
    problem, state = known_system(calibration, shots)
    geometry = linearise_geometry(problem, state)
    sums = shot_sums(problem, state, geometry, calibration.noise)
    centres = shot_centres_in_base_mm(problem, state, geometry)
    residual = centres - state.centres_in_base_mm[problem.sphere]
    inverse = np.linalg.inv(sums.moments[:, :3, :3])
    rotation = geometry.base_from_camera[:, :3, :3]
    sensitivity = rotation @ (inverse @ (sums.moments[:, :3, :-1] @ geometry.columns))
    points = rotation @ (inverse / sums.weight(calibration.noise)[:, None, None]) @ np.swapaxes(rotation, -1, -2)
    covariance = null_covariance_mm2(calibration, problem, geometry, sensitivity, points)
    statistics = calibration.statistics
    freedom = float(max(3 * statistics.used - statistics.rank, _LEAST_FREEDOM))
    return CheckResiduals(problem, geometry, residual, covariance, sensitivity, freedom)


def changes_since(calibration: Calibration, earlier: Sequence[SphereShot], shots: Sequence[SphereShot]) -> CheckResiduals | None:
    """Residuals of shots less those of earlier shots of the same spheres from the same poses; None where no two match.

    What the calibration leaves at a pose is in both and drops out, its covariance with it: little more than pose noise
    remains, so that smaller changes show, and an uncertainty that the calibration claims too small raises no alarm.
    """
    matched = [(old, new) for new in shots for old in _same_view(new, earlier)[:1]]
    if not matched:
        return None
    now = [new for _, new in matched]
    both = check_residuals(calibration, [old for old, _ in matched] + now)
    m = len(matched)
    less = np.concatenate([-np.eye(3 * m), np.eye(3 * m)], axis=1)
    covariance = less @ both.covariance_mm2 @ less.T
    residual = both.residual_mm[m:] - both.residual_mm[:m]
    return replace(check_residuals(calibration, now), residual_mm=residual, covariance_mm2=np.asarray((covariance + covariance.T) / 2))


def _same_view(shot: SphereShot, earlier: Sequence[SphereShot]) -> list[SphereShot]:
    """Earlier shots of its sphere from its pose, the nearest first."""
    if shot.joints_rad is None:
        return []
    off = [
        (float(np.abs(old.joints_rad - shot.joints_rad).max()), old.key, old)
        for old in earlier
        if old.sphere == shot.sphere and old.joints_rad is not None
    ]
    return [old for distance, _, old in sorted(off, key=lambda found: found[:2]) if distance < SAME_POSE_RAD]


def null_covariance_mm2(
    calibration: Calibration, problem: Problem, geometry: Geometry, sensitivity: FloatArray, points_mm2: FloatArray
) -> FloatArray:
    """(3 m, 3 m) of residuals where nothing changed.

    Args:
        calibration: whose covariance and noise count.
        problem: m shots.
        geometry: of the shots.
        sensitivity: (m, 3, P) motion of a residual per unknown.
        points_mm2: (m, 3, 3) by the noise of points.
    """
    m = problem.n_shots
    flat = sensitivity.reshape(3 * m, -1)
    size = flat.shape[1]
    # external reference points come last and move no sphere
    covariance = flat @ calibration.covariance[:size, :size] @ flat.T
    rotation = geometry.base_from_camera[:, :3, :3]
    noise = (rotation @ geometry.noise_columns).reshape(3 * m, 6)
    same_scan = np.kron(problem.scan[:, None] == problem.scan, np.ones((3, 3)))
    covariance += same_scan * (noise / calibration.noise.pose_precision @ noise.T)
    for i in range(m):
        covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += points_mm2[i]
    return np.asarray((covariance + covariance.T) / 2)
