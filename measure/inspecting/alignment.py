"""Laying the measured part onto the nominal: as measured, by datum features, or by best fit to the mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DataError, SettingsError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.inspecting.distance import NominalSurface
from measure.inspecting.features import PartCloud
from measure.inspecting.fitting import Response
from measure.inspecting.geometry import Element
from measure.inspecting.patches import PatchSums, patch_covariance, patches_of

_THINNED = 5_000
_ROUNDS = 50
_CELLS_ACROSS = 8
_FIRST_LIMIT = 0.1
"""Of the part's size: how far apart points and mesh may be at first."""
_SMALLEST_LIMIT_MM = 0.5
_NEAR = 0.01
"""Of the part's size: points of a fitted part lie nearer than this."""
_SCALES = 4.0
_SETTLED_MM = 1e-4
_LEAST_OVERLAP, _LIKELY_RIGHT, _PLAINLY_RIGHT = 0.25, 0.8, 0.9
_BOX_MARGIN, _FEWEST_BOXED = 0.03, 500
_LEAST_HOLD = 1e-3
"""Mean square of the normals' share in the least held motion, turns taken at the part's radius."""


@dataclass(frozen=True, slots=True, eq=False)
class BestFit:
    """Where the mesh fits the points best."""

    new_from_part: FloatArray
    """(4, 4) to be applied to points in the frame of the part."""
    covariance: FloatArray
    """(6, 6) of a twist on its left, by what the residuals show."""
    response: Response
    rms_mm: float
    n_used: int
    n_all: int


def best_fit(surface: NominalSurface, cloud: PartCloud) -> BestFit:
    """Point-to-plane iteration (Y. Chen and G. Medioni, 1992) with Tukey's weights under a shrinking limit of distance.

    Points that lie on the mesh from the start are fitted; a part that lies elsewhere needs `base_from_part`, or is tried
    along its principal axes.

    Raises:
        DataError: no placement brings a quarter of the points near the mesh, or the points leave it free to slide.
    """
    everything = cloud.points_mm
    boxed = _near_box(everything, surface)
    # a table and fixtures round the part are left out where the part is about where it should be
    found = _iterate(surface, _thinned(everything[boxed]), np.eye(4)) if boxed.sum() >= _FEWEST_BOXED else None
    if found is not None and found[2] >= _LIKELY_RIGHT:
        return _finished(surface, everything[boxed], found[0])
    points = _thinned(everything)
    for start in (np.eye(4), *_principal_starts(points, surface)):
        tried = _iterate(surface, points, start)
        if found is None or tried[1] < found[1]:
            found = tried
        if found[2] >= _PLAINLY_RIGHT:
            break
    if found is None or found[2] < _LEAST_OVERLAP:
        overlap = 0.0 if found is None else found[2]
        raise DataError(
            f"the cloud does not fit the nominal: {overlap:.0%} of its points come near it",
            remedy="Give alignment.base_from_part about right, crop what is not the part, or check that this is the part's nominal.",
        )
    return _finished(surface, everything, found[0])


def _thinned(points: FloatArray) -> FloatArray:
    return points[:: max(1, len(points) // _THINNED)]


def _near_box(points: FloatArray, surface: NominalSurface) -> NDArray[np.bool_]:
    """Points (n, 3) in the box round the mesh and a little more."""
    low, high = surface.nominal.box_mm
    margin = _BOX_MARGIN * float((high - low).max())
    return np.asarray(((points > low - margin) & (points < high + margin)).all(axis=1))


def _iterate(surface: NominalSurface, points: FloatArray, start: FloatArray) -> tuple[FloatArray, float, float]:
    """Placement, cost of the kept points, and their share within the last limit."""
    size = float(np.ptp(surface.nominal.box_mm, axis=0).max())
    limit, transform, scale = _FIRST_LIMIT * size, start, np.inf
    for _ in range(_ROUNDS):
        near = surface.nearest(se3.apply(transform, points))
        kept = (np.abs(near.signed_mm) < limit) & ~near.at_border
        if kept.sum() < 20:
            return transform, np.inf, 0.0
        residual = near.signed_mm[kept]
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-4)
        weight = (1 - np.clip(residual / max(4.685 * scale, 1e-3), -1, 1) ** 2) ** 2
        twist = _step(near.nearest_mm[kept], near.normal[kept], residual, weight)
        transform = se3.exp(twist) @ transform
        limit = max(min(limit, 6 * scale), _SMALLEST_LIMIT_MM)
        if np.linalg.norm(twist[:3]) + size * np.linalg.norm(twist[3:]) < _SETTLED_MM:
            break
    share = float(np.mean(np.abs(near.signed_mm) < max(_SMALLEST_LIMIT_MM, min(6 * scale, _NEAR * size))))
    return transform, float(np.mean(np.minimum(np.abs(near.signed_mm), 0.02 * size))), share


def _step(nearest: FloatArray, normal: FloatArray, residual: FloatArray, weight: FloatArray) -> FloatArray:
    jacobian = np.column_stack([normal, np.cross(nearest, normal)])
    matrix = (jacobian * weight[:, None]).T @ jacobian
    return np.asarray(-np.linalg.lstsq(matrix, (jacobian * weight[:, None]).T @ residual, rcond=1e-10)[0])


def _finished(surface: NominalSurface, everything: FloatArray, transform: FloatArray) -> BestFit:
    """The last fit, by plain least squares of all points that belong to the part; and how well it is known."""
    stride = max(1, len(everything) // (20 * _THINNED))
    for _ in range(3):
        points = se3.apply(transform, everything[::stride])
        near = surface.nearest(points)
        scale = max(1.4826 * float(np.median(np.abs(near.signed_mm[~near.at_border]))), 1e-4)
        kept = (np.abs(near.signed_mm) < _SCALES * scale) & ~near.at_border
        twist = _step(points[kept], near.normal[kept], near.signed_mm[kept], np.ones(int(kept.sum())))
        transform = se3.exp(twist) @ transform
    used, normal, residual = points[kept], near.normal[kept], near.signed_mm[kept]
    middle = used.mean(axis=0)
    jacobian = np.column_stack([normal, np.cross(used - middle, normal)])
    _require_held(jacobian, used - middle)
    by_origin = np.eye(6)
    by_origin[:3, 3:] = se3.hat(middle)  # a twist about the middle, as one about the origin
    gain = -np.linalg.solve(jacobian.T @ jacobian, jacobian.T).T @ by_origin.T
    labels, size_mm = patches_of(used, _CELLS_ACROSS)
    patches = PatchSums(labels, np.ones(len(labels)))
    by_patch = patches.total((gain[:, :, None] * normal[:, None, :]).reshape(len(gain), -1)).reshape(-1, 6, 3)
    response = Response(patches.mean(used), by_patch, size_mm, gain.sum(axis=0))
    covariance = patch_covariance(gain, residual, used)
    return BestFit(transform, covariance, response, float(np.sqrt(np.mean(residual**2))), int(kept.sum()), len(points))


def _require_held(jacobian: FloatArray, arms: FloatArray) -> None:
    """All six motions must meet resistance."""
    reach = max(float(np.sqrt(np.mean(np.sum(arms**2, axis=1)))), 1e-9)
    scaled = jacobian / np.array([1, 1, 1, reach, reach, reach])
    if np.linalg.eigvalsh(scaled.T @ scaled / len(scaled))[0] < _LEAST_HOLD:
        raise DataError(
            "the points leave the part free to slide or turn on its nominal",
            remedy="Scan more sides of it, or align by datum features, or as measured.",
        )


def _principal_starts(points: FloatArray, surface: NominalSurface) -> list[FloatArray]:
    """The four ways of laying principal axes of the points onto those of the mesh."""
    vertices, faces = surface.nominal.vertices_mm, surface.nominal.faces
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    of_mesh, mesh_axes = _principal(corners.mean(axis=1), area)
    of_points, point_axes = _principal(points, np.ones(len(points)))
    starts = []
    for signs in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
        turned = point_axes * np.array([signs[0], signs[1], signs[0] * signs[1]])
        rotation = mesh_axes @ turned.T
        starts.append(se3.from_rotation_translation(rotation, of_mesh - rotation @ of_points))
    return starts


def _principal(points: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    middle = np.average(points, axis=0, weights=weight)
    axes = np.linalg.eigh(((points - middle) * weight[:, None]).T @ (points - middle))[1]
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return middle, axes


def datum_frame(elements: Sequence[Element]) -> FloatArray:
    """(4, 4) part_from_datums of three features: 3-2-1.

    The primary plane gives z and one coordinate; the secondary plane gives the direction y and one coordinate, or a
    secondary point two; the tertiary gives what is left.

    Raises:
        SettingsError: the three do not fix a frame.
    """
    primary, secondary, tertiary = elements
    if primary.kind != "plane":
        raise SettingsError(f"the primary datum is a {primary.kind}", where="alignment.primary", remedy="Name a plane.")
    z = primary.axis
    if secondary.kind == "plane":
        y = _across(secondary.axis, z, "alignment.secondary")
        x = np.cross(y, z)
        if tertiary.kind == "plane":
            _across(np.cross(tertiary.axis, y), z, "alignment.tertiary", least=0.0)
            third = tertiary.axis, float(tertiary.axis @ tertiary.point_mm)
        else:
            third = x, float(x @ tertiary.point_on(primary))
        return _frame(x, y, z, [(z, primary), (secondary.axis, secondary)], third)
    start = secondary.point_on(primary)
    way = tertiary.axis if tertiary.kind == "plane" else tertiary.point_on(primary) - start
    x = _across(way, z, "alignment.tertiary")
    return se3.from_rotation_translation(np.column_stack([x, np.cross(z, x), z]), start)


def _frame(x: FloatArray, y: FloatArray, z: FloatArray, planes: Sequence[tuple[FloatArray, Element]], third: tuple[FloatArray, float]) -> FloatArray:
    rows = np.array([*(normal for normal, _ in planes), third[0]])
    if np.linalg.cond(rows) > 50:
        raise SettingsError("the three datums do not meet in one point", where="alignment", remedy="Choose planes at right angles to each other.")
    origin = np.linalg.solve(rows, [*(float(e.axis @ e.point_mm) for _, e in planes), third[1]])
    return se3.from_rotation_translation(np.column_stack([x, y, z]), origin)


def _across(way: FloatArray, z: FloatArray, where: str, *, least: float = 0.2) -> FloatArray:
    """The part of a direction at right angles to z, of length 1."""
    across = way - (way @ z) * z
    length = float(np.linalg.norm(across))
    if length <= least * float(np.linalg.norm(way)):
        raise SettingsError("the datum runs along the primary's normal and fixes no direction", where=where, remedy="Choose another feature.")
    return np.asarray(across / max(length, 1e-12))


def datum_alignment(names: Sequence[str], measured: Mapping[str, Element], nominal: Mapping[str, Element]) -> FloatArray:
    """(4, 4) that lays measured datums onto nominal ones."""
    return np.asarray(datum_frame([nominal[n] for n in names]) @ se3.inverse(datum_frame([measured[n] for n in names])))
