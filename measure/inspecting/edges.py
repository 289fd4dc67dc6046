"""The rim of a hole, from the surface that it is cut into: for sheet metal and wherever no wall is seen.

The outline is divided into short arcs. Along each the surface's points, ordered by their distance from the nominal
outline, begin where the material begins; that place is half a step of the points' own spacing before the first of
them (the mean of how far the first point of a row of even steps lies inside). What a camera and the cleaning of
its edges do to a rim moves all arcs alike: an edge is uncertain by its points' spacing, which is stated as such.
"""

from __future__ import annotations

import numpy as np

from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.inspecting.coverage import along_outline
from measure.inspecting.patches import IntArray
from measure.inspecting.shapes import StadiumShape

_FEWEST_POINTS = 60
_ARC_SPACINGS = 3.0
_PLANE_SCALES = 4.0


def rim_points(shape: StadiumShape, points_in_part_mm: FloatArray, rows: IntArray, name: str) -> tuple[FloatArray, IntArray, float]:
    """Points (k, 3) on the rim, frame of the part, the rows of the cloud that they rest on, and the points' spacing in mm.

    Args:
        shape: the nominal outline.
        points_in_part_mm: (n, 3) the cloud.
        rows: points within the search distance of the outline.
        name: of the feature, for errors.

    Raises:
        DataError: too few points of the surface round the outline.
    """
    local = se3.apply(shape.local_from_part, points_in_part_mm[rows])
    on_surface = _on_surface(local)
    local, rows = local[on_surface], rows[on_surface]
    if len(local) < _FEWEST_POINTS:
        message = f"{len(local)} points of the surface lie round the edge, {_FEWEST_POINTS} are needed"
        raise DataError(message, where=name, remedy="Look at the scans there; a wall that is seen is measured with `use: wall`.")
    off, arc = _outside(shape, local), along_outline(shape, local)
    into = off * -shape.outward  # a hole's material lies outside of its outline
    spacing = spacing_mm(shape, local)
    order = np.lexsort((into, np.floor(arc / (_ARC_SPACINGS * spacing))))
    labels = np.floor(arc[order] / (_ARC_SPACINGS * spacing))
    first = order[np.flatnonzero(np.concatenate([[True], labels[1:] != labels[:-1]]))]
    # of three rows of points side by side in an arc the first is what begins it: a quarter of a step on average
    back = spacing / (_ARC_SPACINGS + 1)
    normal = shape.distances(np.zeros(len(shape.names)), local[first]).gradient
    at_rim = local[first] + back * shape.outward * normal
    return se3.apply(se3.inverse(shape.local_from_part), at_rim), rows[first], spacing


def spacing_mm(shape: StadiumShape, local: FloatArray) -> float:
    """Of the surface's points in the ring of material round the outline, as if they stood in squares."""
    into = _outside(shape, local) * -shape.outward
    depth = max(float(np.quantile(into, 0.99)), 0.2)
    inside = (into > 0.25 * depth) & (into <= depth)
    middle = shape.half_width_mm - shape.outward * 0.625 * depth
    length = 2 * np.pi * middle + 4 * shape.half_straight_mm
    return float(np.sqrt(0.75 * depth * length / max(int(inside.sum()), 1)))


def _on_surface(local: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Points of the plane that most of the upper ones lie in."""
    height = local[:, 2]
    if len(height) == 0:
        return np.zeros(0, dtype=np.bool_)
    middle = float(np.median(height[height > np.median(height) - 1.0]))
    scale = max(1.4826 * float(np.median(np.abs(height - middle))), 0.02)
    return np.asarray(np.abs(height - middle) <= _PLANE_SCALES * scale)


def _outside(shape: StadiumShape, local: FloatArray) -> FloatArray:
    """(n,) distance outside of the nominal outline."""
    return shape.distances(np.zeros(len(shape.names)), local).residual_mm
