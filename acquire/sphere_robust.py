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

_CLEAR_REMEDY = "Something else is in the way, or the camera is far out of its working range."

# a form error is smooth: over the cap it averages like about a dozen independent patches, however many points there are
_FORM_PATCHES = 12.0
_GATE_FLOOR_MM = 0.005
_BEND_MM = 0.3
_BEND_SHARE = 0.02
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
    _check_round(chosen, centre, radius_mm, facing)
    free_radius = _checked_radius(chosen, centre, radius_mm, settings, fit.noise_mm)
    rms = float(np.sqrt(np.mean((np.linalg.norm(chosen - centre, axis=1) - radius_mm) ** 2)))
    _check_rms(rms, fit.noise_mm, radius_mm, settings)
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
    gate = _shell_mm(radius_mm)
    rng = np.random.default_rng(settings.seed)
    few = thinned(points, _ENOUGH, rng)
    centre, selected = start, np.zeros(0, dtype=np.int64)
    for _ in range(_WIDE_STEPS):
        selected = _within_shell(few, centre, radius_mm, gate, settings, facing)
        centre = _step(few, selected, centre, radius_mm)
    _check_curved(few, selected, centre, radius_mm, settings, facing)
    fit = _narrow(few, _Fit(centre, selected, gate), gate, radius_mm, settings, facing)
    if len(few) == len(points):
        return fit
    wide = _within_shell(points, fit.centre, radius_mm, gate, settings, facing)
    return _narrow(points, _Fit(fit.centre, wide, fit.noise_mm), 1.5 * settings.gate_sigmas * fit.noise_mm, radius_mm, settings, facing)


def _shell_mm(radius_mm: float) -> float:
    """How far from the ideal sphere a point may be at first."""
    return float(np.clip(0.08 * radius_mm, 0.5, 2.5))


def _narrow(points: FloatArray, fit: _Fit, gate_mm: float, radius_mm: float, settings: SphereSettings, facing: float) -> _Fit:
    """From a wide selection to one within some sigmas of the smooth form, repeated until it stays the same.

    The gate never opens again: a second surface in the selection would widen it step by step and draw the fit away.
    """
    gate, centre, selected, noise = gate_mm, fit.centre, fit.selected, fit.noise_mm
    for step in range(_NARROW_STEPS):
        before = selected
        deviation, noise = _deviation(points, before, centre, radius_mm, settings, facing)
        gate = min(gate, max(settings.gate_sigmas * noise, 0.5 * gate if step < 3 else 0.0, _GATE_FLOOR_MM))
        selected = np.flatnonzero(deviation < gate)
        _check_count(selected, len(before), settings)
        centre = _step(points, selected, centre, radius_mm)
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

    form = _form(*form_normal(shape(points, centre, _across(centre), radius_mm, facing), selected))
    curvature = radius_mm - float(form[3] + form[5])
    if curvature >= 0.4 * radius_mm:
        return
    if curvature < 0.15 * radius_mm:
        raise SphereNotFound("no_sphere", f"the surface nearest to a sphere of radius {radius_mm:.3f} mm is flat or nearly so", remedy=LOOK_REMEDY)
    # curved, but less: the gate on the free radius says by how much
    _checked_radius(points[selected], centre, radius_mm, settings, 0.0)


def _check_round(points: FloatArray, centre: FloatArray, radius_mm: float, facing: float) -> None:
    """Refuse what bends rightly in one direction only: a pipe of the sphere's radius leaves `R b² / 2` along its axis."""
    from acquire.sphere_fit_kernels import form_normal, shape

    form = _form(*form_normal(shape(points, centre, _across(centre), radius_mm, facing), np.arange(len(points))))
    bends = np.linalg.eigvalsh(np.array([[form[3], form[4] / 2], [form[4] / 2, form[5]]]))
    if np.abs(bends).max() > 0.2 * radius_mm + 2 * _BEND_MM:
        raise SphereNotFound(
            "radius",
            f"the surface bends with radii of {_radius_text(radius_mm, bends[0])} one way and {_radius_text(radius_mm, bends[1])} the other, "
            f"certified is a sphere of {radius_mm:.2f} mm",
            remedy=LOOK_REMEDY,
        )


def _radius_text(radius_mm: float, bend_mm: float) -> str:
    curvature = radius_mm - 2 * bend_mm
    return f"{radius_mm**2 / curvature:.1f} mm" if curvature > 0.02 * radius_mm else "no end"


def _form(normal: FloatArray, right: FloatArray) -> FloatArray:
    """The quadratic form (6,) of normal equations; where few points leave one of its terms open, that stays small."""
    return np.asarray(np.linalg.solve(normal + 1e-9 * normal[0, 0] * np.eye(6), right))


def _limited(form: FloatArray, radius_mm: float) -> FloatArray:
    """A form that bends no more than cameras do: else it would follow a table or a pipe that touches the cap."""
    allowed = _BEND_MM + _BEND_SHARE * radius_mm
    return form * min(1.0, allowed / max(float(np.abs(form).max()), 1e-12))


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


def _deviation(
    points: FloatArray, before: IntArray, centre: FloatArray, radius_mm: float, settings: SphereSettings, facing: float
) -> tuple[FloatArray, float]:
    """How far points (n,) are from the smooth form of those selected before, inf where grazing; robust sigma about it."""
    from acquire.sphere_fit_kernels import form_normal, shape, without_form

    shaped = shape(points, centre, _across(centre), radius_mm, facing)
    rough = without_form(shaped, _limited(_form(*form_normal(shaped, before)), radius_mm))
    deviation = np.abs(rough - np.median(rough[before]))
    noise = 1.4826 * float(np.median(deviation[before]))
    return np.where(shaped[:, 1] >= np.cos(settings.max_incidence_rad), deviation, np.inf), noise


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


def _checked_radius(points: FloatArray, centre: FloatArray, radius_mm: float, settings: SphereSettings, noise_mm: float) -> float:
    try:
        free_centre, free_radius, covariance = fit_free_radius(points, radius_mm, centre)
    except DataError as error:
        raise SphereNotFound("no_sphere", f"the surface nearest to a sphere of radius {radius_mm:.3f} mm is flat", remedy=LOOK_REMEDY) from error
    residual = np.linalg.norm(points - free_centre, axis=1) - free_radius
    # what noise alone does to a free radius; a bad fit must not widen its own gate
    sigma = float(np.sqrt(covariance[3, 3]) * min(noise_mm / max(residual.std(), 1e-12), 1.0))
    allowed = settings.max_radius_error_mm + settings.max_radius_error_share * radius_mm + 5 * sigma
    if abs(free_radius - radius_mm) > allowed:
        raise SphereNotFound(
            "radius",
            f"the surface found has radius {free_radius:.2f} mm, certified is {radius_mm:.2f} mm, {allowed:.2f} mm off is allowed",
            remedy="Is the diameter in the cell file right (a radius written as a diameter?), and is it this sphere?",
        )
    return free_radius


def _check_rms(rms_mm: float, noise_mm: float, radius_mm: float, settings: SphereSettings) -> None:
    allowed = min(settings.max_rms_mm, settings.max_rms_share * radius_mm)
    if rms_mm > allowed:
        raise SphereNotFound(
            "residual",
            f"the points lie {rms_mm:.3f} mm rms from a sphere of radius {radius_mm:.2f} mm, {allowed:.3f} mm is allowed",
            remedy=_CLEAR_REMEDY,
        )
    # points spread evenly over the shell have a robust sigma of 0.74 of its half-width: no surface is there
    if noise_mm > 0.4 * _shell_mm(radius_mm):
        raise SphereNotFound(
            "residual", f"the points scatter by {noise_mm:.3f} mm about a radius of {radius_mm:.2f} mm: no surface is there", remedy=_CLEAR_REMEDY
        )
