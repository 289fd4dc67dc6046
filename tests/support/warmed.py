"""A cell as it is some time after its calibration: warm links, a bumped camera, zero angles that crept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from acquire.sphere import fit_fixed_radius
from calibrate.observations import SphereShot
from calibrate.result import Calibration
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.draws import transform_rows
from tests.support.volume import DIAMETER_MM, UNSEEN, VolumeCell

STEEL_PER_K = 11.5e-6
_BUMP_LEVER_MM = 400.0
PART = ("Z", "S", "T", "V", "X")
"""Unseen places that stand for features of a part."""


def warmed(volume: VolumeCell, rng: np.random.Generator, *, kelvin: float = 10.0, bump_mm: float = 0.2, axis_rad: float = 3e-5) -> VolumeCell:
    """All lengths of the links expanded, the hand-eye bumped in a random direction, zero angles crept."""
    truth, model = volume.simulated.truth, volume.model
    robot, longer = truth.robot, STEEL_PER_K * kelvin
    push, turn = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    bumped = np.asarray(truth.camera.flange_from_camera) @ se3.exp(np.concatenate([bump_mm * push, bump_mm / _BUMP_LEVER_MM * turn]))
    changed = replace(
        robot,
        a_error_mm=tuple(np.add(robot.a_error_mm, longer * model.a_mm).tolist()),
        d_error_mm=tuple(np.add(robot.d_error_mm, longer * model.d_mm).tolist()),
        theta_error_rad=tuple(np.add(robot.theta_error_rad, axis_rad * rng.standard_normal(model.n_joints)).tolist()),
    )
    camera = replace(truth.camera, flange_from_camera=transform_rows(bumped))
    return replace(volume, simulated=SimulatedCell(replace(truth, robot=changed, camera=camera), model))


def length_errors_mm(calibration: Calibration, shots: Sequence[SphereShot], names: Sequence[str] = PART) -> FloatArray:
    """(l,) errors of all lengths between unseen places, each centre fitted on all views."""
    centres = {}
    for name in names:
        views = [calibration.points_in_base_mm(s.points_in_camera_mm, joints_rad=s.joints_rad) for s in shots if s.sphere == name]
        centres[name], _ = fit_fixed_radius(np.concatenate(views), DIAMETER_MM / 2 + calibration.radius_offset_mm, np.array(UNSEEN[name]))
    return np.array(
        [np.linalg.norm(centres[a] - centres[b]) - np.linalg.norm(np.subtract(UNSEEN[a], UNSEEN[b])) for a, b in combinations(names, 2)]
    )
