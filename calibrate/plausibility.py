"""Do the recorded flange poses fit the axis angles? Wrong units, axis order and missing couplings show here first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from drivers.errors import DataError
from drivers.files.session import Session
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

FINE_MM = 0.2
FACTORY_MM, FACTORY_RAD = 20.0, np.radians(1.0)


def check_reported_poses(sessions: Sequence[Session], model: RobotModel | None) -> tuple[str, ...]:
    """What is to be told of the controller's own poses; nothing where they agree to 0.2 mm or are not recorded.

    Raises:
        DataError: they differ by more than a factory calibration does (20 mm or 1 degree); the error names the most
            likely cause, found by trying it.
    """
    if model is None:
        return ()
    notes: list[str] = []
    for session in sessions:
        pairs = [(s.joints_rad, s.base_from_flange) for s in session.shots if s.joints_rad is not None and s.base_from_flange is not None]
        if not pairs:
            continue
        joints, reported = np.array([q for q, _ in pairs]), np.array([pose for _, pose in pairs])
        mm, rad = _difference(mdh.base_from_flange(model, joints), reported)
        if mm > FACTORY_MM or rad > FACTORY_RAD:
            raise DataError(
                f"recorded flange poses and axis angles disagree by {mm:.1f} mm and {np.degrees(rad):.2f} degrees (medians); "
                f"{likely_cause(model, joints, reported)}",
                file=session.folder / "shots.jsonl",
                remedy="Correct the recording or the robot model; the axis angles decide, the poses are a cross-check.",
            )
        if mm > FINE_MM:
            notes.append(
                f"the controller's own poses differ from the nominal model by {mm:.2f} mm: it is factory-calibrated or has another tool frame"
            )
    return tuple(notes)


def likely_cause(model: RobotModel, joints_rad: FloatArray, base_from_flange: FloatArray) -> str:
    """The cause that makes axis angles (m, n) and poses (m, 4, 4) agree best, told as a guess; found by trying each."""
    found = {name: _difference(*attempt(model, joints_rad, base_from_flange)) for name, attempt in _CAUSES.items()}
    name, (mm, _) = min(found.items(), key=lambda item: item[1][0])
    if mm <= FACTORY_MM:
        return f"most likely {name} (with that they agree to {mm:.2f} mm)"
    constant = _constant_offset(mdh.base_from_flange(model, joints_rad), base_from_flange)
    if constant is not None:
        return constant
    return "no single cause explains it: check the robot model, the active tool and work object"


_Attempt = Callable[[RobotModel, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

_CAUSES: dict[str, _Attempt] = {
    "the axis angles are in degrees": lambda model, q, pose: (mdh.base_from_flange(model, np.radians(q)), pose),
    "the poses are in metres": lambda model, q, pose: (mdh.base_from_flange(model, q), _scaled(pose, 1000.0)),
    "the poses are flange_from_base, the inverse": lambda model, q, pose: (mdh.base_from_flange(model, q), se3.inverse(pose)),
    "the axes come in reverse order": lambda model, q, pose: (mdh.base_from_flange(model, q[:, ::-1]), pose),
    "the coupling of the robot model does not belong to these axis angles": lambda model, q, pose: (
        mdh.base_from_flange(replace(model, coupling=np.eye(model.n_joints)), q),
        pose,
    ),
    "the parallelogram coupling theta_3 = q_3 - q_2 is missing from the robot model": lambda model, q, pose: (
        mdh.base_from_flange(replace(model, coupling=parallelogram(model.n_joints)), q),
        pose,
    ),
    "poses and axis angles are shifted by one shot": lambda model, q, pose: (mdh.base_from_flange(model, np.roll(q, 1, axis=0)), pose),
    "poses and axis angles are shifted by one shot the other way": lambda model, q, pose: (mdh.base_from_flange(model, np.roll(q, -1, axis=0)), pose),
}


def _difference(first: FloatArray, second: FloatArray) -> tuple[float, float]:
    """Median distance in mm and median angle in rad."""
    distance = np.linalg.norm(first[:, :3, 3] - second[:, :3, 3], axis=1)
    angle = np.linalg.norm(se3.log_so3(np.swapaxes(first[:, :3, :3], -1, -2) @ second[:, :3, :3]), axis=1)
    return float(np.median(distance)), float(np.median(angle))


def _constant_offset(model_poses: FloatArray, reported: FloatArray) -> str | None:
    """A tool or a work object that is active in the controller is one constant transform on the right or on the left."""
    for name, offsets in (
        ("an active tool frame (the offset is constant in the flange)", se3.inverse(model_poses) @ reported),
        ("an active work object or base frame (the offset is constant in the base)", reported @ se3.inverse(model_poses)),
    ):
        middle = se3.from_rotation_translation(se3.nearest_rotation(offsets[:, :3, :3].mean(axis=0)), np.median(offsets[:, :3, 3], axis=0))
        mm, rad = _difference(offsets, np.broadcast_to(middle, offsets.shape))
        if mm <= FACTORY_MM / 4 and rad <= FACTORY_RAD:
            return f"most likely {name}"
    return None


def _scaled(pose: FloatArray, factor: float) -> FloatArray:
    result = pose.copy()
    result[:, :3, 3] *= factor
    return result


def parallelogram(n: int) -> FloatArray:
    """(n, n) coupling `theta_3 = q_3 - q_2` of an arm whose upper arm does not turn its forearm."""
    coupling = np.eye(n)
    if n > 2:
        coupling[2, 1] = -1.0
    return coupling
