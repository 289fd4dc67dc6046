"""Surfaces to fit: signed distance of points, its derivatives, and which points belong to the nominal region.

Every shape lives in a frame of its own: origin at the nominal centre, z along the nominal axis or normal. Parameters
are small changes of the nominal; a tilted axis is (a, b, 1) normalised. Distances are positive outside of round shapes
and above planes. Formulae: A. B. Forbes, "Least-squares best-fit geometric elements", NPL 1991, derived again here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.kinematics.se3 import FloatArray

BoolArray = NDArray[np.bool_]
_TINY = 1e-9


class Distances(NamedTuple):
    """Of points (n, 3) from a shape."""

    residual_mm: FloatArray
    """(n,)."""
    jacobian: FloatArray
    """(n, p) of the residual by the parameters."""
    gradient: FloatArray
    """(n, 3) of the residual by the point: the unit normal, away from the shape's inside."""


class Shape(Protocol):
    """What a fit needs of a shape."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the p parameters; lengths in mm, angles in rad."""
        ...

    @property
    def local_from_part(self) -> FloatArray:
        """(4, 4)."""
        ...

    @property
    def reach_mm(self) -> FloatArray:
        """(3,) half sizes of a box round the region, own frame."""
        ...

    @property
    def search_mm(self) -> float:
        """How far from the nominal points are looked for."""
        ...

    def distances(self, params: FloatArray, points_mm: FloatArray) -> Distances:
        """Of points (n, 3), own frame, at parameters (p,)."""
        ...

    def near(self, points_mm: FloatArray) -> BoolArray:
        """(n,) which points (n, 3), own frame, lie in the nominal region."""
        ...

    @property
    def outward(self) -> float:
        """1 where the gradient points out of the material, -1 for holes."""
        ...


def frame_about(origin_mm: object, axis: object, direction: object = None) -> FloatArray:
    """(4, 4) local_from_part: z along an axis, x along the part of a direction across it (any, where None)."""
    z = np.asarray(axis, dtype=np.float64)
    z = z / np.linalg.norm(z)
    hint = np.eye(3)[int(np.argmin(np.abs(z)))] if direction is None else np.asarray(direction, dtype=np.float64)
    x = hint - (hint @ z) * z
    x = x / np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    result = np.eye(4)
    result[:3, :3] = rotation
    result[:3, 3] = -rotation @ np.asarray(origin_mm, dtype=np.float64)
    return result


@dataclass(frozen=True, slots=True, eq=False)
class Hollow:
    """A round region of a plane that belongs to another feature."""

    x_mm: float
    y_mm: float
    radius_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class SphereShape:
    """Centre and radius."""

    local_from_part: FloatArray
    radius_mm: float
    search_mm: float
    cap_rad: float
    outward: float = 1.0
    names: tuple[str, ...] = ("x", "y", "z", "radius")

    @property
    def reach_mm(self) -> FloatArray:
        """(3,) half sizes of the box round it."""
        return np.full(3, self.radius_mm + self.search_mm)

    def distances(self, params: FloatArray, points_mm: FloatArray) -> Distances:
        """Distance from the centre less the radius."""
        way = points_mm - params[:3]
        distance = np.maximum(np.linalg.norm(way, axis=1), _TINY)
        unit = way / distance[:, None]
        return Distances(distance - self.radius_mm - params[3], np.column_stack([-unit, -np.ones(len(unit))]), unit)

    def near(self, points_mm: FloatArray) -> BoolArray:
        """Within the search distance, and within the cap."""
        distance = np.linalg.norm(points_mm, axis=1)
        found = np.abs(distance - self.radius_mm) < self.search_mm
        if self.cap_rad < np.pi:
            found &= points_mm[:, 2] > np.cos(self.cap_rad) * distance
        return np.asarray(found)


@dataclass(frozen=True, slots=True, eq=False)
class PlaneShape:
    """Offset along the normal and two tilts."""

    local_from_part: FloatArray
    half_mm: tuple[float, float]
    """Of the region, its rim left out."""
    search_mm: float
    hollows: tuple[Hollow, ...] = ()
    outward: float = 1.0
    names: tuple[str, ...] = ("offset", "tilt_x", "tilt_y")

    @property
    def reach_mm(self) -> FloatArray:
        """(3,) half sizes of the box round it."""
        return np.array([*self.half_mm, self.search_mm])

    def distances(self, params: FloatArray, points_mm: FloatArray) -> Distances:
        """Height over the plane z = offset through the tilted normal."""
        offset, a, b = params
        s = np.sqrt(1.0 + a * a + b * b)
        normal = np.array([a, b, 1.0]) / s
        x, y, z = points_mm[:, 0], points_mm[:, 1], points_mm[:, 2] - offset
        height = (a * x + b * y + z) / s
        jacobian = np.column_stack([np.full(len(x), -1.0 / s), x / s - height * a / s**2, y / s - height * b / s**2])
        return Distances(height, jacobian, np.broadcast_to(normal, points_mm.shape))

    def near(self, points_mm: FloatArray) -> BoolArray:
        """Inside the rectangle and outside of what is cut out of it."""
        found = (np.abs(points_mm[:, 2]) < self.search_mm) & (np.abs(points_mm[:, 0]) < self.half_mm[0]) & (np.abs(points_mm[:, 1]) < self.half_mm[1])
        for hollow in self.hollows:
            found &= np.hypot(points_mm[:, 0] - hollow.x_mm, points_mm[:, 1] - hollow.y_mm) > hollow.radius_mm
        return np.asarray(found)


@dataclass(frozen=True, slots=True, eq=False)
class ConeShape:
    """Axis, radius at the origin and half angle; without the last a cylinder."""

    local_from_part: FloatArray
    radius_mm: float
    half_angle_rad: float
    half_length_mm: float
    search_mm: float
    outward: float = 1.0
    names: tuple[str, ...] = ("x", "y", "tilt_x", "tilt_y", "radius", "half_angle")

    @property
    def reach_mm(self) -> FloatArray:
        """(3,) half sizes of the box round it."""
        widest = self.radius_mm + self.half_length_mm * np.tan(self.half_angle_rad) + self.search_mm / np.cos(self.half_angle_rad)
        return np.array([widest, widest, self.half_length_mm + self.search_mm * np.sin(self.half_angle_rad)])

    def distances(self, params: FloatArray, points_mm: FloatArray) -> Distances:
        """Distance from the mantle, at right angles to it."""
        x, y, a, b, radius = params[:5]
        angle = self.half_angle_rad + (params[5] if len(self.names) == 6 else 0.0)
        s = np.sqrt(1.0 + a * a + b * b)
        axis = np.array([a, b, 1.0]) / s
        way = points_mm - np.array([x, y, 0.0])
        along = way @ axis
        across = way - along[:, None] * axis
        rho = np.maximum(np.linalg.norm(across, axis=1), _TINY)
        unit = across / rho[:, None]
        cos, sin = np.cos(angle), np.sin(angle)
        rim = self.radius_mm + radius
        residual = (rho - rim) * cos - along * sin
        columns = [sin * axis[i] - cos * unit[:, i] for i in (0, 1)]
        columns += [-(cos * along + sin * rho) * unit[:, i] / s for i in (0, 1)]
        columns.append(np.full(len(rho), -cos))
        if len(self.names) == 6:
            columns.append(-(rho - rim) * sin - along * cos)
        return Distances(residual, np.column_stack(columns), cos * unit - sin * axis)

    def near(self, points_mm: FloatArray) -> BoolArray:
        """Within the search distance over the length, which is cut off at right angles to the mantle.

        Cut across the axis instead, noise along the rays would leave and enter at the two ends on opposite sides of the
        mantle, and a cone of 90 degrees would read 0.3 degrees wide at 0.08 mm of noise.
        """
        out = np.hypot(points_mm[:, 0], points_mm[:, 1]) - self.radius_mm
        off = out * np.cos(self.half_angle_rad) - points_mm[:, 2] * np.sin(self.half_angle_rad)
        return np.asarray((np.abs(self.along(points_mm)) < self.half_length_mm) & (np.abs(off) < self.search_mm))

    def along(self, points_mm: FloatArray) -> FloatArray:
        """(n,) height along the axis of the points (n, 3) of the mantle that are nearest to these."""
        cos, sin = np.cos(self.half_angle_rad), np.sin(self.half_angle_rad)
        out = np.hypot(points_mm[:, 0], points_mm[:, 1]) - self.radius_mm
        return np.asarray((points_mm[:, 2] * cos + out * sin) * cos)


def cylinder(local_from_part: FloatArray, radius_mm: float, half_length_mm: float, search_mm: float, outward: float) -> ConeShape:
    """A cone that does not open."""
    return ConeShape(local_from_part, radius_mm, 0.0, half_length_mm, search_mm, outward, ("x", "y", "tilt_x", "tilt_y", "radius"))


@dataclass(frozen=True, slots=True, eq=False)
class StadiumShape:
    """A circle or a slot in its plane: walls are taken as straight along the axis."""

    local_from_part: FloatArray
    half_width_mm: float
    half_straight_mm: float
    """Half the distance of the end circles' centres; 0 for a circle."""
    depth_mm: float
    search_mm: float
    outward: float = -1.0
    names: tuple[str, ...] = field(default=("x", "y", "radius"))
    """A slot has `turn` and `straight` besides: the angle about the axis, and the change of `half_straight_mm`."""

    @property
    def is_slot(self) -> bool:
        """Whether it has straight sides."""
        return len(self.names) == 5

    @property
    def reach_mm(self) -> FloatArray:
        """(3,) half sizes of the box round it."""
        across = self.half_width_mm + self.search_mm
        return np.array([across + self.half_straight_mm, across, self.depth_mm])

    def distances(self, params: FloatArray, points_mm: FloatArray) -> Distances:
        """Distance from the outline, in its plane."""
        turn, longer = (params[3], params[4]) if self.is_slot else (0.0, 0.0)
        cos, sin = np.cos(turn), np.sin(turn)
        x, y = points_mm[:, 0] - params[0], points_mm[:, 1] - params[1]
        u, v = cos * x + sin * y, cos * y - sin * x
        half = self.half_straight_mm + longer
        end = np.clip(u, -half, half)
        off = u - end
        rho = np.maximum(np.hypot(off, v), _TINY)
        eu, ev = off / rho, v / rho
        normal = np.column_stack([cos * eu - sin * ev, sin * eu + cos * ev, np.zeros(len(u))])
        columns = [-normal[:, 0], -normal[:, 1], np.full(len(u), -1.0)]
        if self.is_slot:
            # turning moves (u, v) by (v, -u); the ends follow u only where they are reached
            columns += [eu * v - ev * u, -eu * np.sign(u) * (np.abs(u) > half)]
        return Distances(rho - self.half_width_mm - params[2], np.column_stack(columns), normal)

    def near(self, points_mm: FloatArray) -> BoolArray:
        """Within the search distance of the outline and the depth of the plane."""
        u = np.clip(points_mm[:, 0], -self.half_straight_mm, self.half_straight_mm)
        rho = np.hypot(points_mm[:, 0] - u, points_mm[:, 1])
        return np.asarray((np.abs(rho - self.half_width_mm) < self.search_mm) & (np.abs(points_mm[:, 2]) < self.depth_mm))
