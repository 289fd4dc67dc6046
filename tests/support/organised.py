"""Organised scans of one wavy surface from many poses, a million points each, for timings and memory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquire.session import SessionWriter
from calibrate import Calibration
from calibrate.camera_error_field import PolynomialError
from drivers.files.session import Session, read_session
from drivers.kinematics import se3
from drivers.kinematics.inverse import branches_of_many
from drivers.kinematics.se3 import FloatArray
from tests.support.recorded import nominal_calibration, record_session, write_cell
from tests.support.synthetic import paper_robot

DEPTH_MM = 400.0
SURFACE_CENTRE_MM = np.array([900.0, 0.0, 200.0])
NOISE_MM = 0.03


@dataclass(frozen=True)
class OrganisedCell:
    """A calibration with a camera field and a covariance, and poses that look at the surface."""

    calibration: Calibration
    joints_rad: FloatArray
    """(m, 6)."""
    folder: Path

    def scan(self, number: int, side: int) -> NDArray[np.float32]:
        """What the camera sees at a pose: (side, side, 3), its field's error not put in."""
        pose = self.calibration.base_from_flange(self.joints_rad[number]) @ self.calibration.flange_from_camera
        return _seen(pose, side, np.random.default_rng(number))

    def session(self, n_scans: int, side: int) -> Session:
        """The scans on disk."""
        with SessionWriter.create(self.folder / f"organised{n_scans}x{side}", purpose="workpiece", cell=write_cell(self.folder)) as writer:
            for number in range(n_scans):
                writer.append(joints_rad=self.joints_rad[number], xyz_mm=self.scan(number, side))
        return read_session(self.folder / f"organised{n_scans}x{side}")


def organised_cell(folder: Path, n_poses: int, seed: int = 0) -> OrganisedCell:
    """The calibration's numbers are made up; its size, and so its speed, is that of a real one."""
    cell = write_cell(folder)
    sessions = [record_session(folder / "spheres", cell, np.random.default_rng(seed), shots_per_sphere=2)]
    field = PolynomialError((0.0, 0.0, DEPTH_MM), (160.0, 160.0, 60.0), 3, 2)
    rng = np.random.default_rng(seed)
    camera_mm = rng.normal(0, 0.01, len(field.axis))
    made = nominal_calibration(cell, sessions)
    n_parameters = made.link_twists.size + 6 + len(camera_mm) + len(made.terms)
    root = rng.normal(0, 1e-4, (n_parameters, n_parameters))
    calibration = replace(made, camera_error=field, camera_mm=camera_mm, covariance=root @ root.T / n_parameters)
    return OrganisedCell(calibration, _poses(calibration, n_poses, rng), folder)


def _poses(calibration: Calibration, n_poses: int, rng: np.random.Generator) -> FloatArray:
    """Axis angles (m, 6) at which the camera looks at the surface, a little tilted and moved each time."""
    n_tries = 3 * n_poses
    turned = np.diag([1.0, -1.0, -1.0]) @ se3.exp_so3(rng.normal(0, [0.15, 0.15, 0.6], (n_tries, 3)))
    origin = SURFACE_CENTRE_MM + rng.uniform(-15, 15, (n_tries, 3)) - DEPTH_MM * turned[:, :, 2]
    flange = se3.from_rotation_translation(turned, origin) @ se3.inverse(calibration.flange_from_camera)
    found = branches_of_many(paper_robot(), flange, margin_rad=0.0)
    rows, first = np.unique(found.target, return_index=True)
    if len(rows) < n_poses:
        raise LookupError(f"only {len(rows)} of {n_poses} poses are within reach")
    return np.asarray(found.joints_rad[first[:n_poses]])


def _seen(base_from_camera: FloatArray, side: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Rays of a square grid, 0.2 mm apart at 1000 of them, met with z = height(x, y) by a few secant-like steps, with noise in depth."""
    steps = (np.arange(side) - side / 2) * (200.0 / side / DEPTH_MM)
    tx, ty = np.meshgrid(steps, steps)
    rays = np.stack([tx, ty, np.ones_like(tx)], axis=-1)
    along = rays @ base_from_camera[:3, :3].T
    z = np.full(tx.shape, DEPTH_MM)
    for _ in range(6):
        points = along * z[..., None] + base_from_camera[:3, 3]
        z += (_height_mm(points[..., 0], points[..., 1]) - points[..., 2]) / along[..., 2]
    z += rng.normal(0, NOISE_MM, z.shape)
    z[rng.random(z.shape) < 0.003] = np.nan
    return np.asarray(rays * z[..., None], dtype=np.float32)


def _height_mm(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(SURFACE_CENTRE_MM[2] + 5 * np.sin(x / 20) * np.cos(y / 15))
