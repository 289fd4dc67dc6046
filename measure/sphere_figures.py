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
from measure.proof.probing import shell_width_mm
from measure.proof.scatter import OwnCentre, ScatterScale, agreed_variance, form_sigma_mm, sandwich, scatter_scale, structured

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

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
    pose_covariance_mm2: FloatArray | None = None
    """(3, 3) by which the view may stand elsewhere as a whole: the shot's pose noise at the sphere; None where nothing is known."""


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
    """From the scatter between the views: what the calibration's noise predicts of it, and more where they show more."""
    form_mm: float
    """Width of the thinnest concentric shell that holds 95 % of the points."""
    form_all_mm: float
    """Width of the shell that holds them all."""
    form_standard_uncertainty_mm: float = 0.0
    """Of `form_mm`, from the scatter between the views."""
    expected_centre_covariance_mm2: FloatArray | None = None
    """(3, 3) of the centre as the views should scatter, corrected by how they do; None with one view of unknown noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Figures:
    """All figures of a set of views."""

    views: tuple[ViewFigures, ...]
    spheres: dict[str, SphereFigures]
    radial_rms_mm: float | None
    """None without a view."""
    centre_rms_mm: float | None
    """sqrt(mean |c_j - mean(c)|²), each sphere about its own mean, pooled; None without two views of a sphere."""
    centre_max_mm: float | None


NO_FIGURES = Figures((), {}, None, None, None)
"""Of no view at all: external reference points alone."""


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
    fits = {name: _fit(name, members, sizes[name]) for name, members in by_sphere.items()}
    own = {name: _own_centres(members, sizes[name], fits[name], line_profile=line_profile) for name, members in by_sphere.items()}
    known = all(view.pose_covariance_mm2 is not None for view in views)
    scale = scatter_scale([[centre for centre in centres if centre is not None] for centres in own.values()], known=known)
    spheres = {name: _sphere_figures(members, sizes[name], fits[name], own[name], scale) for name, members in by_sphere.items()}
    rows = [row for name, members in by_sphere.items() for row in _view_figures(members, sizes[name], spheres[name], own[name])]
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


def separation(first: SphereFigures, second: SphereFigures) -> tuple[float, float]:
    """Distance of two centres in mm and its standard uncertainty from the scatter between the views."""
    difference = second.centre_in_base_mm - first.centre_in_base_mm
    distance = float(np.linalg.norm(difference))
    direction = difference / max(distance, 1e-12)
    seen = float(direction @ (first.centre_covariance_mm2 + second.centre_covariance_mm2) @ direction)
    expected = None
    if first.expected_centre_covariance_mm2 is not None and second.expected_centre_covariance_mm2 is not None:
        expected = float(direction @ (first.expected_centre_covariance_mm2 + second.expected_centre_covariance_mm2) @ direction)
    return distance, float(np.sqrt(max(agreed_variance(expected, seen, first.n_views + second.n_views - 2), 0.0)))


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """All points of a sphere together, with the radius that it reads at, and free."""

    points: FloatArray
    groups: IntArray
    reading_radius_mm: float
    centre: FloatArray
    covariance: FloatArray
    free_centre: FloatArray
    free_radius_mm: float
    free_covariance: FloatArray


def _fit(name: str, views: Sequence[SphereView], size: SphereSize) -> _Fit:
    points = np.concatenate([view.points_in_base_mm for view in views])
    if len(points) < _LEAST_POINTS:
        raise DataError(f"{len(points)} points on sphere {name} are too few", remedy="Capture it from nearer, or check its finding.")
    radius = size.radius_mm + size.offset_mm
    centre, covariance = fit_fixed_radius(points, radius, np.mean([view.start_in_base_mm for view in views], axis=0))
    groups = np.repeat(np.arange(len(views)), [len(view.points_in_base_mm) for view in views])
    return _Fit(points, groups, radius, centre, covariance, *fit_free_radius(points, radius, centre))


def _sphere_figures(views: Sequence[SphereView], size: SphereSize, fit: _Fit, own: Sequence[OwnCentre | None], scale: ScatterScale) -> SphereFigures:
    radii = np.linalg.norm(fit.points - fit.free_centre, axis=1)
    error = 2.0 * (fit.free_radius_mm - size.radius_mm)
    common, free = (fit.centre, fit.reading_radius_mm), (fit.free_centre, fit.free_radius_mm)
    seen = float(sandwich(fit.points, fit.groups, *free, fit.free_covariance)[3, 3])
    moves = [scale.factor * centre.covariance_mm2 for centre in own if centre is not None]
    expected, expected_radius, form_sigma = None, None, 0.0
    if len(moves) == len(views) and (len(views) > 1 or scale.known):
        expected = structured(fit.points, fit.groups, *common, moves, fit.covariance)
        expected_radius = float(structured(fit.points, fit.groups, *free, moves, fit.free_covariance)[3, 3])
        form_sigma = form_sigma_mm(fit.points, fit.groups, *free, moves, FORM_FRACTION)
    return SphereFigures(
        name=views[0].sphere,
        n_views=len(views),
        n_points=len(fit.points),
        centre_in_base_mm=fit.centre,
        centre_covariance_mm2=sandwich(fit.points, fit.groups, *common, fit.covariance),
        diameter_error_mm=error,
        diameter_error_less_offset_mm=error - 2.0 * size.offset_mm,
        diameter_standard_uncertainty_mm=2.0 * float(np.sqrt(agreed_variance(expected_radius, seen, len(views) - 1))),
        form_mm=shell_width_mm(radii, FORM_FRACTION),
        form_all_mm=float(np.ptp(radii)),
        form_standard_uncertainty_mm=form_sigma,
        expected_centre_covariance_mm2=expected,
    )


def _view_figures(views: Sequence[SphereView], size: SphereSize, sphere: SphereFigures, own: Sequence[OwnCentre | None]) -> list[ViewFigures]:
    radius = size.radius_mm + size.offset_mm
    found = [centre.centre_in_base_mm for centre in own if centre is not None]
    mean = np.mean(found, axis=0) if found else None
    rows = []
    for view, of_view in zip(views, own, strict=True):
        residual = np.linalg.norm(view.points_in_base_mm - sphere.centre_in_base_mm, axis=1) - radius
        centre = None if of_view is None else of_view.centre_in_base_mm
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


def _own_centres(views: Sequence[SphereView], size: SphereSize, fit: _Fit, *, line_profile: bool) -> list[OwnCentre | None]:
    """Each view's own centre; none for the arcs of a line profile."""
    if line_profile:
        return [None] * len(views)
    return [_own_centre(view, size.radius_mm + size.offset_mm, fit.centre) for view in views]


def _own_centre(view: SphereView, radius_mm: float, start_mm: FloatArray) -> OwnCentre:
    # the common centre is the best start; a system that is centimetres off needs the one behind the view's own cap
    near = np.linalg.norm(view.start_in_base_mm - start_mm) < 0.5 * radius_mm
    centre, covariance = fit_fixed_radius(view.points_in_base_mm, radius_mm, start_mm if near else view.start_in_base_mm)
    moves = np.eye(3) if view.pose_covariance_mm2 is None else view.pose_covariance_mm2
    return OwnCentre(centre, covariance + moves)
