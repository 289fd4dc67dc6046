"""Sphere views made from plain numbers, for tests of figures, report and viewer."""

from __future__ import annotations

import numpy as np

from drivers.kinematics.se3 import FloatArray
from measure.sphere_figures import SphereView


def cap(rng: np.random.Generator, centre_mm: FloatArray, radius_mm: float, n: int, axis: FloatArray, half_angle_rad: float = 1.0) -> FloatArray:
    """Points (n, 3) spread evenly over a cap about an axis (3,)."""
    cosine = rng.uniform(np.cos(half_angle_rad), 1.0, n)
    turn = rng.uniform(0, 2 * np.pi, n)
    unit = np.asarray(axis) / np.linalg.norm(axis)
    side = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
    side /= np.linalg.norm(side)
    other = np.cross(unit, side)
    sine = np.sqrt(1 - cosine**2)
    directions = cosine[:, None] * unit + sine[:, None] * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other)
    return np.asarray(centre_mm + radius_mm * directions)


def view(
    rng: np.random.Generator,
    sphere: str,
    index: int,
    centre_mm: FloatArray,
    *,
    radius_mm: float = 19.05,
    shift_mm: FloatArray | None = None,
    noise_mm: float = 0.0,
    n: int = 300,
    session: str = "s",
) -> SphereView:
    """A view from a random direction above, all its points shifted together, with radial noise."""
    axis = np.array([*rng.uniform(-0.7, 0.7, 2), 1.0])
    axis /= np.linalg.norm(axis)
    points = cap(rng, np.zeros(3), radius_mm, n, axis)
    points *= 1.0 + rng.normal(0.0, noise_mm, (n, 1)) / radius_mm if noise_mm else 1.0
    moved = points + centre_mm + (np.zeros(3) if shift_mm is None else shift_mm)
    return SphereView(session, index, sphere, moved, moved.mean(axis=0) - 0.7 * radius_mm * axis)
