"""What sphere finding takes and gives: settings, findings, and the refusal with its reason."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DataError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

Reason = Literal[
    "no_points",
    "unit_metres",
    "too_few_points",
    "no_sphere",
    "mirror",
    "ambiguous",
    "far_from_prediction",
    "incidence",
    "coverage",
    "radius",
    "residual",
    "not_a_profile",
    "no_arc",
]
"""Why a sphere or an arc was refused."""


class SphereNotFound(DataError):
    """A scan in which the sphere cannot be found, or not well enough to be used."""

    def __init__(self, reason: Reason, message: str, *, remedy: str) -> None:
        super().__init__(message, remedy=remedy)
        self.reason: Reason = reason


@dataclass(frozen=True, slots=True)
class SphereSettings:
    """Gates and sizes of the search. Wide on purpose: the calibration's own statistics judge shots more finely."""

    seed: int = 20230830
    search_radius_mm: float = 60.0
    """How far from the predicted centre the true one may be."""
    min_points: int = 40
    max_incidence_rad: float = 1.0472
    """Points seen more grazing than this (60 degrees) are dropped: that is where triangulation goes wrong."""
    min_cap_half_angle_rad: float = 0.35
    min_azimuth_coverage: float = 0.4
    """Share of the directions round the line of sight in which the cap has points."""
    max_radius_error_mm: float = 1.0
    max_radius_error_share: float = 0.05
    """The free radius may be off by `max_radius_error_mm + share * radius`, and by five sigmas of its noise."""
    max_rms_mm: float = 0.6
    max_rms_share: float = 0.06
    """The residual rms may be the smaller of `max_rms_mm` and `share * radius`."""
    min_visible_share: float = 0.25
    """Of the points seen where the cap should be, the share that lies on it."""
    gate_sigmas: float = 4.0
    ambiguity_share: float = 0.5
    """Without a prediction: a second sphere with more than this share of the best one's support is a refusal."""
    furthest_mm: float = 10_000.0
    max_arc_angle_rad: float = 1.2217
    """Line profiles: points of the arc whose normal leans further from the line of sight (70 degrees) are dropped."""
    min_arc_angle_rad: float = 0.35
    """Line profiles: an arc that turns through less than this fixes no circle."""
    min_arc_radius_share: float = 0.15
    """Line profiles: cuts smaller than this share of the sphere's radius are left alone."""


@dataclass(frozen=True, slots=True, eq=False)
class SphereFinding:
    """A sphere found in one scan, camera frame."""

    centre_in_camera_mm: FloatArray
    """(3,) fitted with the certified radius."""
    covariance_mm2: FloatArray
    """(3, 3) of the centre: noise of the points, and form error counted as if it had a dozen independent patches."""
    points_in_camera_mm: FloatArray
    """(m, 3) selected points on the sphere, none grazing, in the order of the scan."""
    indices: IntArray
    """(m,) their rows in the flattened scan."""
    rms_mm: float
    """Radial residual of the selected points from the sphere of certified radius."""
    noise_mm: float
    """The part of it that changes from point to point (robust sigma about a smooth form)."""
    free_radius_mm: float
    """Radius of the best free fit: a diagnostic only."""
    cap_half_angle_rad: float
    azimuth_coverage: float
    """Share of the directions round the line of sight in which there are points, 0..1."""
    visible_share: float
    """Of the points seen where the cap should be, the share that lies on it, 0..1."""
    runner_up: float
    """Support of the next best sphere in the frame, as a share of this one's; 0 where there is none."""

    @property
    def n_points(self) -> int:
        """Number of selected points."""
        return len(self.indices)

    @property
    def centre_sigma_mm(self) -> float:
        """Standard uncertainty of the centre in its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance_mm2)[-1]))


@dataclass(frozen=True, slots=True, eq=False)
class ArcFinding:
    """An arc of the sphere found in one line profile (plane y = const of the camera frame)."""

    points_in_camera_mm: FloatArray
    """(m, 3) selected points on the arc, in the order of the scan."""
    indices: IntArray
    """(m,) their rows in the flattened scan."""
    rms_mm: float
    """Residual of the selected points from the fitted circle, in the plane."""
    arc_radius_mm: float
    arc_centre_in_camera_mm: FloatArray
    """(3,) centre of the circle. The sphere's centre is `side_offset_mm` away from it along y, to an unknown side."""
    side_offset_mm: float
    """sqrt(R² - r²), 0 where the circle came out as large as the sphere."""
    arc_angle_rad: float
    """How far the arc turns."""

    @property
    def n_points(self) -> int:
        """Number of selected points."""
        return len(self.indices)
