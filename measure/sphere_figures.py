"""What a set of sphere views says about a measuring system: scatter of centres, radial rms, size, form, lengths.

Plain arrays in, figures out: the same functions serve the calibrated and the uncalibrated system. Procedure shaped on
the sphere tests of VDI/VDE 2634 (probing error size and form, sphere spacing error); no conformity to it is claimed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquire.sphere_fit import fit_fixed_radius, fit_free_radius
from drivers.errors import DataError

FloatArray = NDArray[np.float64]

FORM_FRACTION = 0.95
"""Share of the points that the form shell must hold."""

_LEAST_POINTS = 10


@dataclass(frozen=True, slots=True, eq=False)
class SphereView:
    """One sphere as one shot shows it, already moved to the base."""

    session: str
    index: int
    sphere: str
    points_in_base_mm: FloatArray
    """(n, 3)."""
    start_in_base_mm: FloatArray
    """(3,) a place behind the surface, from which a fit finds the centre and not its mirror image."""


@dataclass(frozen=True, slots=True)
class SphereSize:
    """What is known of a sphere's size."""

    radius_mm: float
    """Certified."""
    offset_mm: float = 0.0
    """By how much the calibration found the radius to read larger."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewFigures:
    """One view against its sphere."""

    session: str
    index: int
    sphere: str
    n_points: int
    radial_rms_mm: float
    """Rms of |W - c| - R about the centre of all views."""
    centre_in_base_mm: FloatArray | None
    """(3,) fixed-radius centre of this view alone; None for line profiles, which leave one side open."""
    deviation_mm: float | None
    """Distance of that centre from the mean centre of the sphere's views."""


@dataclass(frozen=True, slots=True, eq=False)
class SphereFigures:
    """One sphere over all its views."""

    name: str
    n_views: int
    n_points: int
    centre_in_base_mm: FloatArray
    """(3,) fixed-radius centre of all views together."""
    centre_covariance_mm2: FloatArray
    """(3, 3) from the scatter between the views; zero information with one view."""
    diameter_error_mm: float
    """Free-radius fit of all points together minus the certified diameter."""
    diameter_error_less_offset_mm: float
    """The same minus twice the calibrated radius offset: what is left when the surface's reading is known."""
    diameter_standard_uncertainty_mm: float
    """From the scatter between the views alone."""
    form_mm: float
    """Width of the thinnest concentric shell that holds 95 % of the points."""
    form_all_mm: float
    """Width of the shell that holds them all."""


@dataclass(frozen=True, slots=True, eq=False)
class Figures:
    """All figures of a set of views."""

    views: tuple[ViewFigures, ...]
    spheres: dict[str, SphereFigures]
    radial_rms_mm: float
    centre_rms_mm: float | None
    """sqrt(mean |c_j - mean(c)|²), each sphere about its own mean, pooled; None without two views of a sphere."""
    centre_max_mm: float | None


def figures_of(views: Sequence[SphereView], sizes: Mapping[str, SphereSize], *, line_profile: bool) -> Figures:
    """Figures of all views.

    Args:
        views: at least one.
        sizes: of every sphere named in the views.
        line_profile: single views are arcs and have no centre of their own.

    Raises:
        DataError: no view, or points that do not fix a sphere.
    """
    if not views:
        raise DataError("no shot shows a sphere", remedy="Capture shots of the spheres, or see why they were rejected.")
    names = sorted({view.sphere for view in views})
    by_sphere = {name: [view for view in views if view.sphere == name] for name in names}
    spheres = {name: _sphere_figures(name, members, sizes[name]) for name, members in by_sphere.items()}
    rows = [row for name, members in by_sphere.items() for row in _view_figures(members, sizes[name], spheres[name], line_profile=line_profile)]
    deviations = [row.deviation_mm for row in rows if row.deviation_mm is not None and spheres[row.sphere].n_views > 1]
    n_points = np.array([row.n_points for row in rows], dtype=np.float64)
    mean_squares = np.array([row.radial_rms_mm for row in rows]) ** 2
    return Figures(
        views=tuple(sorted(rows, key=lambda row: (row.session, row.index, row.sphere))),
        spheres=spheres,
        radial_rms_mm=float(np.sqrt(n_points @ mean_squares / n_points.sum())),
        centre_rms_mm=float(np.sqrt(np.mean(np.square(deviations)))) if deviations else None,
        centre_max_mm=float(max(deviations)) if deviations else None,
    )


def shell_width_mm(radii_mm: FloatArray, fraction: float = FORM_FRACTION) -> float:
    """Width of the narrowest interval that holds a fraction of the radii (n,), at least one of them."""
    ordered = np.sort(radii_mm)
    n_held = max(1, int(np.ceil(fraction * len(ordered))))
    return float((ordered[n_held - 1 :] - ordered[: len(ordered) - n_held + 1]).min())


def separation(first: SphereFigures, second: SphereFigures) -> tuple[float, float]:
    """Distance of two centres in mm and its standard uncertainty from the scatter between the views."""
    difference = second.centre_in_base_mm - first.centre_in_base_mm
    distance = float(np.linalg.norm(difference))
    direction = difference / max(distance, 1e-12)
    variance = float(direction @ (first.centre_covariance_mm2 + second.centre_covariance_mm2) @ direction)
    return distance, float(np.sqrt(max(variance, 0.0)))


def _sphere_figures(name: str, views: Sequence[SphereView], size: SphereSize) -> SphereFigures:
    points = np.concatenate([view.points_in_base_mm for view in views])
    if len(points) < _LEAST_POINTS:
        raise DataError(f"{len(points)} points on sphere {name} are too few", remedy="Capture it from nearer, or check its finding.")
    reading_radius = size.radius_mm + size.offset_mm
    start = np.mean([view.start_in_base_mm for view in views], axis=0)
    centre, point_covariance = fit_fixed_radius(points, reading_radius, start)
    free_centre, free_radius, free_covariance = fit_free_radius(points, reading_radius, centre)
    radii = np.linalg.norm(points - free_centre, axis=1)
    groups = np.repeat(np.arange(len(views)), [len(view.points_in_base_mm) for view in views])
    free_covariance = _between_views(points, groups, free_centre, free_radius, free_covariance)
    error = 2.0 * (free_radius - size.radius_mm)
    return SphereFigures(
        name=name,
        n_views=len(views),
        n_points=len(points),
        centre_in_base_mm=centre,
        centre_covariance_mm2=_between_views(points, groups, centre, reading_radius, point_covariance),
        diameter_error_mm=error,
        diameter_error_less_offset_mm=error - 2.0 * size.offset_mm,
        diameter_standard_uncertainty_mm=2.0 * float(np.sqrt(free_covariance[3, 3])),
        form_mm=shell_width_mm(radii),
        form_all_mm=float(np.ptp(radii)),
    )


def _view_figures(views: Sequence[SphereView], size: SphereSize, sphere: SphereFigures, *, line_profile: bool) -> list[ViewFigures]:
    radius = size.radius_mm + size.offset_mm
    centres = [None if line_profile else _view_centre(view, radius, sphere.centre_in_base_mm) for view in views]
    found = [centre for centre in centres if centre is not None]
    mean = np.mean(found, axis=0) if found else None
    rows = []
    for view, centre in zip(views, centres, strict=True):
        residual = np.linalg.norm(view.points_in_base_mm - sphere.centre_in_base_mm, axis=1) - radius
        rows.append(
            ViewFigures(
                session=view.session,
                index=view.index,
                sphere=view.sphere,
                n_points=len(view.points_in_base_mm),
                radial_rms_mm=float(np.sqrt(np.mean(residual**2))),
                centre_in_base_mm=centre,
                deviation_mm=None if centre is None or mean is None else float(np.linalg.norm(centre - mean)),
            )
        )
    return rows


def _view_centre(view: SphereView, radius_mm: float, start_mm: FloatArray) -> FloatArray:
    # the common centre is the best start; a system that is centimetres off needs the one behind the view's own cap
    near = np.linalg.norm(view.start_in_base_mm - start_mm) < 0.5 * radius_mm
    centre, _ = fit_fixed_radius(view.points_in_base_mm, radius_mm, start_mm if near else view.start_in_base_mm)
    return centre


def _between_views(points: FloatArray, groups: NDArray[np.int64], centre: FloatArray, radius_mm: float, fallback: FloatArray) -> FloatArray:
    """Covariance of a least-squares sphere whose errors are common to all points of a view.

    The "sandwich" of cluster-robust statistics (Liang and Zeger 1986): inv(N) (sum g_j g_j') inv(N), g_j = sum of J' r
    over a view. Counting each point as independent would call the mean of 10 shifted views good to micrometres. One
    view cannot show a scatter between views; the points' own covariance `fallback`, (3, 3) or (4, 4) with the radius,
    is then all there is.
    """
    n_views = int(groups[-1]) + 1
    if n_views < 2:
        return fallback
    offset = points - centre
    distance = np.linalg.norm(offset, axis=1)
    design = offset / distance[:, None]
    if len(fallback) == 4:
        design = np.column_stack([design, np.ones(len(design))])
    scores = np.zeros((n_views, design.shape[1]))
    np.add.at(scores, groups, design * (distance - radius_mm)[:, None])
    inverse = np.linalg.inv(design.T @ design)
    between = inverse @ (scores.T @ scores) @ inverse * n_views / (n_views - 1)
    return np.asarray(between + fallback)
