"""External reference points in a verification: where the calibrated robot expects a target, against where a tracker saw it.

Error of a point: `base_from_flange(q) target - base_from_reference p`, axes of the stated base, p the measured point;
robot, frame and target as the calibration has them. All three come from one solve, so its covariance is used with all
their correlations (METHOD.md 4, *External points*); the pose noise of the stop and the noise of the tracker come on top.
The stated base is a frame to look in and cancels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calibrate.datum import link_columns, term_columns
from calibrate.external import external_sigma_mm
from calibrate.external_points import ExternalShot
from calibrate.external_result import ExternalFrame, ExternalResult
from calibrate.observations import RejectedShot
from calibrate.result import Calibration
from calibrate.robot_terms import load_basis
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.placing import MeasuringSystem

_NO_FRAMES = "external reference point: the calibration was made without any, so it does not know where the reference stands"
_FAR = 2.0
"""Rms beyond this many times the expected one is told."""


@dataclass(frozen=True, slots=True, eq=False)
class ExternalError:
    """One judged point."""

    session: str
    index: int
    reference: str
    target: str
    error_mm: FloatArray
    """(3,) predicted minus measured, axes of the stated base."""
    covariance_mm2: FloatArray
    """(3, 3) that the error should have: calibration, pose noise, tracker."""

    @property
    def distance_mm(self) -> float:
        """Length of the error."""
        return float(np.linalg.norm(self.error_mm))

    @property
    def expanded_uncertainty_mm(self) -> FloatArray:
        """(3,) of each component, k = 2."""
        return np.asarray(2.0 * np.sqrt(np.diag(self.covariance_mm2)))


@dataclass(frozen=True, slots=True)
class ExternalFigures:
    """All judged points, at least one."""

    points: tuple[ExternalError, ...]

    @property
    def rms_mm(self) -> float:
        """Root mean square distance."""
        return float(np.sqrt(np.mean([point.distance_mm**2 for point in self.points])))

    @property
    def expected_rms_mm(self) -> float:
        """What the calibration's own uncertainties make of it."""
        return float(np.sqrt(np.mean([np.trace(point.covariance_mm2) for point in self.points])))

    @property
    def max_mm(self) -> float:
        """Largest distance."""
        return max(point.distance_mm for point in self.points)

    def warnings(self) -> tuple[str, ...]:
        """What a reader must know of them."""
        if self.rms_mm <= _FAR * self.expected_rms_mm:
            return ()
        return (
            f"external points lie {self.rms_mm:.3f} mm rms from where the robot is expected, {self.expected_rms_mm:.3f} mm would be its own "
            "uncertainty: the reference or the target was moved, or the robot changed",
        )

    def to_json_dict(self, session_name: Callable[[str], str]) -> dict[str, object]:
        """Figures and every point, sessions by the names that a function gives their digests."""
        return {
            "n_points": len(self.points),
            "rms_mm": self.rms_mm,
            "expected_rms_mm": self.expected_rms_mm,
            "max_mm": self.max_mm,
            "points": [
                {
                    "session": session_name(point.session),
                    "index": point.index,
                    "reference": point.reference,
                    "target": point.target,
                    "error_mm": point.error_mm.tolist(),
                    "expanded_uncertainty_mm": point.expanded_uncertainty_mm.tolist(),
                    "distance_mm": point.distance_mm,
                }
                for point in self.points
            ],
        }


def known_external(calibration: MeasuringSystem) -> ExternalResult | None:
    """Frames, targets and points that a calibration of the whole robot was made from; None where there were none."""
    return calibration.external if isinstance(calibration, Calibration) and calibration.model is not None else None


def judgeable(calibration: MeasuringSystem, shots: Sequence[ExternalShot]) -> tuple[tuple[ExternalShot, ...], tuple[RejectedShot, ...]]:
    """The points whose target this calibration knows, and the others with a reason."""
    reasons = [_why_not(calibration, shot) for shot in shots]
    rejected = [RejectedShot(shot.session, shot.index, why) for shot, why in zip(shots, reasons, strict=True) if why is not None]
    return tuple(shot for shot, why in zip(shots, reasons, strict=True) if why is None), tuple(rejected)


def _why_not(calibration: MeasuringSystem, shot: ExternalShot) -> str | None:
    known = known_external(calibration)
    if known is None:
        return _NO_FRAMES
    if shot.target not in known.targets:
        return f"external reference point: the calibration does not know target {shot.target} (it knows {', '.join(known.targets)})"
    return None


def external_figures(calibration: MeasuringSystem, shots: Sequence[ExternalShot]) -> ExternalFigures | None:
    """Errors of the points whose reference and target a calibration knows; None of none."""
    known = known_external(calibration)
    if known is None or not isinstance(calibration, Calibration):
        return None
    placed = [shot for shot in shots if shot.target in known.targets and shot.reference in known.references]
    return ExternalFigures(tuple(_error(calibration, known.references[shot.reference], shot) for shot in placed)) if placed else None


@dataclass(frozen=True, slots=True, eq=False)
class PlacedTarget:
    """Where a calibration expects a target at a stop."""

    seen_mm: FloatArray
    """(3,) in the stated base."""
    lever_mm: FloatArray
    """(3,) from the flange's origin."""
    motion: FloatArray
    """(3, P) of it per unknown of the calibration."""


def placed_target(calibration: Calibration, shot: ExternalShot) -> PlacedTarget:
    """The target of a shot that is `judgeable`."""
    known = known_external(calibration)
    if known is None or calibration.model is None:
        raise ValueError("not a judgeable point")
    frames = calibration.base_from_links(shot.joints_rad)[None]
    flange = frames[0, -1]
    seen = se3.apply(flange, known.targets[shot.target].point_in_flange_mm)
    load = load_basis(calibration.terms, calibration.model, shot.joints_rad[None])
    blocks = {
        "link1.rho_x_mm": link_columns(calibration.link_twists, frames, seen[None])[0],
        f"target.{shot.target}.x_mm": flange[:3, :3],
    }
    if calibration.terms:
        blocks[f"{calibration.terms[0].name}_rad"] = term_columns(calibration.link_twists, frames, load, seen[None])[0]
    motion = np.zeros((3, len(calibration.parameter_names)))
    for first, block in blocks.items():
        at = calibration.parameter_names.index(first)
        motion[:, at : at + block.shape[1]] += block
    return PlacedTarget(seen, seen - flange[:3, 3], motion)


def _error(calibration: Calibration, frame: ExternalFrame, shot: ExternalShot) -> ExternalError:
    placed = placed_target(calibration, shot)
    told = se3.apply(frame.base_from_reference, shot.point_in_reference_mm)
    jacobian = placed.motion.copy()
    at = calibration.parameter_names.index(f"reference.{shot.reference}.rho_x_mm")
    jacobian[:, at : at + 6] = _frame_columns(calibration, told)
    covariance = jacobian @ calibration.covariance @ jacobian.T + noise_mm2(calibration, placed.lever_mm)
    return ExternalError(shot.session, shot.index, shot.reference, shot.target, placed.seen_mm - told, covariance)


def _frame_columns(calibration: Calibration, told_mm: FloatArray) -> FloatArray:
    """(3, 6) motion of the error, stated axes, by a left twist of the frame in the solver's base."""
    base_from_solver = calibration.datum.base_from_solver
    in_solver = se3.apply(se3.inverse(base_from_solver), told_mm)
    return np.asarray(base_from_solver[:3, :3] @ np.concatenate([-np.eye(3), se3.hat(in_solver)], axis=1))


def noise_mm2(calibration: Calibration, lever_mm: FloatArray) -> FloatArray:
    """(3, 3) of the stop's pose noise at a lever (3,) from the flange, and of the tracker."""
    noise, lever = calibration.noise, se3.hat(lever_mm)
    alike = noise.pose_mm**2 + external_sigma_mm(noise) ** 2
    return np.asarray(alike * np.eye(3) + noise.pose_rad**2 * lever @ lever.T)
