"""What a calibration's own covariance makes of the distance between two measured spheres.

A common fit of all views minimises the sum of (|W - c| - R)². To first order a change of the parameters moves its
centre by `inv(sum u u') sum u (u' dW - dR)`, u the unit vector from centre to point, dW from the calibration's point
Jacobian, dR the radius offset's error. Both ends move by the same parameters, so what moves them alike cancels here,
as it does in the distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from calibrate.observations import SphereShot
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from measure.placing import pose_of

_POINTS_PER_VIEW = 200


class KnowsItsCovariance(Protocol):
    """What this module needs of a calibration."""

    @property
    def model(self) -> RobotModel | None:
        """Nominal robot; None for a pose-only calibration."""
        ...

    @property
    def covariance(self) -> FloatArray:
        """(P, P): the p parameters of `point_jacobian` first, then the radius offset, then others."""
        ...

    def points_in_base_mm(
        self, points_in_camera_mm: ArrayLike, *, joints_rad: ArrayLike | None = None, base_from_flange: ArrayLike | None = None
    ) -> FloatArray:
        """Calibrated points (n, 3)."""
        ...

    def point_jacobian(
        self, points_in_camera_mm: ArrayLike, *, joints_rad: ArrayLike | None = None, base_from_flange: ArrayLike | None = None
    ) -> FloatArray:
        """(n, 3, p) motion of calibrated points per parameter."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class End:
    """One sphere of a length."""

    centre_in_base_mm: FloatArray
    """(3,) fitted on all views together."""
    motion: FloatArray
    """(3, p + 1) of that centre per calibration parameter and radius offset."""


def distance_standard_uncertainty_mm(calibration: KnowsItsCovariance, first: End, second: End) -> float:
    """Standard uncertainty of the distance of two sphere centres, as far as the calibration causes it."""
    difference = second.centre_in_base_mm - first.centre_in_base_mm
    direction = difference / max(float(np.linalg.norm(difference)), 1e-12)
    gradient = direction @ (second.motion - first.motion)
    used = calibration.covariance[: len(gradient), : len(gradient)]
    return float(np.sqrt(max(float(gradient @ used @ gradient), 0.0)))


def end_of(calibration: KnowsItsCovariance, centre_in_base_mm: FloatArray, shots: Sequence[SphereShot]) -> End:
    """The end of lengths that a sphere with this common centre (3,) is, seen by some shots; computed once for all its lengths."""
    return End(centre_in_base_mm, _centre_jacobian(calibration, centre_in_base_mm, shots))


def diameter_standard_uncertainty_mm(calibration: KnowsItsCovariance, centre_in_base_mm: FloatArray, shots: Sequence[SphereShot]) -> float:
    """Standard uncertainty of a sphere's diameter fitted to all views with a free radius, as far as the calibration causes it.

    The radius is a fourth unknown of the fit beside the centre (3,), and its radius offset does not come in.
    """
    gradient = 2.0 * _centre_jacobian(calibration, centre_in_base_mm, shots, free=True)[3, :-1]
    used = calibration.covariance[: len(gradient), : len(gradient)]
    return float(np.sqrt(max(float(gradient @ used @ gradient), 0.0)))


def _centre_jacobian(
    calibration: KnowsItsCovariance, centre_in_base_mm: FloatArray, shots: Sequence[SphereShot], *, free: bool = False
) -> FloatArray:
    """(3, p + 1) motion of a commonly fitted centre per calibration parameter and radius offset; (4, p + 1) with the radius where it is free."""
    size = 4 if free else 3
    normal, rows = np.zeros((size, size)), None
    for shot in shots:
        points = shot.points_in_camera_mm[:: max(1, -(-len(shot.points_in_camera_mm) // _POINTS_PER_VIEW))]
        pose = pose_of(calibration.model, shot)
        offset = calibration.points_in_base_mm(points, **pose) - centre_in_base_mm
        unit = offset / np.linalg.norm(offset, axis=1, keepdims=True)
        along = np.einsum("ni,nip->np", unit, calibration.point_jacobian(points, **pose))
        design = np.column_stack([unit, np.ones(len(unit))]) if free else unit
        share = design.T @ np.column_stack([along, -np.ones(len(unit))])
        # each view counts with all its points, as in the fit
        weight = len(shot.points_in_camera_mm) / len(points)
        normal += weight * design.T @ design
        rows = weight * share if rows is None else rows + weight * share
    if rows is None:
        return np.zeros((size, len(calibration.covariance)))
    return np.asarray(np.linalg.solve(normal, rows))
