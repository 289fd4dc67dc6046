"""Calibrations made by hand for tests of the exporters, with every kind of robot error in them."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from calibrate import Calibration
from calibrate.camera_error import NoCameraError
from calibrate.datum import References, controller_datum, nominal_robot_datum
from calibrate.normal import NoiseModel
from calibrate.result_parts import Statistics
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model

FLANGE_FROM_CAMERA = se3.exp([61.0, -37.5, 88.25, 0.9, -1.7, 0.4])
TWIST_SIGMA = np.array([0.3, 0.3, 0.3, 1e-3, 1e-3, 1e-3])
SEEN_HALF_RANGE_RAD = np.array([0.8, 0.4, 0.4, 1.2, 1.0, 2.0])


class YieldingCalibration(Calibration):
    """A calibrated robot whose axes 2 and 3 also yield, by up to a milliradian, as no constant link twist does."""

    __slots__ = ()

    def base_from_flange(self, joints_rad: ArrayLike) -> FloatArray:
        q = np.asarray(joints_rad, dtype=np.float64)
        yielding = np.zeros_like(q)
        yielding[..., 1] = 5e-4 * np.sin(q[..., 1]) + 4e-4
        yielding[..., 2] = -3e-4 * np.cos(q[..., 1] + q[..., 2])
        return super().base_from_flange(q + yielding)


def calibration_of(
    model: RobotModel | None,
    *,
    seed: int = 3,
    flange_from_camera: FloatArray = FLANGE_FROM_CAMERA,
    kind: type[Calibration] = Calibration,
) -> Calibration:
    """A calibration of a robot with random link twists and its nominal-robot datum, or a pose-only one."""
    rng = np.random.default_rng(seed)
    if model is None:
        twists, seen, datum = np.zeros((0, 6)), None, controller_datum()
    else:
        twists = rng.normal(size=(model.n_joints, 6)) * TWIST_SIGMA
        middle = np.array([0.2, -0.1, 0.3, 0.1, -0.9, 0.5])
        seen = np.stack([middle - SEEN_HALF_RANGE_RAD, middle + SEEN_HALF_RANGE_RAD])
        datum = nominal_robot_datum(model, twists, References(rng.uniform(seen[0], seen[1], size=(40, model.n_joints))))
    # what else a calibration may hold of a robot is nothing here
    further: dict[str, Any] = {"terms": (), "terms_rad": np.zeros(0)}
    known = {field.name for field in fields(Calibration)}
    return kind(
        **{name: value for name, value in further.items() if name in known},
        id="0123456789abcdef" * 4,
        method="clouds",
        model=model,
        link_twists=twists,
        flange_from_camera=flange_from_camera,
        camera_error=NoCameraError(),
        camera_mm=np.zeros(0),
        camera_seen_volume_mm=np.array([[-100.0, -100, 250], [100, 100, 400]]),
        radius_offset_mm=0.0,
        sphere_centres_in_base_mm={"A": np.array([900.0, 100.0, 300.0])},
        sphere_radius_offsets_mm={"A": 0.0},
        datum=datum,
        seen_joints_rad=seen,
        noise=NoiseModel(point_mm=0.05, form_mm=0.0, pose_mm=0.01, pose_rad=1e-4),
        parameter_names=(),
        covariance=np.zeros((0, 0)),
        statistics=Statistics(40, 40, 30, 42, 1.0, 0.05, 0.06, 0.06, 1.0, 5, 0.1),
        limits=None,
        verdict="marginal",
        reasons=("no limits given",),
        shots=(),
        rejected=(),
        cell_name="t\u00e9st -- cell\nwith ] two lines",
        inputs={},
        identity={},
        created_utc="2026-01-31T12:00:00Z",
        software="spherecal 0.1.0",
    )


def shipped_calibration(name: str) -> Calibration:
    """`calibration_of` a shipped robot."""
    return calibration_of(load_robot_model(name))


def seen_poses(calibration: Calibration, n: int, seed: int = 11) -> FloatArray:
    """(n, n_axes) random axis angles in the seen ranges and within every limit."""
    model, seen = calibration.model, calibration.seen_joints_rad
    assert model is not None
    assert seen is not None
    joints = np.random.default_rng(seed).uniform(seen[0], seen[1], size=(20 * n, model.n_joints))
    return np.asarray(joints[mdh.within_limits(model, joints)][:n])


def assert_same_poses(actual: FloatArray, expected: FloatArray, *, mm: float = 1e-6, rad: float = 1e-9) -> None:
    """Poses (..., 4, 4) in mm agree."""
    assert np.abs(actual[..., :3, 3] - expected[..., :3, 3]).max() <= mm
    turn = se3.log_so3(np.swapaxes(actual[..., :3, :3], -1, -2) @ expected[..., :3, :3])
    assert np.abs(turn).max() <= rad
