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
from calibrate.robot_terms import compliance_terms, load_basis
from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

Degrees = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Mismatch:
    """Standard deviations of what is left unmodelled; zero switches a part off.

    By total degree in x, y, z of each Legendre term over the camera's view. The sizes are those of a stereo camera whose
    software is off by 0.3 pixels of 1200; a term counts only where the camera model has none like it.
    """

    depth_mm: tuple[float, ...] = (0.1, 0.05, 0.03, 0.004)
    """Along the optical axis, degrees 1, 2, ..."""
    lateral_mm: tuple[float, ...] = (0.03, 0.015, 0.004)
    """Along x and along y."""
    deflection_rad: float = 1e-4
    """Of every axis under gravity at full stretch, for each term of `calibrate.robot_terms`."""


@dataclass(frozen=True, slots=True)
class CameraDisturbance:
    """Unmodelled displacements of measured points: Legendre terms that nobody fits."""

    field: PolynomialError
    """Its box and degrees; x, y, z all take terms up to the same degree."""
    columns: tuple[int, ...]
    """Terms of the field that count."""
    size_mm: tuple[float, ...]
    """Of each of them."""

    def shares(self, points_in_camera_mm: FloatArray, unit: FloatArray) -> FloatArray:
        """(..., c) motion of points (..., 3) along their normals `unit` (..., 3), one standard deviation of each term."""
        chosen = np.array(self.columns, dtype=np.intp)
        basis = self.field.basis(points_in_camera_mm.reshape(-1, 3))[:, chosen].reshape(*unit.shape[:-1], len(chosen))
        return np.asarray(basis * unit[..., self.field.axis[chosen]] * np.array(self.size_mm))


def camera_disturbance(mismatch: Mismatch, box_in_camera_mm: FloatArray, camera_error: CameraError) -> CameraDisturbance:
    """What the camera may do that `camera_error` does not hold, over a box (2, 3) of its frame."""
    centre, half = box_in_camera_mm.mean(axis=0), np.ptp(box_in_camera_mm, axis=0) / 2
    field = PolynomialError(_triple(centre), _triple(half), len(mismatch.depth_mm), len(mismatch.lateral_mm))
    modelled = set(camera_error.terms) if isinstance(camera_error, PolynomialError) else set()
    counted = [
        (column, size)
        for column, (axis, degrees) in enumerate(field.terms)
        if (axis, degrees) not in modelled and (size := (mismatch.depth_mm if axis == 2 else mismatch.lateral_mm)[sum(degrees) - 1]) > 0
    ]
    return CameraDisturbance(field, tuple(column for column, _ in counted), tuple(size for _, size in counted))


def deflection_columns(mismatch: Mismatch, model: RobotModel, joints_rad: FloatArray, points_in_base_mm: FloatArray) -> FloatArray:
    """(m, 3, K) motion in the base of points (m, 3) carried by the flange: one standard deviation of each deflection term."""
    terms = compliance_terms(model)
    load, frames = load_basis(terms, model, joints_rad), mdh.chain(model, joints_rad)
    turns = np.stack([twist_columns(frames[:, i + 1], points_in_base_mm)[..., 5] for i in range(model.n_joints)], axis=-1)
    return np.asarray(mismatch.deflection_rad * turns @ load)


def _triple(values: FloatArray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
