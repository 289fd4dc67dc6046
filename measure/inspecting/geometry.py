"""Fitted shapes as geometry: place, axis and sizes in the frame of the part, and what is measured between them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.inspecting.shapes import ConeShape, PlaneShape, Shape, SphereShape, StadiumShape
from measure.inspecting.spec import Feature

POINTS = ("sphere", "circle", "slot")
AXES = ("cylinder", "cone")
_PARALLEL_SIN = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Element:
    """One feature as geometry."""

    kind: str
    point_mm: FloatArray
    """(3,) centre; on axes and planes the point nearest to the nominal centre that the fit knows."""
    axis: FloatArray
    """(3,) unit: normal of a plane or an outline, axis of a cylinder or cone."""
    diameter_mm: float | None = None
    width_mm: float | None = None
    length_mm: float | None = None
    angle_deg: float | None = None

    def moved(self, new_from_old: FloatArray) -> Element:
        """In another frame."""
        return replace(self, point_mm=se3.apply(new_from_old, self.point_mm), axis=new_from_old[:3, :3] @ self.axis)

    def passing(self, nominal: Element) -> Element:
        """An axis where it passes the nominal centre; a cone's diameter is the one there."""
        slope = float(self.axis @ nominal.axis)
        if self.kind not in AXES or abs(slope) < 0.1:
            return self
        along = float(nominal.axis @ (nominal.point_mm - self.point_mm)) / slope
        diameter = self.diameter_mm
        if diameter is not None and self.angle_deg is not None:
            diameter += 2 * along * float(np.tan(np.radians(self.angle_deg / 2)))
        return replace(self, point_mm=self.point_mm + along * self.axis, diameter_mm=diameter)

    def point_on(self, plane: Element) -> FloatArray:
        """The point itself, or where the axis meets a plane, brought into that plane along its normal."""
        point = self.point_mm
        slope = float(self.axis @ plane.axis)
        if self.kind in AXES and abs(slope) > 0.1:
            point = point + self.axis * (float(plane.axis @ (plane.point_mm - point)) / slope)
        return np.asarray(point - plane.axis * float(plane.axis @ (point - plane.point_mm)))


def element_of(feature: Feature, shape: Shape, params: FloatArray) -> Element:
    """A shape at parameters (p,), frame of the part."""
    part_from_local = se3.inverse(shape.local_from_part)
    local, axis, sizes = _local(shape, params)
    return Element(feature.kind, se3.apply(part_from_local, local), part_from_local[:3, :3] @ axis, **sizes)


def nominal_element(feature: Feature, shape: Shape) -> Element:
    """The feature as the drawing has it."""
    return element_of(feature, shape, np.zeros(len(shape.names)))


def _local(shape: Shape, params: FloatArray) -> tuple[FloatArray, FloatArray, dict[str, float]]:
    z = np.array([0.0, 0.0, 1.0])
    match shape:
        case SphereShape():
            return params[:3], z, {"diameter_mm": 2 * float(shape.radius_mm + params[3])}
        case PlaneShape():
            return np.array([0.0, 0.0, params[0]]), _tilted(params[1], params[2]), {}
        case ConeShape():
            sizes = {"diameter_mm": 2 * float(shape.radius_mm + params[4])}
            if len(shape.names) == 6:
                sizes["angle_deg"] = float(np.degrees(2 * (shape.half_angle_rad + params[5])))
            return np.array([params[0], params[1], 0.0]), _tilted(params[2], params[3]), sizes
        case StadiumShape():
            width = 2 * float(shape.half_width_mm + params[2])
            centre = np.array([params[0], params[1], 0.0])
            if not shape.is_slot:
                return centre, z, {"diameter_mm": width}
            return centre, z, {"width_mm": width, "length_mm": width + 2 * float(shape.half_straight_mm + params[4])}
    raise TypeError(type(shape))


def _tilted(a: float, b: float) -> FloatArray:
    axis = np.array([a, b, 1.0])
    return np.asarray(axis / np.linalg.norm(axis))


def distance_mm(first: Element, second: Element, along: str | None) -> float:
    """Between two features; along x, y or z of the part the signed way from the first to the second.

    Planes: from the plane to the other's point (two planes: the mean of both ways). Axes: at right angles to them, at
    their points. Points: straight.
    """
    way = second.point_mm - first.point_mm
    if along is not None:
        return float(way["xyz".index(along)])
    if first.kind == second.kind == "plane":
        return 0.5 * abs(float(first.axis @ way)) + 0.5 * abs(float(second.axis @ way))
    for one in (first, second):
        if one.kind == "plane":
            return abs(float(one.axis @ way))
    axes = [one.axis for one in (first, second) if one.kind in AXES]
    if len(axes) == 2:
        mean = axes[0] + np.sign(float(axes[0] @ axes[1]) or 1.0) * axes[1]
        axes = [mean / np.linalg.norm(mean)]
    across = way - (way @ axes[0]) * axes[0] if axes else way
    return float(np.linalg.norm(across))


def angle_deg(first: Element, second: Element) -> float:
    """Between two normals or axes, 0 to 90 degrees."""
    cosine, sine = abs(float(first.axis @ second.axis)), float(np.linalg.norm(np.cross(first.axis, second.axis)))
    return float(np.degrees(np.arctan2(sine, cosine)))


def offset_from(measured: Element, nominal: Element) -> FloatArray:
    """(3,) from the nominal place, as far as the feature has one: across its axis, along a plane's normal."""
    way = measured.point_mm - nominal.point_mm
    if nominal.kind == "plane":
        return np.asarray((way @ nominal.axis) * nominal.axis)
    if nominal.kind == "sphere":
        return np.asarray(way)
    return np.asarray(way - (way @ nominal.axis) * nominal.axis)
