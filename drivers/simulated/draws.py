"""Truths to simulate with: one drawn at random that no calibrator's model fits exactly, and the paper's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from drivers.errors import SettingsError
from drivers.kinematics import se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.truth import (
    BoxTruth,
    CameraTruth,
    GearHarmonic,
    PillowTruth,
    RobotTruth,
    SphereTruth,
    StereoTruth,
    Transform,
    Truth,
    Vector,
    Vector6,
    WorkpieceTruth,
)

PAPER_FLANGE_FROM_CAMERA: Transform = ((0.0, -1.0, 0.0, 60.0), (1.0, 0.0, 0.0, 60.0), (0.0, 0.0, 1.0, 85.0), (0.0, 0.0, 0.0, 1.0))
"""The paper's hand-eye transform: 90 degrees about z, translation (60, 60, 85) (METHOD.md 6)."""

TABLE_1_ERRORS = RobotTruth(
    a_error_mm=(0.0016, 0.0023, 0.0390, -0.030, 0.0240, -0.0510),
    alpha_error_rad=(1.5e-4, 7.5e-4, 3.0e-4, 9.0e-4, 7.5e-4, -4.5e-4),
    d_error_mm=(0.0018, 0.0033, 0.0071, 0.0075, 0.0032, 0.0018),
    theta_error_rad=(3.0e-4, 4.5e-4, -1.5e-4, 3.0e-4, -0.0011, 1.5e-4),
)
"""The bracketed values of the paper's Table 1, the exponents' lost minus signs restored (METHOD.md 6)."""

_PARALLEL_SIN = 0.1


@dataclass(frozen=True, slots=True)
class Sizes:
    """How large the errors of a random truth are: standard deviations of what is drawn, exact values of the rest."""

    length_mm: float = 0.2
    """a and d of every link, drawn."""
    angle_rad: float = 5e-4
    """alpha and theta of every link, drawn."""
    tilt_rad: float = 3e-4
    """Tilt of axes nominally parallel to the one before, drawn."""
    droop_rad: float = 1.5e-4
    """Gravity droop of the second and third axis; a third of it in the wrist."""
    backlash_rad: float = 4e-5
    """Full play of every axis."""
    gear_rad: float = 2e-5
    """Amplitude of a gear harmonic in the second and third axis."""
    drift_mm_per_hour: float = 0.02
    drift_rad_per_hour: float = 2e-5
    """Drift of the robot's foot, drawn."""
    pose_noise_mm: float = 0.01
    pose_noise_rad: float = 1e-4
    hand_eye_mm: float = 1.15
    hand_eye_rad: float = 4e-3
    """First guess of the hand-eye transform, drawn per component: 2 mm and 7 mrad off."""
    optical_offset_mm: float = 0.03
    """How much larger in radius every sphere reads."""
    stereo: float = 1.0
    """Factor on the drawn errors of intrinsics, baseline and toe-in; at 1, rms in depth 0.04 to 0.3 mm at 250-420 mm."""
    range_noise_mm: float = 0.08


def random_truth(
    model: RobotModel,
    rng: np.random.Generator,
    *,
    spheres: Mapping[str, SphereTruth] | None = None,
    flange_from_camera: ArrayLike = PAPER_FLANGE_FROM_CAMERA,
    boxes: tuple[BoxTruth, ...] = (),
    workpiece: WorkpieceTruth | None = None,
    sizes: Sizes | None = None,
) -> Truth:
    """A cell whose errors are not the calibrator's own models (DESIGN.md 7).

    Perturbed MDH with tilts, gravity droop, gear harmonics, backlash, drift, a wrong hand-eye guess, a camera with wrong
    stereo intrinsics instead of a pillow, spheres that read large.

    Args:
        model: Nominal robot.
        rng: Source of the draw; also of the truth's own seed.
        spheres: Spheres as they stand; `sizes.optical_offset_mm` replaces their offset. One at (900, 100, 300) if None.
        flange_from_camera: The first guess (4, 4) that others believe in; the truth is drawn around it.
        boxes: Table, posts, fixtures.
        workpiece: A mesh in the cell.
        sizes: How large the errors are.
    """
    s = sizes or Sizes()
    placed = spheres or {"A": SphereTruth((900.0, 100.0, 300.0), 38.1)}
    return Truth(
        seed=int(rng.integers(2**31)),
        robot=_random_robot(model, rng, s),
        camera=_random_camera(rng, s, flange_from_camera),
        spheres={name: replace(sphere, optical_offset_mm=s.optical_offset_mm) for name, sphere in placed.items()},
        boxes=boxes,
        workpiece=workpiece,
    )


def paper_truth(
    model: RobotModel,
    *,
    seed: int = 0,
    spheres: Mapping[str, SphereTruth] | None = None,
    boxes: tuple[BoxTruth, ...] = (),
    workpiece: WorkpieceTruth | None = None,
    resolution_px: tuple[int, int] = (1280, 800),
) -> Truth:
    """The paper's simulated cell (Table 1, pillow error) with milder physics on top that the paper leaves out.

    On top: tilt of axis 3, droop 0.03 mrad, backlash 0.01 mrad, 0.01 mm/h of drift, pose noise 0.01 mm and 0.1 mrad,
    spheres that read 0.01 mm large, range noise, flying pixels, incidence drop-out. The true hand-eye transform is
    2 mm and 7 mrad away from `PAPER_FLANGE_FROM_CAMERA`, the first guess.

    Raises:
        SettingsError: the model has not six axes.
    """
    if model.n_joints != 6:
        raise SettingsError(f"Table 1 is for six axes, {model.name} has {model.n_joints}", remedy="Use irb1410_paper.")
    rng = np.random.default_rng([seed, 1410])
    robot = replace(
        TABLE_1_ERRORS,
        tilt_rad=(0.0, 0.0, 1e-4, 0.0, 0.0, 0.0),
        droop_rad=(0.0, 3e-5, 3e-5, 0.0, 1e-5, 0.0),
        backlash_rad=(1e-5,) * 6,
        drift_per_hour=(0.008, -0.005, 0.003, 0.0, 5e-6, 5e-6),
        pose_noise_mm=0.01,
        pose_noise_rad=1e-4,
    )
    camera = replace(
        _camera(_off_by(PAPER_FLANGE_FROM_CAMERA, rng, 2.0, 7e-3), range_noise_mm=0.08),
        resolution_px=resolution_px,
        error=PillowTruth(),
    )
    placed = spheres or {"A": SphereTruth((900.0, 100.0, 300.0), 38.1, 0.01)}
    return Truth(seed=seed, robot=robot, camera=camera, spheres=dict(placed), boxes=boxes, workpiece=workpiece)


def table(top_mm: float, centre_in_base_mm: tuple[float, float] = (900.0, 0.0), size_mm: tuple[float, float] = (1200.0, 1600.0)) -> BoxTruth:
    """A table 40 mm thick whose top is at a height of the base frame."""
    return BoxTruth((*size_mm, 40.0), transform_rows(se3.from_rotation_translation(np.eye(3), [*centre_in_base_mm, top_mm - 20.0])))


def post(sphere: SphereTruth, foot_mm: float, side_mm: float = 10.0) -> BoxTruth:
    """A square post from a height of the base frame up into the sphere's lowest millimetre."""
    x, y, z = sphere.centre_in_base_mm
    top = z - sphere.seen_radius_mm + 1.0
    if top <= foot_mm:
        raise SettingsError(f"a sphere at height {z} mm has no room for a post from {foot_mm} mm", remedy="Lower the foot of the post.")
    middle = se3.from_rotation_translation(np.eye(3), [x, y, (top + foot_mm) / 2])
    return BoxTruth((side_mm, side_mm, top - foot_mm), transform_rows(middle))


def transform_rows(transform: ArrayLike) -> Transform:
    """A transform (4, 4) as the nested tuples of a truth."""
    rows = [tuple(float(x) for x in row) for row in np.asarray(transform, dtype=np.float64).reshape(4, 4)]
    return (rows[0], rows[1], rows[2], rows[3])  # type: ignore[return-value]


def _random_robot(model: RobotModel, rng: np.random.Generator, s: Sizes) -> RobotTruth:
    n = model.n_joints
    heavy = np.array([0.0, 1.0, 1.0, *([1 / 3] * n)])[:n]
    parallel = (np.abs(np.sin(model.alpha_rad)) < _PARALLEL_SIN) & (np.arange(n) > 0)
    drift = np.concatenate([s.drift_mm_per_hour * rng.standard_normal(3), s.drift_rad_per_hour * rng.standard_normal(3)])
    return RobotTruth(
        a_error_mm=_floats(s.length_mm * rng.standard_normal(n)),
        alpha_error_rad=_floats(s.angle_rad * rng.standard_normal(n)),
        d_error_mm=_floats(s.length_mm * rng.standard_normal(n)),
        theta_error_rad=_floats(s.angle_rad * rng.standard_normal(n)),
        tilt_rad=_floats(s.tilt_rad * rng.standard_normal(n) * parallel),
        droop_rad=_floats(s.droop_rad * heavy),
        backlash_rad=(s.backlash_rad,) * n,
        gear_harmonics=tuple(GearHarmonic(i, s.gear_rad, 12.0, float(rng.uniform(0, 2 * np.pi))) for i in range(1, min(3, n))),
        drift_per_hour=_six(drift),
        pose_noise_mm=s.pose_noise_mm,
        pose_noise_rad=s.pose_noise_rad,
    )


def _random_camera(rng: np.random.Generator, s: Sizes, flange_from_camera: ArrayLike) -> CameraTruth:
    twist = np.concatenate([s.hand_eye_mm * rng.standard_normal(3), s.hand_eye_rad * rng.standard_normal(3)])
    focal, principal_x, principal_y, projector_focal, projector_principal, baseline, toe_in = s.stereo * rng.standard_normal(7)
    error = StereoTruth(
        focal_error_px=0.3 * focal,
        principal_error_px=(0.05 * principal_x, 0.2 * principal_y),
        projector_focal_error_px=0.3 * projector_focal,
        projector_principal_error_px=0.05 * projector_principal,
        baseline_error_mm=0.03 * baseline,
        toe_in_error_rad=5e-5 * toe_in,
    )
    true_hand_eye = np.asarray(flange_from_camera, dtype=np.float64) @ se3.exp(twist)
    return replace(_camera(true_hand_eye, range_noise_mm=s.range_noise_mm), error=error)


def _camera(flange_from_camera: ArrayLike, *, range_noise_mm: float) -> CameraTruth:
    return CameraTruth(
        flange_from_camera=transform_rows(flange_from_camera),
        range_noise_mm=range_noise_mm,
        flying_pixel_fraction=0.5,
        incidence_limit_deg=75.0,
        incidence_softness_deg=8.0,
        invalid_fraction=0.01,
    )


def _off_by(transform: ArrayLike, rng: np.random.Generator, distance_mm: float, angle_rad: float) -> FloatArray:
    """A transform moved in a random direction, by exactly this far."""
    shift, turn = rng.standard_normal(3), rng.standard_normal(3)
    twist = np.concatenate([distance_mm * shift / np.linalg.norm(shift), angle_rad * turn / np.linalg.norm(turn)])
    return np.asarray(np.asarray(transform, dtype=np.float64) @ se3.exp(twist))


def _floats(values: FloatArray) -> Vector:
    return tuple(float(value) for value in values)


def _six(values: FloatArray) -> Vector6:
    a, b, c, d, e, f = (float(value) for value in values)
    return a, b, c, d, e, f
