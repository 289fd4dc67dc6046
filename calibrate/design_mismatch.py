"""Physics that the models leave out, as further columns of the problem: what it may do to a calibration.

A solve does not know of them, so they do not add to its unknowns: they push the unknowns by the solve's own gain, and
what that does to a length in the work volume is the part of its error that more shots do not take away. Each has a
standard deviation of physical size (below), so that the result is a figure in mm and not a warning. (Schmidt's consider
parameters, as `calibrate.robot_terms` has them for a solve that is done.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.camera_error import CameraError, PolynomialError
from calibrate.datum import twist_columns
from calibrate.problem import Priors
from calibrate.robot_terms import arm_terms, load_basis
from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_ONCE = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


@dataclass(frozen=True, slots=True)
class Physics:
    """How large a cell's errors really are, as standard deviations: what is modelled (a solve's priors are wider), and what is not.

    The camera's are by total degree in x, y, z of each Legendre term over its view, those of a stereo camera whose software is
    off by 0.3 pixels of 1200. A term that the camera model holds is a wrong guess of its prior, any other is unmodelled.
    """

    link_mm: float = 0.3
    link_rad: float = 7e-4
    radius_offset_mm: float = 0.04
    depth_mm: tuple[float, ...] = (0.12, 0.04, 0.02, 0.004)
    """Along the optical axis, degrees 1, 2, ..."""
    lateral_mm: tuple[float, ...] = (0.05, 0.04, 0.005)
    """Along x and along y."""
    camera_scale: float = 4e-4
    """The camera measures everything too large by this (baseline, focal length): without a certified length nothing else tells."""

    def camera_mm(self, axis: int, degree: int) -> float:
        """Of one Legendre term; zero beyond the degrees that are listed."""
        sizes = self.depth_mm if axis == 2 else self.lateral_mm
        return sizes[degree - 1] if degree <= len(sizes) else 0.0


@dataclass(frozen=True, slots=True)
class CameraDisturbance:
    """Unmodelled displacements of measured points: Legendre terms that nobody fits."""

    field: PolynomialError
    """Its box and degrees; x, y, z all take terms up to the same degree."""
    columns: tuple[int, ...]
    """Terms of the field that count."""
    size_mm: tuple[float, ...]
    """Of each of them."""
    scale: float
    """Of everything about the middle of the view, one more column; zero where the camera model holds it."""

    def shares(self, points_in_camera_mm: FloatArray, unit: FloatArray) -> FloatArray:
        """(..., c) motion of points (..., 3) along their normals `unit` (..., 3), one standard deviation of each term."""
        chosen = np.array(self.columns, dtype=np.intp)
        basis = self.field.basis(points_in_camera_mm.reshape(-1, 3))[:, chosen].reshape(*unit.shape[:-1], len(chosen))
        terms = basis * unit[..., self.field.axis[chosen]] * np.array(self.size_mm)
        scaled = ((points_in_camera_mm - np.array(self.field.centre_mm)) * unit).sum(axis=-1, keepdims=True) * self.scale
        return np.concatenate([terms, scaled], axis=-1)

    @property
    def n_columns(self) -> int:
        """Columns of `shares`."""
        return len(self.columns) + 1


def camera_disturbance(physics: Physics, box_in_camera_mm: FloatArray, camera_error: CameraError) -> CameraDisturbance:
    """What the camera may do that `camera_error` does not hold, over a box (2, 3) of its frame."""
    centre, half = box_in_camera_mm.mean(axis=0), np.ptp(box_in_camera_mm, axis=0) / 2
    field = PolynomialError(_triple(centre), _triple(half), len(physics.depth_mm), len(physics.lateral_mm))
    modelled = set(camera_error.terms) if isinstance(camera_error, PolynomialError) else set()
    counted = [
        (column, size)
        for column, (axis, degrees) in enumerate(field.terms)
        if (axis, degrees) not in modelled and (size := physics.camera_mm(axis, sum(degrees))) > 0
    ]
    scale = 0.0 if _holds_scale(camera_error) else physics.camera_scale
    return CameraDisturbance(field, tuple(column for column, _ in counted), tuple(size for _, size in counted), scale)


def modelled_covariance_mm2(physics: Physics, camera_error: CameraError) -> FloatArray:
    """(k, k) of how large the coefficients of a camera model really are; a pillow's are as large as its prior says."""
    prior = camera_error.prior_sigma_mm
    if not isinstance(camera_error, PolynomialError):
        return np.diag(prior**2)
    single = np.minimum([physics.camera_mm(axis, sum(degrees)) for axis, degrees in camera_error.terms], prior)
    if not _holds_scale(camera_error):
        return np.diag(single**2)
    along = [camera_error.half_size_mm[axis] if degrees == _ONCE[axis] else 0.0 for axis, degrees in camera_error.terms]
    return np.asarray(np.diag(single**2) + physics.camera_scale**2 * np.outer(along, along))


def deflection_columns(priors: Priors, model: RobotModel, joints_rad: FloatArray, points_in_base_mm: FloatArray) -> FloatArray:
    """(m, 3, K) motion in the base of points (m, 3) carried by the flange: one standard deviation of each term of the arm."""
    terms = arm_terms(model)
    load, frames = load_basis(terms, model, joints_rad), mdh.chain(model, joints_rad)
    turns = np.stack([twist_columns(frames[:, i + 1], points_in_base_mm)[..., 5] for i in range(model.n_joints)], axis=-1)
    return np.asarray(turns @ load * priors.term_sigma_rad(terms))


def _holds_scale(camera_error: CameraError) -> bool:
    return isinstance(camera_error, PolynomialError) and {(axis, _ONCE[axis]) for axis in range(3)} <= set(camera_error.terms)


def _triple(values: FloatArray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
