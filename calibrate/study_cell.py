"""The paper's simulation as a cell of its own: truth, poses, noise, sphere centres and clouds (METHOD.md 6).

It shares the kinematics with the solvers and nothing else; camera error and noise are written out again here.

Robot: the shipped model `irb1410_paper` with the bracketed errors of Table 1. Camera: the pillow of eq. 5 as an error on
z. Noise: on the elements of base_from_flange, as the paper does it, which leaves SO(3) by as much.
Poses, which the paper does not tell (METHOD.md 4): sphere at (900, 100, 300); depth in the camera U(250, 400) mm, lateral
angles U(-22, 22) and U(-13, 13) degrees, tilt from straight down U(0, 40) degrees about a random axis, roll uniform, any
branch of the arm within its limits.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from drivers.kinematics import mdh, se3
from drivers.kinematics.inverse import branches_of_many
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model

TABLE_1_A_MM = (0.0016, 0.0023, 0.0390, -0.030, 0.0240, -0.0510)
TABLE_1_ALPHA_RAD = (1.5e-4, 7.5e-4, 3.0e-4, 9.0e-4, 7.5e-4, -4.5e-4)
TABLE_1_D_MM = (0.0018, 0.0033, 0.0071, 0.0075, 0.0032, 0.0018)
TABLE_1_THETA_RAD = (3.0e-4, 4.5e-4, -1.5e-4, 3.0e-4, -0.0011, 1.5e-4)
PAPER_K = (1e-9, 7e-15, 5e-18)
SIGHT_CROSSING_MM = (60.0, 0.0, 500.0)
_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, slots=True)
class StudyNoise:
    """Standard deviations of the paper's noise, and of the points that it does not simulate."""

    rotation_element: float = 1e-4
    translation_mm: float = 0.01
    """Of base_from_flange and of the sphere centre, each axis."""
    depth_mm: float = 0.08
    """Of a point, along z; clouds only."""

    def times(self, level: float) -> StudyNoise:
        """The paper's "noise level"."""
        return StudyNoise(self.rotation_element * level, self.translation_mm * level, self.depth_mm * level)


NO_NOISE = StudyNoise(0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class StudyCell:
    """The truth, and what is known of it before."""

    nominal: RobotModel
    true: RobotModel
    flange_from_camera: FloatArray
    """(4, 4) true."""
    flange_from_camera_guess: FloatArray
    """(4, 4) the paper's first guess, its lost signs chosen."""
    k: tuple[float, float, float] = PAPER_K
    centre_in_base_mm: FloatArray = field(default_factory=lambda: np.array([900.0, 100.0, 300.0]))
    radius_mm: float = 19.05

    def camera_error_mm(self, points_in_camera_mm: FloatArray) -> FloatArray:
        """(n,) what the camera adds to z at true points (n, 3): eq. 5."""
        x, z = points_in_camera_mm[..., 0] - SIGHT_CROSSING_MM[0], points_in_camera_mm[..., 2] - SIGHT_CROSSING_MM[2]
        r2 = x * x + z * z
        return np.asarray(z * (self.k[0] * r2 + self.k[1] * r2**2 + self.k[2] * r2**3))

    def measured(self, points_in_camera_mm: FloatArray) -> FloatArray:
        """Points (..., 3) as the camera gives them, noise aside."""
        result = points_in_camera_mm.copy()
        result[..., 2] += self.camera_error_mm(points_in_camera_mm)
        return result

    def with_camera_error(self, factor: float) -> StudyCell:
        """The same cell, all k times a factor."""
        return replace(self, k=(PAPER_K[0] * factor, PAPER_K[1] * factor, PAPER_K[2] * factor))

    def at(self, centre_in_base_mm: FloatArray) -> StudyCell:
        """The same cell, the sphere elsewhere."""
        return replace(self, centre_in_base_mm=np.asarray(centre_in_base_mm, dtype=np.float64))


@dataclass(frozen=True, slots=True, eq=False)
class StudyShots:
    """m shots of one sphere."""

    joints_rad: FloatArray
    """(m, 6)."""
    true_centre_in_camera_mm: FloatArray
    """(m, 3) where it was."""
    centre_in_camera_mm: FloatArray
    """(m, 3) as measured in the paper's simulation: the camera's error at the centre, noise added."""
    clouds_in_camera_mm: FloatArray
    """(m, n, 3) points of the cap that faces the camera, errors and noise on every point; n may be 0."""

    def ordered(self, order: NDArray[np.intp]) -> StudyShots:
        """The same shots as if captured in another order (m,)."""
        return StudyShots(
            self.joints_rad[order], self.true_centre_in_camera_mm[order], self.centre_in_camera_mm[order], self.clouds_in_camera_mm[order]
        )


def paper_cell() -> StudyCell:
    """METHOD.md 6: Table 1, the hand-eye transform, the first guess as printed with signs that make it a rotation."""
    nominal = load_robot_model("irb1410_paper")
    true = replace(
        nominal,
        name="true",
        a_mm=nominal.a_mm + TABLE_1_A_MM,
        alpha_rad=nominal.alpha_rad + TABLE_1_ALPHA_RAD,
        d_mm=nominal.d_mm + TABLE_1_D_MM,
        theta_offset_rad=nominal.theta_offset_rad + TABLE_1_THETA_RAD,
    )
    truth = se3.from_rotation_translation(_QUARTER_TURN, [60.0, 60.0, 85.0])
    return with_guess_signs(StudyCell(nominal, true, truth, truth), (1, 1, 1))


def with_guess_signs(cell: StudyCell, signs: tuple[int, ...]) -> StudyCell:
    """The cell with the paper's first guess; its text lost the minus signs, so that those of the rotation are a choice."""
    rotation = _QUARTER_TURN @ se3.exp_so3(np.array([0.0035, 0.0034, 0.0051]) * signs)
    return replace(cell, flange_from_camera_guess=se3.from_rotation_translation(rotation, [59.5445, 61.3253, 86.2298]))


def draw_shots(cell: StudyCell, rng: np.random.Generator, n_shots: int, *, noise: StudyNoise = NO_NOISE, n_points: int = 0) -> StudyShots:
    """Shots by the pose law above.

    Noise moves the flange away from where the true robot model has it: `base_from_flange` is spoiled element by element
    and the sphere is seen from there, as the paper's text says.
    """
    joints = draw_joints(cell, rng, n_shots)
    return shots_at(cell, rng, joints, noise=noise, n_points=n_points)


def shots_at(cell: StudyCell, rng: np.random.Generator, joints_rad: FloatArray, *, noise: StudyNoise = NO_NOISE, n_points: int = 0) -> StudyShots:
    """Shots at given axis angles (m, 6)."""
    m = len(joints_rad)
    flange = mdh.base_from_flange(cell.true, joints_rad)
    flange[:, :3, :3] += rng.normal(size=(m, 3, 3)) * noise.rotation_element
    flange[:, :3, 3] += rng.normal(size=(m, 3)) * noise.translation_mm
    in_flange = np.linalg.solve(flange[:, :3, :3], (cell.centre_in_base_mm - flange[:, :3, 3])[..., None])[..., 0]
    true_centre = se3.apply(se3.inverse(cell.flange_from_camera), in_flange)
    centre = cell.measured(true_centre) + rng.normal(size=(m, 3)) * noise.translation_mm
    clouds = cell.measured(caps(true_centre, cell.radius_mm, n_points, rng))
    clouds[..., 2] += rng.normal(size=clouds.shape[:-1]) * noise.depth_mm
    return StudyShots(joints_rad, true_centre, centre, clouds)


def draw_joints(cell: StudyCell, rng: np.random.Generator, n_shots: int) -> FloatArray:
    """Axis angles (m, 6) by the pose law; views that no branch of the arm reaches are drawn again."""
    found: list[FloatArray] = []
    while len(found) < n_shots:
        base_from_camera = _draw_views(cell.centre_in_base_mm, rng, 2 * n_shots)
        branches = branches_of_many(cell.nominal, base_from_camera @ se3.inverse(cell.flange_from_camera))
        for target in np.unique(branches.target):
            rows = np.flatnonzero(branches.target == target)
            found.append(branches.joints_rad[rng.choice(rows)])
    return np.array(found[:n_shots])


def caps(centres_mm: FloatArray, radius_mm: float, n_points: int, rng: np.random.Generator, max_incidence_rad: float = np.pi / 3) -> FloatArray:
    """Points (m, n, 3) spread evenly over the caps of spheres (m, 3) that a camera at the origin sees within an incidence."""
    towards = -centres_mm / np.linalg.norm(centres_mm, axis=1, keepdims=True)
    side = np.cross(towards, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(towards, side)
    cosine = rng.uniform(np.cos(max_incidence_rad), 1.0, (len(centres_mm), n_points, 1))
    turn = rng.uniform(0, 2 * np.pi, (len(centres_mm), n_points, 1))
    across = np.cos(turn) * side[:, None] + np.sin(turn) * other[:, None]
    return np.asarray(centres_mm[:, None] + radius_mm * (cosine * towards[:, None] + np.sqrt(1 - cosine**2) * across))


def fitted_centres(shots: StudyShots, radius_mm: float, *, free_radius: bool) -> tuple[FloatArray, FloatArray]:
    """Centres (m, 3) and radii (m,) of spheres fitted to the clouds, in the camera frame."""
    from acquire.sphere_fit import fit_fixed_radius, fit_free_radius

    centres, radii = np.zeros((len(shots.joints_rad), 3)), np.full(len(shots.joints_rad), radius_mm)
    for j, cloud in enumerate(shots.clouds_in_camera_mm):
        centres[j], _ = fit_fixed_radius(cloud, radius_mm, shots.true_centre_in_camera_mm[j])
        if free_radius:
            centres[j], radii[j], _ = fit_free_radius(cloud, radius_mm, centres[j])
    return centres, radii


def _draw_views(centre_in_base_mm: FloatArray, rng: np.random.Generator, n: int) -> FloatArray:
    """(n, 4, 4): cameras that see the sphere by the pose law."""
    z = rng.uniform(250.0, 400.0, n)
    in_camera = np.stack([z * np.tan(np.radians(rng.uniform(-22, 22, n))), z * np.tan(np.radians(rng.uniform(-13, 13, n))), z], axis=1)
    tilt, heading = np.radians(rng.uniform(0, 40, n)), rng.uniform(0, 2 * np.pi, n)
    roll = np.zeros((n, 3))
    roll[:, 2] = rng.uniform(-np.pi, np.pi, n)
    axis = np.stack([np.cos(heading), np.sin(heading), np.zeros(n)], axis=1)
    rotation = se3.exp_so3(tilt[:, None] * axis) @ np.diag([1.0, -1.0, -1.0]) @ se3.exp_so3(roll)
    return se3.from_rotation_translation(rotation, centre_in_base_mm - (rotation @ in_camera[..., None])[..., 0])
