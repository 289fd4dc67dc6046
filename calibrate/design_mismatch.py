"""Physics that no model of ours describes, as further columns of the problem: what it may do to a calibration.

A solve does not know of them, so they do not add to its unknowns: they push the unknowns by the solve's own gain, and
what they do to a length in the work volume is the part of its error that more shots do not take away. Each has a
standard deviation of physical size (below), so that the result is a figure in mm and not a warning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.camera_error import CameraError, PolynomialError
from calibrate.datum import twist_columns
from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray


@dataclass(frozen=True, slots=True)
class Mismatch:
    """Standard deviations of what is left unmodelled; zero switches a part off.

    The defaults are those of a mid-size arm (METHOD.md 4: droop 0.15 mrad) and of a stereo camera whose lateral scale is
    good to 0.3 pixels of 1200. They were held against simulated cells (`tests/qualify/test_design.py`).
    """

    droop_rad: float = 1e-4
    """Deflection of each axis under gravity with the flange stretched out horizontally from it."""
    camera_lateral_mm: float = 0.02
    """Lateral error of the camera at the edge of its view, per Legendre term of degree 1 and 2."""
    camera_depth_mm: float = 0.005
    """Depth error beyond a cubic field, per Legendre term of degree 4."""
    camera_smooth_mm: float = 0.1
    """Depth error of low degree (1 to 3, divided by it) where the camera model is no field."""


@dataclass(frozen=True, slots=True)
class CameraDisturbance:
    """Unmodelled displacements of measured points, in the form of a camera error model whose coefficients nobody fits."""

    fields: tuple[tuple[PolynomialError, int, int, float], ...]
    """Polynomial field, camera axis that it moves points along, lowest degree counted, size in mm (divided by the degree)."""

    @property
    def size(self) -> int:
        """Number of terms."""
        return sum(len(_counted(field, lowest)) for field, _, lowest, _ in self.fields)

    def shares(self, points_in_camera_mm: FloatArray, unit: FloatArray) -> FloatArray:
        """(..., size) motion of points (..., 3) along their normals `unit` (..., 3), one standard deviation of each term."""
        blocks = [
            field.basis(points_in_camera_mm.reshape(-1, 3)).reshape(*unit.shape[:-1], -1)[..., _counted(field, lowest)]
            * (unit[..., axis, None] * size_mm / _degrees(field)[_counted(field, lowest)])
            for field, axis, lowest, size_mm in self.fields
        ]
        return np.concatenate(blocks, axis=-1) if blocks else np.zeros((*unit.shape[:-1], 0))


def camera_disturbance(mismatch: Mismatch, field: PolynomialError, camera_error: CameraError) -> CameraDisturbance:
    """What the camera may do that `camera_error` does not hold, on the box of a field."""
    quadratic = PolynomialError(field.centre_mm, field.half_size_mm, 2)
    parts = [(quadratic, axis, 1, mismatch.camera_lateral_mm) for axis in (0, 1)]
    if camera_error.name == "field":
        quartic = PolynomialError(field.centre_mm, field.half_size_mm, 4)
        # sized as a whole term, not by its degree
        parts.append((quartic, 2, 4, 4 * mismatch.camera_depth_mm))
    else:
        parts.append((PolynomialError(field.centre_mm, field.half_size_mm, 3), 2, 1, mismatch.camera_smooth_mm))
    return CameraDisturbance(tuple(part for part in parts if part[3] > 0))


def droop_columns(mismatch: Mismatch, model: RobotModel, joints_rad: FloatArray, points_in_base_mm: FloatArray) -> FloatArray:
    """(m, 3, n) motion in the base of points (m, 3) carried by the flange: one standard deviation of each axis's droop.

    The torque of a mass at the flange about an axis, in units of that of the horizontal stretch, turns the axis.
    """
    frames = mdh.chain(model, joints_rad)
    axes, origins = frames[:, 1:, :3, 2], frames[:, 1:, :3, 3]
    torque = (axes * np.cross(origins[:, -1:] - origins, [0.0, 0.0, -1.0])).sum(axis=-1)
    lengths = np.hypot(model.a_mm, model.d_mm)
    reach = np.maximum(lengths[::-1].cumsum()[::-1] - lengths, 1.0)
    turns = np.stack([twist_columns(frames[:, i + 1], points_in_base_mm)[..., 5] for i in range(model.n_joints)], axis=-1)
    return np.asarray(mismatch.droop_rad * turns * (torque / reach)[:, None])


def _degrees(field: PolynomialError) -> FloatArray:
    return np.array([sum(t) for t in field.exponents], dtype=np.float64)


def _counted(field: PolynomialError, lowest: int) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
    return np.flatnonzero(_degrees(field) >= lowest)
