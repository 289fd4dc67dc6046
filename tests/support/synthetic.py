"""An independent little simulator for tests of the solver: random shots by METHOD.md's pose law, no shipped simulator.

It shares only SE(3) and the MDH chain with the package; camera error, noise and poses are its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

PAPER_FLANGE_FROM_CAMERA = se3.from_rotation_translation([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [60.0, 60.0, 85.0])
TABLE_1_A = np.array([0.0016, 0.0023, 0.0390, -0.030, 0.0240, -0.0510])
TABLE_1_ALPHA = np.array([1.5e-4, 7.5e-4, 3.0e-4, 9.0e-4, 7.5e-4, -4.5e-4])
TABLE_1_D = np.array([0.0018, 0.0033, 0.0071, 0.0075, 0.0032, 0.0018])
TABLE_1_THETA = np.array([3.0e-4, 4.5e-4, -1.5e-4, 3.0e-4, -0.0011, 1.5e-4])


def paper_robot() -> RobotModel:
    """Table 1 as printed."""
    return RobotModel(
        name="irb1410_paper",
        a_mm=np.array([0.0, 150, 600, 120, 0, 0]),
        alpha_rad=np.array([0, np.pi / 2, 0, np.pi / 2, -np.pi / 2, np.pi / 2]),
        d_mm=np.array([475.0, 0, 0, 720, 0, 85]),
        theta_offset_rad=np.array([0, np.pi / 2, 0, 0, 0, 0]),
        coupling=np.eye(6),
        joint_limits_rad=np.full((6, 2), [-np.inf, np.inf]),
    )


def abb_robot() -> RobotModel:
    """The real IRB 1410 with its parallelogram (theta_3 = q_3 - q_2)."""
    coupling = np.eye(6)
    coupling[2, 1] = -1.0
    half = np.pi / 2
    return RobotModel(
        name="abb_irb1410",
        a_mm=np.array([0.0, 150, 600, 120, 0, 0]),
        alpha_rad=np.array([0, -half, 0, -half, half, -half]),
        d_mm=np.array([475.0, 0, 0, 720, 0, 85]),
        theta_offset_rad=np.array([0, -half, 0, 0, 0, np.pi]),
        coupling=coupling,
        joint_limits_rad=np.full((6, 2), [-np.inf, np.inf]),
    )


def with_table_1_errors(model: RobotModel) -> RobotModel:
    """The model with Table 1's bracketed errors added."""
    return RobotModel(
        name="true",
        a_mm=model.a_mm + TABLE_1_A,
        alpha_rad=model.alpha_rad + TABLE_1_ALPHA,
        d_mm=model.d_mm + TABLE_1_D,
        theta_offset_rad=model.theta_offset_rad + TABLE_1_THETA,
        coupling=model.coupling,
        joint_limits_rad=model.joint_limits_rad,
    )


def pillow_error_mm(points: FloatArray, k: tuple[float, float, float] = (1e-9, 7e-15, 5e-18)) -> FloatArray:
    """The paper's camera error dz at points (n, 3)."""
    x, z = points[:, 0] - 60.0, points[:, 2] - 500.0
    r2 = x * x + z * z
    return np.asarray(z * (k[0] * r2 + k[1] * r2**2 + k[2] * r2**3))


def bowl_ripple_mm(points: FloatArray) -> FloatArray:
    """A camera error that is no pillow: bowl 0.1 mm + ripple 0.05 mm."""
    bowl = 0.1 * ((points[:, 0] / 150.0) ** 2 + (points[:, 1] / 90.0) ** 2) * points[:, 2] / 330.0
    ripple = 0.05 * np.sin(points[:, 2] / 25.0) * np.cos(points[:, 0] / 60.0)
    return np.asarray(bowl + ripple)


@dataclass(frozen=True)
class SyntheticCell:
    """Truth of one synthetic cell."""

    nominal: RobotModel
    true: RobotModel
    flange_from_camera: FloatArray
    camera_error_mm: Callable[[FloatArray], FloatArray]
    centre_in_base_mm: FloatArray
    radius_mm: float = 19.05
    reads_large_mm: float = 0.0
    yields_rad: Callable[[FloatArray], FloatArray] | None = None
    """Change (n,) of the true axis angles at reported ones (n,): gravity, gears."""

    def true_base_from_flange(self, joints_rad: FloatArray) -> FloatArray:
        """(4, 4) where the flange truly is, noise apart."""
        yielded = joints_rad if self.yields_rad is None else joints_rad + self.yields_rad(joints_rad)
        return mdh.base_from_flange(self.true, yielded)


@dataclass(frozen=True)
class SyntheticShot:
    """Nominal joints and the measured points."""

    joints_rad: FloatArray
    points_in_camera_mm: FloatArray
    true_base_from_camera: FloatArray


def paper_cell(coupled: bool = False) -> SyntheticCell:
    """METHOD.md 4's reference cell."""
    nominal = abb_robot() if coupled else paper_robot()
    return SyntheticCell(nominal, with_table_1_errors(nominal), PAPER_FLANGE_FROM_CAMERA, pillow_error_mm, np.array([900.0, 100.0, 300.0]))


def draw_view(rng: np.random.Generator, depth_mm: tuple[float, float] = (250.0, 400.0)) -> tuple[FloatArray, FloatArray]:
    """Sphere centre in the camera (3,) and camera orientation in the base (3, 3) by METHOD.md's pose law."""
    z = rng.uniform(*depth_mm)
    x = z * np.tan(np.radians(rng.uniform(-22, 22)))
    y = z * np.tan(np.radians(rng.uniform(-13, 13)))
    tilt, heading, roll = np.radians(rng.uniform(0, 40)), rng.uniform(0, 2 * np.pi), rng.uniform(-np.pi, np.pi)
    down = np.diag([1.0, -1.0, -1.0])
    rotation = se3.exp_so3(tilt * np.array([np.cos(heading), np.sin(heading), 0.0])) @ down @ se3.exp_so3([0, 0, roll])
    return np.array([x, y, z]), rotation


def draw_shot(
    cell: SyntheticCell,
    rng: np.random.Generator,
    *,
    n_points: int = 1000,
    depth_noise_mm: float = 0.08,
    pose_noise: tuple[float, float] = (0.01, 1e-4),
    depth_mm: tuple[float, float] = (250.0, 400.0),
) -> SyntheticShot:
    """One shot: random view, inverse kinematics by Newton from a random start, noisy pose and points."""
    while True:
        centre_in_camera, base_from_camera_rotation = draw_view(rng, depth_mm)
        origin = cell.centre_in_base_mm - base_from_camera_rotation @ centre_in_camera
        target = se3.from_rotation_translation(base_from_camera_rotation, origin) @ se3.inverse(cell.flange_from_camera)
        joints = solve_joints(cell.nominal, target, rng)
        if joints is not None:
            break
    noise = np.concatenate([rng.normal(0, pose_noise[0], 3), rng.normal(0, pose_noise[1], 3)])
    flange = cell.true_base_from_flange(joints) @ se3.exp(noise)
    base_from_camera = flange @ cell.flange_from_camera
    centre = se3.apply(se3.inverse(base_from_camera), cell.centre_in_base_mm)
    points = sample_cap(centre, cell.radius_mm + cell.reads_large_mm, n_points, rng)
    points[:, 2] += cell.camera_error_mm(points)
    points[:, 2] += rng.normal(0, depth_noise_mm, len(points)) if depth_noise_mm else 0.0
    return SyntheticShot(joints, points, base_from_camera)


def sample_cap(centre: FloatArray, radius: float, n: int, rng: np.random.Generator, max_incidence_deg: float = 60.0) -> FloatArray:
    """Points (n, 3) spread evenly over the part of a sphere seen at less than the given incidence."""
    to_camera = -centre / np.linalg.norm(centre)
    cosine = rng.uniform(np.cos(np.radians(max_incidence_deg)), 1.0, n)
    angle = rng.uniform(0, 2 * np.pi, n)
    side = np.cross(to_camera, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(to_camera, side)
    sine = np.sqrt(1 - cosine**2)
    normals = cosine[:, None] * to_camera + sine[:, None] * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other)
    return np.asarray(centre + radius * normals)


def solve_joints(model: RobotModel, target: FloatArray, rng: np.random.Generator) -> FloatArray | None:
    """Axis angles (n,) that reach a flange pose, by damped Newton from random starts."""
    for _ in range(8):
        q = np.array([np.arctan2(target[1, 3], target[0, 3]), *rng.uniform(-1, 1, 5)])
        for _ in range(40):
            frames = mdh.chain(model, q)
            error = se3.log(target @ se3.inverse(frames[-1]))
            if np.abs(error[:3]).max() < 1e-9 and np.abs(error[3:]).max() < 1e-12:
                return (q + np.pi) % (2 * np.pi) - np.pi
            joint_axes = np.stack([se3.adjoint(frames[i + 1]) @ [0, 0, 0, 0, 0, 1] for i in range(6)], axis=1) @ model.coupling
            weight = np.diag([1, 1, 1, 500, 500, 500])
            a = weight @ joint_axes
            q = q + np.clip(np.linalg.solve(a.T @ a + 1e-3 * np.eye(6), a.T @ weight @ error), -0.5, 0.5)
    return None
