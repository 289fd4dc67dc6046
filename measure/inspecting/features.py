"""Nominal features as shapes, their points in the cloud, and edges where a wall is not seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.inspecting.edges import rim_points
from measure.inspecting.fitting import Fit, FitPoints, fit_shape, place_shape
from measure.inspecting.patches import IntArray
from measure.inspecting.shapes import ConeShape, Hollow, PlaneShape, Shape, SphereShape, StadiumShape, cylinder, frame_about
from measure.inspecting.spec import CircleFeature, ConeFeature, CylinderFeature, Feature, PlaneFeature, SlotFeature, SphereFeature

_LARGEST_NORMAL_ANGLE_DEG = 50.0


@dataclass(frozen=True, slots=True, eq=False)
class PartCloud:
    """The cloud in the frame of the part."""

    points_mm: FloatArray
    """(n, 3)."""
    normals: FloatArray | None
    """(n, 3), NaN where unknown; of either direction."""
    weights: FloatArray
    """(n,) raw points that each stands for."""
    voxel_mm: float = 0.0
    """How far apart the means of neighbouring voxels may lie on one surface; 0 for raw points."""

    def moved(self, new_from_old: FloatArray) -> PartCloud:
        """In another frame."""
        normals = None if self.normals is None else self.normals @ new_from_old[:3, :3].T
        return replace(self, points_mm=se3.apply(new_from_old, self.points_mm), normals=normals)


def shape_of(feature: Feature, others: Mapping[str, Feature] | None = None) -> Shape:
    """The shape of a nominal feature; `others` cut their openings out of a plane."""
    match feature:
        case SphereFeature():
            frame = frame_about(feature.centre_mm, feature.axis)
            return SphereShape(frame, feature.diameter_mm / 2, feature.search_mm, float(np.radians(feature.cap_deg)), _outward(feature.hole))
        case PlaneFeature():
            frame = frame_about(feature.centre_mm, feature.normal, feature.direction)
            half = _shrunk(feature.size_mm[0] / 2, feature), _shrunk(feature.size_mm[1] / 2, feature)
            return PlaneShape(frame, half, feature.search_mm, _hollows(feature, frame, others or {}))
        case CylinderFeature():
            frame = frame_about(feature.centre_mm, feature.axis)
            half_length = _shrunk(feature.length_mm / 2, feature)
            return cylinder(frame, feature.diameter_mm / 2, half_length, feature.search_mm, _outward(feature.hole))
        case ConeFeature():
            frame = frame_about(feature.centre_mm, feature.axis)
            angle = float(np.radians(feature.angle_deg / 2))
            half_length = _shrunk(feature.length_mm / 2, feature)
            return ConeShape(frame, feature.diameter_mm / 2, angle, half_length, feature.search_mm, _outward(feature.hole))
        case CircleFeature():
            frame = frame_about(feature.centre_mm, feature.axis)
            return StadiumShape(frame, feature.diameter_mm / 2, 0.0, feature.depth_mm, feature.search_mm, _outward(feature.hole))
        case SlotFeature():
            frame = frame_about(feature.centre_mm, feature.axis, feature.direction)
            straight = (feature.length_mm - feature.width_mm) / 2
            names = ("x", "y", "radius", "turn", "straight")
            return StadiumShape(frame, feature.width_mm / 2, straight, feature.depth_mm, feature.search_mm, _outward(feature.hole), names)


def fit_feature(name: str, feature: Feature, cloud: PartCloud, others: Mapping[str, Feature]) -> Fit:
    """Find a feature's points and fit it.

    Raises:
        DataError: too few points, or they leave it open.
    """
    shape, points = _sought(name, feature, cloud, others)
    fit = fit_shape(shape, points, name=name)
    if not _by_rim(feature):
        return fit
    # what moves the whole rim alike shows in no residual: half the spacing's width, as a rectangle
    doubt = np.zeros_like(fit.noise_covariance)
    doubt[shape.names.index("radius"), shape.names.index("radius")] = points.voxel_mm**2 / 3
    # a rim is seen by whoever sees the surface round it
    return replace(fit, noise_covariance=fit.noise_covariance + doubt, response=replace(fit.response, surface=None))


def place_feature(name: str, feature: Feature, cloud: PartCloud, others: Mapping[str, Feature]) -> tuple[Shape, FloatArray]:
    """Shape and parameters of `fit_feature` alone; arguments and errors are its own."""
    shape, points = _sought(name, feature, cloud, others)
    return shape, place_shape(shape, points, name=name)


def _sought(name: str, feature: Feature, cloud: PartCloud, others: Mapping[str, Feature]) -> tuple[Shape, FitPoints]:
    """A feature's nominal shape and the points in its region."""
    shape = shape_of(feature, others)
    rows = points_near(shape, cloud, any_normal=_by_rim(feature))
    if not _by_rim(feature):
        return shape, FitPoints(cloud.points_mm[rows], cloud.weights[rows], rows, cloud.voxel_mm)
    if not isinstance(shape, StadiumShape):  # what `shape_of` makes of an outline
        raise TypeError(type(shape))
    points, rows, spacing_mm = rim_points(shape, cloud.points_mm, rows, name)
    return shape, FitPoints(points, np.ones(len(rows)), rows, spacing_mm)


def _by_rim(feature: Feature) -> bool:
    return isinstance(feature, CircleFeature | SlotFeature) and feature.use == "edge"


def points_near(shape: Shape, cloud: PartCloud, *, any_normal: bool = False) -> IntArray:
    """Rows of the cloud in a shape's region, whose normals agree where they are known, unless any will do."""
    low, high = box_of(shape)
    points = cloud.points_mm
    rows = np.flatnonzero((points[:, 0] > low[0]) & (points[:, 0] < high[0]))
    for axis in (1, 2):
        column = points[rows, axis]
        rows = rows[(column > low[axis]) & (column < high[axis])]
    local = se3.apply(shape.local_from_part, points[rows])
    rows, local = _subset(shape.near(local), rows, local)
    if cloud.normals is not None and not any_normal and len(rows):
        gradient = shape.distances(np.zeros(len(shape.names)), local).gradient @ shape.local_from_part[:3, :3]
        agreement = np.abs(np.einsum("ni,ni->n", gradient, cloud.normals[rows]))
        with np.errstate(invalid="ignore"):
            rows = rows[~(agreement < np.cos(np.radians(_LARGEST_NORMAL_ANGLE_DEG)))]
    return rows


def _subset(kept: NDArray[np.bool_], rows: IntArray, local: FloatArray) -> tuple[IntArray, FloatArray]:
    return rows[kept], local[kept]


def box_of(shape: Shape) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner (3,), in the frame of the part, of the box round a shape's region."""
    part_from_local = se3.inverse(shape.local_from_part)
    half = np.abs(part_from_local[:3, :3]) @ shape.reach_mm
    return part_from_local[:3, 3] - half, part_from_local[:3, 3] + half


def _outward(hole: bool) -> float:
    return -1.0 if hole else 1.0


def _shrunk(half_mm: float, feature: Feature) -> float:
    """A region without its rim; small features lose at most half."""
    return max(half_mm - feature.keep_from_edges_mm, 0.5 * half_mm)


def _hollows(plane: PlaneFeature, local_from_part: FloatArray, others: Mapping[str, Feature]) -> tuple[Hollow, ...]:
    """What other features cut out of a plane, their rims included."""
    found = []
    for other in others.values():
        if isinstance(other, PlaneFeature):
            continue
        x, y, z = (float(v) for v in se3.apply(local_from_part, np.array(other.centre_mm)))
        radius, half_length = _extent(other)
        across = isinstance(other, SphereFeature) or abs(float(np.dot(plane.normal, other.axis))) > 0.9
        # the top of a boss lies inside of it and is not cut
        is_its_top = not other.hole and float(np.hypot(x, y) + np.hypot(*plane.size_mm) / 2) <= radius + plane.keep_from_edges_mm
        if across and not is_its_top and abs(z) <= half_length + plane.search_mm:
            found.append(Hollow(x, y, radius + plane.keep_from_edges_mm))
    return tuple(found)


def _extent(feature: Feature) -> tuple[float, float]:
    """Largest radius about the axis, and how far the feature reaches along it from its centre."""
    match feature:
        case SphereFeature():
            return feature.diameter_mm / 2, feature.diameter_mm / 2
        case CylinderFeature():
            return feature.diameter_mm / 2, feature.length_mm / 2
        case ConeFeature():
            opening = feature.length_mm / 2 * float(np.tan(np.radians(feature.angle_deg / 2)))
            return feature.diameter_mm / 2 + opening, feature.length_mm / 2
        case CircleFeature():
            return feature.diameter_mm / 2, feature.depth_mm
        case SlotFeature():
            return feature.length_mm / 2, feature.depth_mm
        case PlaneFeature():
            raise DataError("a plane cuts nothing out of a plane")
