"""Small simulated cells for tests: a sphere put where a camera at given axis angles sees it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.draws import PAPER_FLANGE_FROM_CAMERA
from drivers.simulated.truth import CameraTruth, SphereTruth, Truth, Vector3

# arm bent over the table, camera looking down and forward
JOINTS_RAD = np.array([0.1, 0.9, -0.3, 0.1, 0.9, 0.3])
CENTRE_IN_CAMERA_MM = (20.0, -15.0, 350.0)


def paper_model() -> RobotModel:
    """The shipped model of the paper's robot."""
    return load_robot_model("irb1410_paper")


def nominal_base_from_camera(joints_rad: FloatArray = JOINTS_RAD) -> FloatArray:
    """(4, 4) where the camera would be, had nothing an error."""
    return np.asarray(mdh.base_from_flange(paper_model(), joints_rad) @ np.array(PAPER_FLANGE_FROM_CAMERA))


def in_base(point_in_camera_mm: tuple[float, float, float], joints_rad: FloatArray = JOINTS_RAD) -> Vector3:
    """A point of the nominal camera frame in the base."""
    x, y, z = se3.apply(nominal_base_from_camera(joints_rad), point_in_camera_mm)
    return float(x), float(y), float(z)


def exact_camera(**changes: object) -> CameraTruth:
    """A small camera without any error."""
    camera = CameraTruth(flange_from_camera=PAPER_FLANGE_FROM_CAMERA, resolution_px=(160, 100))
    return replace(camera, **changes)  # type: ignore[arg-type]


def truth_with_sphere(**changes: object) -> Truth:
    """An exact cell with one 38.1 mm sphere in view of the camera at JOINTS_RAD, 350 mm away."""
    truth = Truth(seed=3, camera=exact_camera(), spheres={"A": SphereTruth(in_base(CENTRE_IN_CAMERA_MM), 38.1)})
    return replace(truth, **changes)  # type: ignore[arg-type]


def cell_at(truth: Truth, joints_rad: FloatArray = JOINTS_RAD) -> SimulatedCell:
    """A cell whose robot has arrived at the joints."""
    cell = SimulatedCell(truth, paper_model())
    cell.start_motion(joints_rad, speed_rad_s=1.0)
    cell.advance(60.0)
    return cell
