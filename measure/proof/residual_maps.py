"""What verification leaves over, binned for pictures: form of the spheres, and radial residual over the camera's view.

The points themselves are not kept; a map is a few hundred numbers however many points there were.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from acquire.sphere_fit import fit_free_radius
from calibrate.observations import SphereShot
from drivers.kinematics.se3 import FloatArray
from measure.sphere_figures import Figures, SphereSize, SphereView

MOST_SPHERES = 6
LEAST_IN_BIN = 3
"""Points that a bin must hold to show a mean."""

_AZIMUTH_EDGES_RAD = np.linspace(-np.pi, np.pi, 25)
_ELEVATION_EDGES_RAD = np.linspace(-np.pi / 2, np.pi / 2, 13)
_ACROSS = 16
_THIN_MM = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class BinnedMap:
    """Means over a grid of bins, in mm."""

    x_edges: FloatArray
    """(nx + 1,)."""
    y_edges: FloatArray
    """(ny + 1,)."""
    mean_mm: FloatArray
    """(ny, nx); NaN where a bin holds fewer than `LEAST_IN_BIN` points."""


@dataclass(frozen=True, slots=True, eq=False)
class FormMap:
    """One sphere's stitched points against their own best-fit sphere; edges in rad: azimuth about the base's z, elevation over its x-y plane."""

    sphere: str
    n_views: int
    form_mm: float
    """As judged: 95 % of the points."""
    deviation: BinnedMap


@dataclass(frozen=True, slots=True, eq=False)
class CameraMaps:
    """Radial residual of all points over where the camera saw them, axes in mm of the camera frame."""

    over_x_z: BinnedMap
    over_x_y: BinnedMap | None
    """None for a camera that sees a single line."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidualMaps:
    """What the pictures of a verification need of its points."""

    forms: tuple[FormMap, ...]
    """At most `MOST_SPHERES`, the worst first."""
    camera: CameraMaps


def residual_maps(shots: Sequence[SphereShot], views: Sequence[SphereView], figures: Figures, sizes: Mapping[str, SphereSize]) -> ResidualMaps:
    """Maps of a verification.

    Args:
        shots: at least one.
        views: the same shots, in the same order, moved to the base.
        figures: of these views.
        sizes: of their spheres.
    """
    worst = sorted(figures.spheres.values(), key=lambda sphere: -sphere.form_mm)[:MOST_SPHERES]
    forms = []
    for sphere in worst:
        points = np.concatenate([view.points_in_base_mm for view in views if view.sphere == sphere.name])
        deviation = form_map(points, sizes[sphere.name].radius_mm, sphere.centre_in_base_mm)
        forms.append(FormMap(sphere.name, sphere.n_views, sphere.form_mm, deviation))
    in_camera = np.concatenate([shot.points_in_camera_mm for shot in shots])
    left = np.concatenate([_radial_mm(view, figures, sizes[view.sphere]) for view in views])
    return ResidualMaps(tuple(forms), camera_maps(in_camera, left))


def form_map(points_in_base_mm: FloatArray, radius_mm: float, centre_in_base_mm: FloatArray) -> BinnedMap:
    """Mean signed distance of points (n, 3) from their own best-fit sphere, over 15 degrees of azimuth and elevation.

    Args:
        points_in_base_mm: at least five, that fix a sphere.
        radius_mm: where the fit starts.
        centre_in_base_mm: (3,) where it starts.
    """
    centre, radius, _ = fit_free_radius(points_in_base_mm, radius_mm, centre_in_base_mm)
    x, y, z = (points_in_base_mm - centre).T
    distance = np.sqrt(x**2 + y**2 + z**2)
    elevation = np.arcsin(np.clip(z / np.maximum(distance, 1e-12), -1.0, 1.0))
    return _binned(np.arctan2(y, x), elevation, distance - radius, _AZIMUTH_EDGES_RAD, _ELEVATION_EDGES_RAD)


def camera_maps(points_in_camera_mm: FloatArray, residual_mm: FloatArray) -> CameraMaps:
    """Means of residuals (n,) over the box of points (n, 3), x over z and x over y."""
    edges = [_edges_mm(points_in_camera_mm[:, axis]) for axis in range(3)]
    x, y, z = points_in_camera_mm.T
    thin = float(np.ptp(y)) < _THIN_MM
    return CameraMaps(
        over_x_z=_binned(x, z, residual_mm, edges[0], edges[2]),
        over_x_y=None if thin else _binned(x, y, residual_mm, edges[0], edges[1]),
    )


def _radial_mm(view: SphereView, figures: Figures, size: SphereSize) -> FloatArray:
    """(n,) distance of a view's points from the centre of all views, less the radius that the sphere reads at."""
    distance = np.linalg.norm(view.points_in_base_mm - figures.spheres[view.sphere].centre_in_base_mm, axis=1)
    return np.asarray(distance - size.radius_mm - size.offset_mm)


def _edges_mm(values_mm: FloatArray) -> FloatArray:
    low, high = float(values_mm.min()), float(values_mm.max())
    spare = max(0.0, 0.5 * (_THIN_MM - (high - low)))
    return np.linspace(low - spare, high + spare, _ACROSS + 1)


def _binned(x: FloatArray, y: FloatArray, values_mm: FloatArray, x_edges: FloatArray, y_edges: FloatArray) -> BinnedMap:
    """Every edge is equally far from the next."""
    column, row = (
        np.clip(((at - edges[0]) / (edges[1] - edges[0])).astype(np.int64), 0, len(edges) - 2) for at, edges in ((x, x_edges), (y, y_edges))
    )
    shape = (len(y_edges) - 1, len(x_edges) - 1)
    place = row * shape[1] + column
    count = np.bincount(place, minlength=shape[0] * shape[1])
    total = np.bincount(place, weights=values_mm, minlength=shape[0] * shape[1])
    mean = np.where(count >= LEAST_IN_BIN, total / np.maximum(count, 1), np.nan)
    return BinnedMap(x_edges, y_edges, mean.reshape(shape))
