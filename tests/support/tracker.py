"""Synthetic laser tracker sessions: a robot whose errors are not the calibrator's model, seen at random poses."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from acquire.cell import parse_cell
from acquire.session import SessionWriter
from calibrate import Calibration
from calibrate.external_points import ExternalShot
from drivers.files.yaml import dump_yaml
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model
from drivers.simulated.draws import Sizes, random_truth
from drivers.simulated.robot_physics import draw_stop_noise, true_base_from_flange
from drivers.simulated.truth import RobotTruth

LIMITS = {"centre_rms_mm": 0.2, "length_error_mm": 0.2, "diameter_error_mm": 0.1, "form_mm": 0.3}
TARGETS = {"reflector": (45.0, -30.0, 120.0)}
FLOOR_MM = 100.0


@dataclass(frozen=True)
class TrackedRobot:
    """One true robot, where the tracker stands and where its targets sit."""

    model: RobotModel
    truth: RobotTruth
    base_from_tracker: FloatArray
    targets_in_flange_mm: Mapping[str, tuple[float, float, float]]
    noise_mm: float

    def true_flange(self, joints_rad: FloatArray) -> FloatArray:
        """(..., 4, 4) where the flange truly is, repeatability apart."""
        return true_base_from_flange(self.model, self.truth, joints_rad)

    def poses(self, rng: np.random.Generator, n_shots: int) -> FloatArray:
        """(n, axes) random axis angles within limits, the arm's parts above the floor."""
        low, high = np.clip(self.model.joint_limits_rad, -np.pi, np.pi).T
        found: list[FloatArray] = []
        while len(found) < n_shots:
            q = rng.uniform(low, high)
            if mdh.within_limits(self.model, q).all() and mdh.chain(self.model, q)[1:, 2, 3].min() > FLOOR_MM:
                found.append(q)
        return np.array(found)

    def see(self, rng: np.random.Generator, joints_rad: FloatArray, target: str = "reflector") -> FloatArray:
        """(3,) what the tracker reads of a target at one stop."""
        noise = draw_stop_noise(self.model, self.truth, rng)
        flange = true_base_from_flange(self.model, self.truth, joints_rad, approach=rng.choice([-1.0, 1.0], len(joints_rad)), noise=noise)
        seen = se3.apply(flange, np.array(self.targets_in_flange_mm[target]))
        return np.asarray(se3.apply(se3.inverse(self.base_from_tracker), seen) + rng.normal(0, self.noise_mm, 3))

    def shots(self, rng: np.random.Generator, n_shots: int, *, first: int = 0, joints_rad: FloatArray | None = None) -> list[ExternalShot]:
        """Shots of the first target as `calibrate` sees them."""
        target = next(iter(self.targets_in_flange_mm))
        joints = self.poses(rng, n_shots) if joints_rad is None else joints_rad
        return [ExternalShot("s", first + i, "tracker", target, q, self.see(rng, q, target)) for i, q in enumerate(joints)]


def tracked_robot(
    seed: int,
    *,
    model_name: str = "abb_irb1410",
    noise_mm: float = 0.015,
    sizes: Sizes | None = None,
    targets: Mapping[str, tuple[float, float, float]] | None = None,
) -> TrackedRobot:
    """A random truth, and a tracker that stands two metres off in any orientation."""
    rng = np.random.default_rng([seed, 8])
    model = load_robot_model(model_name)
    truth = random_truth(model, rng, sizes=sizes).robot
    axis = rng.normal(size=3)
    rotation = se3.exp_so3(axis / np.linalg.norm(axis) * rng.uniform(0, np.pi))
    return TrackedRobot(model, truth, se3.from_rotation_translation(rotation, rng.normal(0, 1500, 3)), targets or TARGETS, noise_mm)


def tracker_cell_data(model_name: str, *, limits: Mapping[str, float] | None = LIMITS, **more: object) -> dict[str, object]:
    """A cell that holds nothing but a robot."""
    data: dict[str, object] = {
        "format": "spherecal-cell/1",
        "name": "tracked",
        "robot": {"driver": "recorded", "model": model_name},
        "camera": {"driver": "recorded"},
        "flange_from_camera": None,
        "spheres": {},
    }
    return data | ({"limits": dict(limits)} if limits is not None else {}) | more


def write_tracker_session(folder: Path, shots: Sequence[ExternalShot], cell_data: Mapping[str, object], *, purpose: str = "calibration") -> Path:
    """A session of external points alone, through the writer that a capture uses."""
    cell = parse_cell(dump_yaml(cell_data).encode(), path=folder.parent / "cell.yaml")
    with SessionWriter.create(folder, purpose=purpose, cell=cell) as writer:
        for shot in shots:
            writer.append(joints_rad=shot.joints_rad, reference=shot.reference, target=shot.target, point_in_reference_mm=shot.point_in_reference_mm)
    return folder


def add_tracker_lines(folder: Path, shots: Sequence[ExternalShot]) -> Path:
    """External points written behind the shots of a session, by hand as an integrator's script would."""
    path = folder / "shots.jsonl"
    first = len(path.read_text().splitlines())
    lines = [
        json.dumps(
            {
                "index": first + i,
                "sphere": None,
                "joints_rad": shot.joints_rad.tolist(),
                "base_from_flange": None,
                "scan": None,
                "sha256": None,
                "time_utc": "2026-01-01T00:00:00Z",
                "reference": shot.reference,
                "target": shot.target,
                "point_in_reference_mm": shot.point_in_reference_mm.tolist(),
            }
        )
        for i, shot in enumerate(shots)
    ]
    path.write_text(path.read_text() + "\n".join(lines) + "\n")
    return folder


def pose_errors_mm(flange: FloatArray, true_flange: FloatArray, tool_in_flange_mm: Sequence[float] = (0.0, 0.0, 150.0)) -> FloatArray:
    """(m,) distance of tool points after the frames of base and flange are fitted: what no frame explains."""
    base, offset = np.eye(4), np.eye(4)
    tool = np.asarray(tool_in_flange_mm, dtype=np.float64)
    corners = np.concatenate([tool[None], tool + 100.0 * np.eye(3)])
    for _ in range(6):
        moved = base @ flange @ offset
        points, wanted = se3.apply(moved[:, None], corners).reshape(-1, 3), se3.apply(true_flange[:, None], corners).reshape(-1, 3)
        rotation = np.repeat(moved[:, :3, :3], len(corners), axis=0)
        of_base = np.concatenate([np.broadcast_to(np.eye(3), (len(points), 3, 3)), -se3.hat(points)], axis=-1)
        of_flange = np.concatenate([rotation, -rotation @ se3.hat(np.tile(corners, (len(flange), 1)))], axis=-1)
        design = np.concatenate([of_base, of_flange], axis=-1).reshape(-1, 12)
        step = np.linalg.lstsq(design, (wanted - points).reshape(-1), rcond=1e-10)[0]
        base, offset = se3.exp(step[:6]) @ base, offset @ se3.exp(step[6:])
    return np.asarray(np.linalg.norm(se3.apply(base @ flange @ offset, tool) - se3.apply(true_flange, tool), axis=-1))


def unseen_rms_mm(calibration: Calibration, robot: TrackedRobot, rng: np.random.Generator, n_poses: int = 200) -> tuple[float, float]:
    """Rms of `pose_errors_mm` at unseen poses: of the calibrated and of the nominal robot."""
    joints = robot.poses(rng, n_poses)
    true = robot.true_flange(joints)
    found = [pose_errors_mm(flange, true) for flange in (calibration.base_from_flange(joints), mdh.base_from_flange(robot.model, joints))]
    return float(np.sqrt((found[0] ** 2).mean())), float(np.sqrt((found[1] ** 2).mean()))
