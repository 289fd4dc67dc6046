"""What a calibration keeps of its shots and says of its solve."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from drivers.kinematics.se3 import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ShotResult:
    """One shot that the calibration was made from."""

    session: str
    index: int
    sphere: str
    scan_sha256: str
    n_points: int
    point_rms_mm: float
    """Radial rms with the shot's own pose noise taken out."""
    radial_rms_mm: float
    """Radial rms as it is."""
    centre_in_camera_mm: FloatArray
    """(3,) where the sphere was in the camera frame."""
    centre_in_base_mm: FloatArray | None
    """(3,) fixed-radius centre of this shot alone, calibrated; None for a line profile."""
    predicted_error_mm: float | None
    """Distance of the centre from where a solve without this shot expects it (line profiles: radial rms)."""
    joints_rad: FloatArray | None = None
    """(n,) where the robot stood, so that a verification can tell its own poses; None in pose-only and older files."""
    base_from_flange: FloatArray | None = None
    """(4, 4) of a pose-only calibration; None elsewhere and in older files."""


@dataclass(frozen=True, slots=True)
class Statistics:
    """What a solve says of itself."""

    n_shots: int
    used: int
    rank: int
    n_parameters: int
    condition: float
    train_rms_mm: float
    cross_validated_rms_mm: float
    predicted_centre_rms_mm: float | None
    """First-order prediction of `cross_validated_rms_mm`, from the covariance and the noise alone."""
    covariance_scale: float
    """What the covariance was multiplied by so that it explains the held-out shots."""
    passes: int
    seconds: float
    compared: Mapping[str, float] = field(default_factory=dict)
    """Held-out rms of every camera error model that was tried, mm."""
