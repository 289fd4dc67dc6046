"""A sphere seen without a whole frame: a thousand points in a fraction of a millisecond, for Monte-Carlo work."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.optics import measured_points, noisy_points, seen_under_incidence
from drivers.simulated.robot_physics import draw_stop_noise, true_base_from_flange


def observe_sphere(
    cell: SimulatedCell,
    joints_rad: ArrayLike,
    sphere: str,
    n_points: int,
    rng: np.random.Generator,
    *,
    noise: bool = True,
) -> FloatArray:
    """Points (n, 3) in the camera frame, mm, on the cap of a sphere seen with the axes at joints (n_axes,).

    Rays are spread evenly over the sphere's silhouette; those beyond the incidence limit are drawn again. Same physics
    as a frame, but nothing hides the sphere, the picture has no border and no flying pixels. The cell's clock gives the
    drift; its axes are left alone.

    Args:
        cell: The cell.
        joints_rad: Reported axis angles.
        sphere: Name in the truth.
        n_points: Number of points.
        rng: Source of every random number, the rays included.
        noise: Whether there are repeatability, a random side of every axis's backlash, and range noise. Without, the
            axes stand in the middle of their play and only systematic errors remain.
    """
    truth, model = cell.truth, cell.model
    approach = rng.choice([-1.0, 1.0], size=model.n_joints) if noise else None
    stop = draw_stop_noise(model, truth.robot, rng) if noise else None
    base_from_flange = true_base_from_flange(model, truth.robot, joints_rad, approach=approach, hours=cell.hours, noise=stop)
    camera_from_base = se3.inverse(base_from_flange @ np.array(truth.camera.flange_from_camera))
    centre = se3.apply(camera_from_base, np.array(truth.spheres[sphere].centre_in_base_mm))
    true_points = _cap_points(cell, centre, truth.spheres[sphere].seen_radius_mm, n_points, rng)
    points = measured_points(truth.camera.error, true_points)
    return noisy_points(truth.camera, points, rng) if noise else points


def _cap_points(cell: SimulatedCell, centre: FloatArray, radius: float, n_points: int, rng: np.random.Generator) -> FloatArray:
    kept: list[FloatArray] = []
    missing = n_points
    while missing > 0:
        points, cos_incidence = _silhouette_points(centre, radius, 2 * missing + 16, rng)
        points = points[seen_under_incidence(cell.truth.camera, cos_incidence, rng)]
        kept.append(points[:missing])
        missing -= len(kept[-1])
    return np.concatenate(kept)


def _silhouette_points(centre: FloatArray, radius: float, n: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Nearer crossings (n, 3) of random rays with a sphere, and the cosines (n,) of their incidence."""
    distance = float(np.linalg.norm(centre))
    axis = centre / distance
    # offset of a ray from the centre, at right angles to the ray, evenly over the disc
    offset = radius * np.sqrt(rng.random(n))
    turn = 2 * np.pi * rng.random(n)
    side, other = _perpendiculars(axis)
    sin = offset / distance
    across = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other
    rays = np.sqrt(1 - sin**2)[:, None] * axis + sin[:, None] * across
    half_chord = np.sqrt(radius**2 - offset**2)
    return rays * (distance * np.sqrt(1 - sin**2) - half_chord)[:, None], half_chord / radius


def _perpendiculars(axis: FloatArray) -> tuple[FloatArray, FloatArray]:
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    return side, np.cross(axis, side)
