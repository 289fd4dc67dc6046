"""What a shot would tell before it is taken: rows of the whole-cloud problem for an ideal cap (METHOD.md 4, *Pose design*).

The cap is a few quadrature points spread as a camera's pixels are. Their residuals feel the unknowns as in
`calibrate.problem`; the pose noise of the shot, a common displacement of the sphere, is eliminated by whitening with it:
the covariance of the residuals is `I / w + U S U'`, U their normals, S the displacement's covariance. What is left is
rotated so that the few combinations that carry information come first, and the others are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibrate.camera_error import CameraError
from calibrate.design_mismatch import CameraDisturbance, Physics, camera_disturbance, deflection_columns, modelled_covariance_mm2
from calibrate.normal import NoiseModel
from calibrate.problem import Geometry, Layout, LengthConstraint, Priors, Problem, State, linearise_geometry
from calibrate.robot_terms import arm_terms
from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

IntArray = NDArray[np.int64]

N_QUADRATURE = 16
CAP_HALF_ANGLE_RAD = float(np.radians(60))
_LEAST_SIGNAL = 0.01
"""Combinations of a shot's points whose signal at the priors' size stays below this (variance, noise 1) are dropped."""
_CHUNK = 400
_GOLDEN_RAD = float(np.pi * (3 - np.sqrt(5)))


@dataclass(frozen=True, slots=True)
class Expectation:
    """What is expected of shots that nobody has taken: stated defaults, or what an earlier calibration found."""

    noise: NoiseModel = field(default_factory=lambda: NoiseModel(point_mm=0.06, pose_mm=0.02, pose_rad=1e-4, form_mm=0.003))
    """Points along their normal (0.08 mm along the sight), flange per scan, form error of a cap."""
    n_points: int = 1000
    """Points on a sphere per shot."""
    priors: Priors = field(default_factory=Priors)
    physics: Physics = field(default_factory=Physics)
    hand_eye_mm: float = 50.0
    hand_eye_rad: float = 0.2
    centre_mm: float = 50.0
    """How well hand-eye and spheres are known at first: so badly that it never counts, but finite."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Robot, camera and spheres that shots are designed for; S spheres, P unknowns, q disturbances."""

    model: RobotModel
    flange_from_camera: FloatArray
    """(4, 4) first guess."""
    centres_in_base_mm: FloatArray
    """(S, 3) a guess too."""
    radius_mm: FloatArray
    """(S,)."""
    radius_sigma_mm: FloatArray
    """(S,)."""
    lengths: tuple[LengthConstraint, ...]
    camera_error: CameraError
    camera_box_mm: FloatArray
    """(2, 3) the part of the camera frame in which it sees."""
    expectation: Expectation = field(default_factory=Expectation)
    along_sight: bool = True
    """False for line profiles."""

    @property
    def disturbance(self) -> CameraDisturbance:
        """What the camera may do unmodelled."""
        return camera_disturbance(self.expectation.physics, self.camera_box_mm, self.camera_error)

    def problem(self, joints_rad: FloatArray, sphere: IntArray) -> Problem:
        """The problem (without points) of shots with joints (m, n) at spheres (m,), one scan each."""
        return Problem(
            model=self.model,
            joints_rad=joints_rad,
            base_from_flange=mdh.base_from_flange(self.model, joints_rad),
            scan=np.arange(len(joints_rad)),
            sphere=sphere,
            points_in_camera_mm=np.zeros((0, 3)),
            starts=np.zeros(len(joints_rad) + 1, dtype=np.int64),
            camera_error=self.camera_error,
            radius_mm=self.radius_mm,
            radius_sigma_mm=self.radius_sigma_mm,
            lengths=self.lengths,
            priors=self.expectation.priors,
            along_sight=self.along_sight,
        )

    def nominal_state(self, n_scans: int) -> State:
        """Every error at zero."""
        return State(
            link_twists=np.zeros((self.model.n_joints, 6)),
            flange_from_camera=self.flange_from_camera,
            camera_mm=np.zeros(len(self.camera_error.axis)),
            terms_rad=np.zeros(0),
            radius_offset_mm=0.0,
            sphere_radius_deviation_mm=np.zeros(len(self.radius_mm)),
            centres_in_base_mm=self.centres_in_base_mm,
            pose_noise=np.zeros((n_scans, 6)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Caps:
    """Ideal caps of m shots, t quadrature points each, before any noise is looked at."""

    geometry: Geometry
    unit: FloatArray
    """(m, t, 3) normals in the camera."""
    shares: FloatArray
    """(m, t, v + c): residual per row of `Geometry.columns`, then per disturbance of the camera."""
    deflection: FloatArray
    """(m, 3, K) motion of the sphere's centre in the camera per disturbance of the robot."""

    @property
    def moved(self) -> FloatArray:
        """(m, t, P + q) residual of every point per unknown and per disturbance (robot's first, then the camera's)."""
        v = self.geometry.columns.shape[1]
        unknowns = self.shares[..., :v] @ self.geometry.columns
        return np.concatenate([unknowns, self.unit @ self.deflection, self.shares[..., v:]], axis=-1)


def ideal_caps(scene: Scene, joints_rad: FloatArray, sphere: IntArray) -> Caps:
    """Caps of shots with joints (m, n) at spheres (m,) of a scene, at its nominal state."""
    problem = scene.problem(joints_rad, sphere)
    geometry = linearise_geometry(problem, scene.nominal_state(problem.n_scans))
    centre, radius = geometry.centre_in_camera_mm, scene.radius_mm[sphere]
    points = cap_points(centre, radius) if scene.along_sight else _arc_points(centre, radius)
    unit = (points - centre[:, None]) / radius[:, None, None]
    axis = scene.camera_error.axis
    basis = scene.camera_error.basis(points.reshape(-1, 3)).reshape(*unit.shape[:2], len(axis))
    offset = -np.ones((*unit.shape[:2], 1))
    shares = [unit, basis * unit[..., axis], offset, scene.disturbance.shares(points, unit)]
    in_base = scene.centres_in_base_mm[sphere]
    deflection = deflection_columns(scene.expectation.priors, scene.model, joints_rad, in_base)
    camera_from_base = np.swapaxes(geometry.base_from_camera[:, :3, :3], -1, -2)
    return Caps(geometry, unit, np.concatenate(shares, axis=-1), camera_from_base @ deflection)


def shot_rows(scene: Scene, joints_rad: FloatArray, sphere: IntArray) -> FloatArray:
    """Whitened rows (m, r, P + q) of shots: `rows' rows` summed over r is a shot's information, pose noise eliminated."""
    chunks = [slice(i, i + _CHUNK) for i in range(0, len(joints_rad), _CHUNK)]
    rows = [_rows_of(scene, ideal_caps(scene, joints_rad[c], sphere[c])) for c in chunks]
    if not rows:
        return np.zeros((0, 1, n_columns(scene)))
    deepest = max(part.shape[1] for part in rows)
    return np.concatenate([np.pad(part, ((0, 0), (0, deepest - part.shape[1]), (0, 0))) for part in rows])


def layout_of(scene: Scene) -> Layout:
    """Where each of the P unknowns sits."""
    return scene.problem(np.zeros((0, scene.model.n_joints)), np.zeros(0, dtype=np.int64)).layout


def n_columns(scene: Scene) -> int:
    """P + q."""
    return layout_of(scene).size + len(arm_terms(scene.model)) + scene.disturbance.n_columns


def pose_covariance_mm2(scene: Scene, geometry: Geometry) -> FloatArray:
    """(m, 3, 3) covariance in camera axes of the sphere's displacement by the pose noise."""
    noise = geometry.noise_columns
    return np.asarray(noise / scene.expectation.noise.pose_precision @ np.swapaxes(noise, -1, -2))


def point_weight(scene: Scene) -> float:
    """Weight in mm^-2 of one quadrature point: its share of a shot's points."""
    n = scene.expectation.n_points
    return float(scene.expectation.noise.point_weight(np.array([float(n)]))[0]) * n / N_QUADRATURE


def prior_sigma(scene: Scene) -> FloatArray:
    """(P,) standard deviation of every unknown before any data."""
    e, n = scene.expectation, scene.model.n_joints
    links = np.tile([e.priors.link_rho_mm] * 3 + [e.priors.link_phi_rad] * 3, n)
    hand_eye = [e.hand_eye_mm] * 3 + [e.hand_eye_rad] * 3
    offset = [e.priors.radius_offset_mm]
    centres = np.full(3 * len(scene.radius_mm), e.centre_mm)
    return np.concatenate([links, hand_eye, scene.camera_error.prior_sigma_mm, offset, scene.radius_sigma_mm, centres])


def actual_covariance(scene: Scene) -> FloatArray:
    """(P, P) of how large the unknowns really are."""
    physics, layout = scene.expectation.physics, layout_of(scene)
    sigma = prior_sigma(scene)
    sigma[layout.links] = np.tile([physics.link_mm] * 3 + [physics.link_rad] * 3, scene.model.n_joints)
    sigma[layout.radius_offset] = physics.radius_offset_mm
    actual = np.diag(sigma**2)
    actual[layout.camera, layout.camera] = modelled_covariance_mm2(physics, scene.camera_error)
    return actual


def _rows_of(scene: Scene, caps: Caps) -> FloatArray:
    """Rows (m, r, P + q) of one chunk; r as large as its most telling shot needs."""
    scale = np.sqrt(point_weight(scene))
    unit = scale * caps.unit
    covariance = np.eye(unit.shape[1]) + unit @ pose_covariance_mm2(scene, caps.geometry) @ np.swapaxes(unit, -1, -2)
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), scale * caps.moved)
    signal = whitened * np.concatenate([prior_sigma(scene), np.ones(whitened.shape[-1] - len(prior_sigma(scene)))])
    values, vectors = np.linalg.eigh(signal @ np.swapaxes(signal, -1, -2))
    kept = max(int((values > _LEAST_SIGNAL).sum(axis=1).max()), 1)
    return np.asarray(np.swapaxes(vectors[..., ::-1][..., :kept], -1, -2) @ whitened)


def cap_points(centre: FloatArray, radius: FloatArray) -> FloatArray:
    """(m, t, 3) points of caps that face the camera, spread evenly over their outline."""
    toward = -centre / np.linalg.norm(centre, axis=1, keepdims=True)
    across = np.cross(toward, np.where(np.abs(toward[:, :1]) < 0.7, [1.0, 0, 0], [0, 1.0, 0]))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(toward, across)
    index = np.arange(N_QUADRATURE)
    sine, turn = np.sin(CAP_HALF_ANGLE_RAD) * np.sqrt((index + 0.5) / N_QUADRATURE), _GOLDEN_RAD * index
    weights = np.stack([np.sqrt(1 - sine**2), sine * np.cos(turn), sine * np.sin(turn)], axis=-1)
    frame = np.stack([toward, across, other], axis=1)
    return np.asarray(centre[:, None] + radius[:, None, None] * (weights @ frame))


def _arc_points(centre: FloatArray, radius: FloatArray) -> FloatArray:
    """(m, t, 3) points where the plane y = 0 cuts the near side of spheres."""
    circle = np.sqrt(np.maximum(radius**2 - centre[:, 1] ** 2, 0.0))
    toward = np.arctan2(-centre[:, 2], -centre[:, 0])
    angle = toward[:, None] + CAP_HALF_ANGLE_RAD * (2 * (np.arange(N_QUADRATURE) + 0.5) / N_QUADRATURE - 1)
    x, z = (centre[:, i, None] + circle[:, None] * turn(angle) for i, turn in ((0, np.cos), (2, np.sin)))
    return np.stack([x, np.zeros_like(x), z], axis=-1)
