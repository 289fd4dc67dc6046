"""What the camera makes of true points: systematic error, then noise.

`measured_points` maps true points in the camera frame to the points that a noise-free camera would deliver. Noise acts
along the ray afterwards. Not modelled: noise that is alike in neighbouring pixels, quantisation, lens distortion.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.kinematics.se3 import FloatArray
from drivers.simulated.truth import CameraErrorTruth, CameraTruth, FieldTruth, NoError, PillowTruth, StereoTruth

_PILLOW_TOLERANCE_MM = 1e-9
_PILLOW_LIMIT = 0.1
_PILLOW_PASSES = 60


def measured_points(error: CameraErrorTruth, points_in_camera_mm: ArrayLike) -> FloatArray:
    """Points (n, 3) as measured without noise, of true points (n, 3), both in the camera frame."""
    points = np.asarray(points_in_camera_mm, dtype=np.float64)
    match error:
        case NoError():
            return points.copy()
        case PillowTruth():
            return _pillow(error, points)
        case FieldTruth():
            return _field(error, points)
        case StereoTruth():
            return _stereo(error, points)


def pillow_depth_error(error: PillowTruth, x_mm: FloatArray, z_mm: FloatArray) -> FloatArray:
    """The paper's eq. 5 at measured x and z: sum_l k_l (z - z_s) r^(2l), r² = (x - x_s)² + (z - z_s)²."""
    dz = z_mm - error.sight_crossing_mm[2]
    r2 = (x_mm - error.sight_crossing_mm[0]) ** 2 + dz * dz
    total = dz * 0.0
    for k in reversed(error.k):  # Horner
        total = (total + k) * r2
    return dz * total


def range_sigma_mm(camera: CameraTruth, range_mm: ArrayLike) -> FloatArray:
    """Standard deviation along the ray at ranges (n,)."""
    ratio = np.asarray(range_mm, dtype=np.float64) / camera.range_noise_at_mm
    return np.asarray(camera.range_noise_mm * ratio**camera.range_noise_growth)


def noisy_points(camera: CameraTruth, points_in_camera_mm: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Points (n, 3) moved along their rays from the camera's origin by range noise."""
    if camera.range_noise_mm == 0.0:
        return points_in_camera_mm
    range_mm = np.sqrt(np.einsum("ij,ij->i", points_in_camera_mm, points_in_camera_mm))
    shift = range_sigma_mm(camera, range_mm) * rng.standard_normal(len(range_mm))
    return np.asarray(points_in_camera_mm * (1.0 + shift / range_mm)[:, None])


def seen_under_incidence(camera: CameraTruth, cos_incidence: FloatArray, rng: np.random.Generator | None) -> NDArray[np.bool_]:
    """Which rays (n,) come back: none beyond the limit, ever fewer over the softness below it.

    Without a generator the limit is sharp, in the middle of the soft zone.
    """
    limit, softness = camera.incidence_limit_deg, camera.incidence_softness_deg
    if rng is None or softness == 0.0:
        return np.asarray(cos_incidence > np.cos(np.radians(limit - softness / 2)))
    keep = np.asarray(cos_incidence > np.cos(np.radians(limit - softness)))
    doubtful = np.flatnonzero(~keep & (cos_incidence > np.cos(np.radians(limit))))
    angle_deg = np.degrees(np.arccos(cos_incidence[doubtful]))
    keep[doubtful] = rng.random(len(doubtful)) < (limit - angle_deg) / softness
    return keep


def _pillow(error: PillowTruth, points: FloatArray) -> FloatArray:
    result = points.copy()
    # the error is a function of the measured point: solve z = z_true + e(x, z); e changes by percents of z at most
    for _ in range(_PILLOW_PASSES):
        shift = pillow_depth_error(error, result[:, 0], result[:, 2])
        # far outside the working range the powers run away: no point is measured there
        z = points[:, 2] + np.where(np.abs(shift) < _PILLOW_LIMIT * points[:, 2], shift, np.nan)
        change = np.abs(z - result[:, 2]).max(initial=0.0, where=np.isfinite(z))
        result[:, 2] = z
        if change < _PILLOW_TOLERANCE_MM:
            break
    return result


def _field(error: FieldTruth, points: FloatArray) -> FloatArray:
    x, y, z = points.T
    wave = 2 * np.pi / error.wavelength_mm
    bowl = error.bowl_mm * (x * x + y * y) / error.half_width_mm**2
    result = points.copy()
    result[:, 2] += bowl + error.ripple_mm * np.cos(wave * x) * np.cos(wave * z)
    return result


def _stereo(error: StereoTruth, points: FloatArray) -> FloatArray:
    """Project with the real geometry, triangulate with the assumed one: camera ray and projector plane."""
    column = _projector_column(error, points)
    image = points[:, :2] / points[:, 2:] * (error.focal_px + error.focal_error_px) + error.principal_error_px
    ray = np.column_stack([image / error.focal_px, np.ones(len(points))])
    cos, sin = np.cos(error.toe_in_rad), np.sin(error.toe_in_rad)
    # plane through the projector: normal in the projector is (1, 0, -column), its axes are (cos, 0, sin), (-sin, 0, cos)
    normal_x, normal_z = cos + column * sin, sin - column * cos
    depth = normal_x * error.baseline_mm / (normal_x * ray[:, 0] + normal_z)
    return np.asarray(ray * depth[:, None])


def _projector_column(error: StereoTruth, points: FloatArray) -> FloatArray:
    """Column over focal length, as the software believes it, that really lights each point."""
    toe_in = error.toe_in_rad + error.toe_in_error_rad
    cos, sin = np.cos(toe_in), np.sin(toe_in)
    x, z = points[:, 0] - (error.baseline_mm + error.baseline_error_mm), points[:, 2]
    tangent = (cos * x + sin * z) / (cos * z - sin * x)
    pixel = (error.projector_focal_px + error.projector_focal_error_px) * tangent + error.projector_principal_error_px
    return np.asarray(pixel / error.projector_focal_px)
