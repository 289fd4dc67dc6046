"""Robust fit of one candidate sphere, and the gates that it must pass.

Selection is symmetric about the surface that the camera sees, not about the ideal sphere: a quadratic form over the
cap (shift, tilt, bend) is taken off before points are judged, so that a depth error or a radius that reads large
does not trim one side only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acquire.sphere_data import FloatArray, IntArray, SphereFinding, SphereNotFound, SphereSettings
from acquire.sphere_fit import fit_fixed_radius, fit_free_radius
from acquire.sphere_search import ValidPoints, near, thinned
from drivers.errors import DataError

LOOK_REMEDY = "Look at the scan: is the sphere in view, in focus, and its diameter in the cell file right?"

# a form error is smooth: over the cap it averages like about a dozen independent patches, however many points there are
_FORM_PATCHES = 12.0
_GATE_FLOOR_MM = 0.005
_WIDE_STEPS = 3
_NARROW_STEPS = 14
_ENOUGH = 6000


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """One candidate after the robust fit."""

    centre: FloatArray
    selected: IntArray
    noise_mm: float


def fit_and_judge(start: FloatArray, scan: ValidPoints, radius_mm: float, settings: SphereSettings, facing: float = 1.0) -> SphereFinding:
    """Robust fit from a start and all gates; `facing` -1 looks for hollows."""
    around = near(scan.points_mm, start, 2.0 * radius_mm)
    points = scan.points_mm[around]
    fit = _robust_fit(points, start, radius_mm, settings, facing)
    chosen = points[fit.selected]
    share = _visible_share(points, fit, radius_mm)
    if share < settings.min_visible_share:
        raise SphereNotFound(
            "no_sphere", f"of the points seen where a sphere of radius {radius_mm:.3f} mm might be only {share:.0%} lie on it", remedy=LOOK_REMEDY
        )
    centre, covariance = fit_fixed_radius(chosen, radius_mm, fit.centre)
    half_angle, coverage = _cap(chosen, centre)
    _check_cap(half_angle, coverage, settings)
    free_radius = _checked_radius(chosen, centre, radius_mm, settings)
    rms = float(np.sqrt(np.mean((np.linalg.norm(chosen - centre, axis=1) - radius_mm) ** 2)))
    _check_rms(rms, radius_mm, settings)
    form_variance = max(rms**2 - fit.noise_mm**2, 0.0)
    inflation = (fit.noise_mm**2 + form_variance * max(len(chosen) / _FORM_PATCHES, 1.0)) / max(rms**2, 1e-18)
    return SphereFinding(
        centre_in_camera_mm=centre,
        covariance_mm2=covariance * inflation,
        points_in_camera_mm=chosen,
        indices=scan.indices[around][fit.selected],
        rms_mm=rms,
        noise_mm=fit.noise_mm,
        free_radius_mm=free_radius,
        cap_half_angle_rad=half_angle,
        azimuth_coverage=coverage,
        visible_share=share,
        runner_up=0.0,
    )


def _robust_fit(points: FloatArray, start: FloatArray, radius_mm: float, settings: SphereSettings, facing: float) -> _Fit:
    """Alternate the known-radius fit and the selection, with a gate that narrows to some sigmas, until nothing changes.

    Large clouds are first fitted on a part of their points, which gives start and gate for all of them.
    """
    gate = float(np.clip(0.08 * radius_mm, 0.8, 2.5))
    rng = np.random.default_rng(settings.seed)
    few = thinned(points, _ENOUGH, rng)
    centre, selected = start, np.zeros(0, dtype=np.int64)
    for _ in range(_WIDE_STEPS):
        selected = _within_shell(few, centre, radius_mm, gate, settings, facing)
        centre = _step(few, selected, centre, radius_mm)
    _check_curved(few, selected, centre, radius_mm, settings, facing)
    fit = _narrow(few, _Fit(centre, selected, gate), radius_mm, settings, facing)
    if len(few) == len(points):
        return fit
    wide = _within_shell(points, fit.centre, radius_mm, gate, settings, facing)
    return _narrow(points, _Fit(fit.centre, wide, fit.noise_mm), radius_mm, settings, facing)


def _narrow(points: FloatArray, fit: _Fit, radius_mm: float, settings: SphereSettings, facing: float) -> _Fit:
    """From a wide selection to one within some sigmas of the smooth form, repeated until it stays the same."""
    gate = settings.gate_sigmas * fit.noise_mm
    centre, selected, noise = fit.centre, fit.selected, fit.noise_mm
    for step in range(_NARROW_STEPS):
        before = selected
        selected, noise = _within_noise(points, before, centre, radius_mm, gate, settings, facing)
        centre = _step(points, selected, centre, radius_mm)
        gate = max(settings.gate_sigmas * noise, 0.5 * gate if step < 3 else 0.0, _GATE_FLOOR_MM)
        if step > 3 and np.array_equal(before, selected):
            break
    return _Fit(centre=centre, selected=selected, noise_mm=noise)


def _check_curved(
    points: FloatArray, selected: IntArray, centre: FloatArray, radius_mm: float, settings: SphereSettings, facing: float
) -> None:
    """Refuse early what a sphere of another size or a plane leaves: a residual that grows with the square of the place.

    Over a cap of radius r the residual from radius R is `(R - R²/r) (a² + b²) / 2`, (a, b) the normal's lateral parts.
    """
    from acquire.sphere_fit_kernels import form_normal, shape

    normal, right = form_normal(shape(points, centre, _across(centre), radius_mm, facing), selected)
    form = np.linalg.solve(normal + 1e-9 * len(selected) * np.eye(6), right)
    curvature = radius_mm - float(form[3] + form[5])
    if curvature >= 0.4 * radius_mm:
        return
    if curvature < 0.15 * radius_mm:
        raise SphereNotFound("no_sphere", f"the surface nearest to a sphere of radius {radius_mm:.3f} mm is flat or nearly so", remedy=LOOK_REMEDY)
    # curved, but less: the gate on the free radius says by how much
    _checked_radius(points[selected], centre, radius_mm, settings)


def _within_shell(
    points: FloatArray, centre: FloatArray, radius_mm: float, gate_mm: float, settings: SphereSettings, facing: float
) -> IntArray:
    """Rows of the points within a gate of the ideal sphere and not grazing."""
    from acquire.sphere_fit_kernels import shape

    shaped = shape(points, centre, _across(centre), radius_mm, facing)
    near_it = np.abs(shaped[:, 0]) < gate_mm
    selected = np.flatnonzero(near_it & (shaped[:, 1] >= np.cos(settings.max_incidence_rad)))
    _check_count(selected, int(near_it.sum()), settings)
    return selected


def _within_noise(
    points: FloatArray, before: IntArray, centre: FloatArray, radius_mm: float, gate_mm: float, settings: SphereSettings, facing: float
) -> tuple[IntArray, float]:
    """Rows of the points within a gate of the smooth form of those selected before, and the robust sigma about it."""
    from acquire.sphere_fit_kernels import form_normal, shape, without_form

    shaped = shape(points, centre, _across(centre), radius_mm, facing)
    normal, right = form_normal(shaped, before)
    form = np.linalg.solve(normal + 1e-9 * len(before) * np.eye(6), right)
    rough = without_form(shaped, np.asarray(form, dtype=np.float64))
    middle = float(np.median(rough[before]))
    noise = 1.4826 * float(np.median(np.abs(rough[before] - middle)))
    inside = (np.abs(rough - middle) < min(gate_mm, max(settings.gate_sigmas * noise, _GATE_FLOOR_MM, 0.5 * gate_mm)))
    selected = np.flatnonzero(inside & (shaped[:, 1] >= np.cos(settings.max_incidence_rad)))
    _check_count(selected, len(before), settings)
    return selected, noise


def _step(points: FloatArray, selected: IntArray, centre: FloatArray, radius_mm: float) -> FloatArray:
    """One Gauss-Newton step of the centre, radius known."""
    from acquire.sphere_fit_kernels import fixed_radius_normal

    normal, right = fixed_radius_normal(points, selected, centre, radius_mm)
    ridge = 1e-6 * len(selected) * np.eye(3)
    return np.asarray(centre + np.linalg.solve(normal + ridge, right))


def _check_count(selected: IntArray, n_before_incidence: int, settings: SphereSettings) -> None:
    if len(selected) >= settings.min_points:
        return
    if n_before_incidence >= settings.min_points:
        raise SphereNotFound(
            "incidence",
            f"{n_before_incidence} points lie on the sphere, but only {len(selected)} of them are seen at less than "
            f"{np.degrees(settings.max_incidence_rad):.0f} degrees; {settings.min_points} needed",
            remedy="Take the shot so that the side of the sphere that faces the camera is seen.",
        )
    raise SphereNotFound(
        "too_few_points", f"{len(selected)} points lie on the sphere, {settings.min_points} needed", remedy="Go nearer, or check the exposure."
    )


def _across(centre: FloatArray) -> FloatArray:
    """Two unit vectors (2, 3) square to the line of sight."""
    sight = centre / np.linalg.norm(centre)
    first = np.cross(sight, np.eye(3)[int(np.argmin(np.abs(sight)))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(sight, first)])


def _visible_share(points: FloatArray, fit: _Fit, radius_mm: float) -> float:
    """Of the points whose line of sight meets the middle of the sphere, the share that was selected."""
    from acquire.sphere_fit_kernels import share_at_middle

    on_it = np.zeros(len(points), dtype=np.bool_)
    on_it[fit.selected] = True
    return share_at_middle(points, fit.centre, radius_mm, on_it)


def _cap(points: FloatArray, centre: FloatArray) -> tuple[float, float]:
    """Half angle of the cap about the line of sight, and the share of directions round it that hold points."""
    normal = (points - centre) / np.linalg.norm(points - centre, axis=1)[:, None]
    lean = np.arccos(np.clip(-normal @ (centre / np.linalg.norm(centre)), -1.0, 1.0))
    half_angle = float(np.quantile(lean, 0.98))
    outer = normal[lean > 0.4 * half_angle] @ _across(centre).T
    n_bins = int(np.clip(len(outer) // 10, 8, 36))
    bins = np.floor((np.arctan2(outer[:, 1], outer[:, 0]) / (2 * np.pi) + 0.5) * n_bins).astype(np.int64) % n_bins
    # a bin counts from a tenth of its fair share on: a stray point is no coverage
    filled = np.bincount(bins, minlength=n_bins) >= max(0.1 * len(outer) / n_bins, 1.0)
    return half_angle, float(filled.mean())


def _check_cap(half_angle_rad: float, coverage: float, settings: SphereSettings) -> None:
    if half_angle_rad < settings.min_cap_half_angle_rad or coverage < settings.min_azimuth_coverage:
        raise SphereNotFound(
            "coverage",
            f"the cap reaches {np.degrees(half_angle_rad):.0f} degrees from the line of sight over {coverage:.0%} of the directions round it; "
            f"{np.degrees(settings.min_cap_half_angle_rad):.0f} degrees and {settings.min_azimuth_coverage:.0%} needed",
            remedy="The sphere is half hidden, at the border of the view, or badly exposed: change the pose.",
        )


def _checked_radius(points: FloatArray, centre: FloatArray, radius_mm: float, settings: SphereSettings) -> float:
    try:
        _, free_radius, covariance = fit_free_radius(points, radius_mm, centre)
    except DataError as error:
        raise SphereNotFound("radius", f"the surface found is flat, certified radius is {radius_mm:.2f} mm", remedy=LOOK_REMEDY) from error
    allowed = settings.max_radius_error_mm + settings.max_radius_error_share * radius_mm + 5 * float(np.sqrt(covariance[3, 3]))
    if abs(free_radius - radius_mm) > allowed:
        raise SphereNotFound(
            "radius",
            f"the surface found has radius {free_radius:.2f} mm, certified is {radius_mm:.2f} mm, {allowed:.2f} mm off is allowed",
            remedy="Is the diameter in the cell file right (a radius written as a diameter?), and is it this sphere?",
        )
    return free_radius


def _check_rms(rms_mm: float, radius_mm: float, settings: SphereSettings) -> None:
    allowed = min(settings.max_rms_mm, settings.max_rms_share * radius_mm)
    if rms_mm > allowed:
        raise SphereNotFound(
            "residual",
            f"the points lie {rms_mm:.3f} mm rms from a sphere of radius {radius_mm:.2f} mm, {allowed:.3f} mm is allowed",
            remedy="Something else is in the way, or the camera is far out of its working range.",
        )
