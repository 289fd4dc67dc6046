"""Where a sphere should be seen, and whether it is: the cell's knowledge put to the sphere finder."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquire.cell import Cell
from acquire.sphere import ArcFinding, SphereFinding, SphereSettings, find_arc, find_sphere
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel

FloatArray = NDArray[np.float64]


def base_from_flange_of(model: RobotModel | None, joints_rad: FloatArray | None, reported: FloatArray | None) -> FloatArray | None:
    """Flange pose (4, 4) by the nominal robot where there are axis angles (n,), else as the controller reports it."""
    if model is not None and joints_rad is not None:
        return mdh.base_from_flange(model, joints_rad)
    return reported


def predicted_centre_in_camera_mm(cell: Cell, sphere: str | None, base_from_flange: FloatArray | None) -> FloatArray | None:
    """Where a sphere should be seen (3,), by the cell's place of it and its first guess of the hand-eye; None if unknown."""
    centre_in_base_mm = None if sphere is None else cell.spheres[sphere].centre_in_base_mm
    if centre_in_base_mm is None or base_from_flange is None or cell.flange_from_camera is None:
        return None
    base_from_camera = base_from_flange @ np.asarray(cell.flange_from_camera, dtype=np.float64)
    return se3.apply(se3.inverse(base_from_camera), centre_in_base_mm)


def look_for(
    cell: Cell, sphere: str, xyz_mm: NDArray[Any], predicted_mm: FloatArray | None, settings: SphereSettings | None = None
) -> SphereFinding | ArcFinding:
    """The named sphere in a scan of the cell's camera; its arc, where the camera is a line profiler.

    Raises:
        SphereNotFound: with the reason.
    """
    radius_mm = cell.spheres[sphere].radius_mm
    if cell.camera.kind == "line_profile":
        return find_arc(xyz_mm, radius_mm=radius_mm, settings=settings)
    return find_sphere(xyz_mm, radius_mm=radius_mm, settings=settings, predicted_centre_in_camera_mm=predicted_mm)


def prediction_error_mm(finding: SphereFinding | ArcFinding | None, predicted_mm: FloatArray | None) -> float | None:
    """How far a sphere was from its predicted place; None for arcs, whose centre is unknown, and without a prediction."""
    if predicted_mm is None or not isinstance(finding, SphereFinding):
        return None
    return float(np.linalg.norm(finding.centre_in_camera_mm - predicted_mm))
