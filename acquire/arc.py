"""Find the arc of a sphere in a line profile: circles of any radius up to the sphere's, in the plane of the profile.

A plane cuts the sphere at an unknown distance beside its centre, so the circle's radius is free; one arc says
nothing about the side (the centre is at +y or -y of the plane). The solver works on the points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquire.sphere_data import ArcFinding, FloatArray, IntArray, SphereNotFound, SphereSettings

_HYPOTHESES = 600
_SCORED = 1500
_REMEDY = "Look at the profile: is the sphere in it, and its diameter in the cell file right?"


def find_arc(xyz_mm: NDArray[Any], *, radius_mm: float, settings: SphereSettings | None = None) -> ArcFinding:
    """The arc of the sphere in one line profile.

    Args:
        xyz_mm: (n, 3) or (height, width, 3), camera frame, all in one plane y = const; NaN or all-zero where invalid.
        radius_mm: certified radius of the sphere.
        settings: gates.

    Raises:
        SphereNotFound: with `.reason` and, in the message, the numbers that led to it.
    """
    settings = settings or SphereSettings()
    flat = np.asarray(xyz_mm, dtype=np.float64).reshape(-1, 3)
    rows = np.flatnonzero(np.isfinite(flat).all(axis=1) & (flat != 0).any(axis=1))
    _check_profile(flat[rows], radius_mm, settings)
    plane = flat[rows][:, [0, 2]]
    circle = _ransac(plane, radius_mm, settings)
    circle, selected = _refine(plane, circle, radius_mm, settings)
    residual = np.hypot(*(plane[selected] - circle[:2]).T) - circle[2]
    angle = _turn(plane[selected], circle)
    if angle < settings.min_arc_angle_rad:
        raise SphereNotFound(
            "coverage",
            f"the arc turns through {np.degrees(angle):.0f} degrees, {np.degrees(settings.min_arc_angle_rad):.0f} needed",
            remedy="Take the profile nearer to the middle of the sphere.",
        )
    return ArcFinding(
        points_in_camera_mm=flat[rows[selected]],
        indices=rows[selected],
        rms_mm=float(np.sqrt(np.mean(residual**2))),
        arc_radius_mm=float(circle[2]),
        arc_centre_in_camera_mm=np.array([circle[0], float(np.median(flat[rows, 1])), circle[1]]),
        side_offset_mm=float(np.sqrt(max(radius_mm**2 - circle[2] ** 2, 0.0))),
        arc_angle_rad=angle,
    )


def _check_profile(points: FloatArray, radius_mm: float, settings: SphereSettings) -> None:
    if len(points) == 0:
        raise SphereNotFound("no_points", "the profile holds no valid point", remedy="Check exposure and distance; every point is NaN or zero.")
    if len(points) < settings.min_points:
        raise SphereNotFound(
            "too_few_points", f"the profile holds {len(points)} valid points, {settings.min_points} needed", remedy="Check exposure and distance."
        )
    spread = np.ptp(points, axis=0)
    if spread.max() < 0.01 * radius_mm:
        raise SphereNotFound(
            "unit_metres",
            f"the whole profile is {spread.max():.4f} mm wide and the sphere's radius is {radius_mm:.2f} mm",
            remedy="The scan is in metres; spherecal wants mm: multiply by 1000 or set the sensor's unit.",
        )
    if spread[1] > 0.01 * radius_mm:
        raise SphereNotFound(
            "not_a_profile",
            f"the points spread {spread[1]:.2f} mm along y, a line profile lies in one plane y = const",
            remedy="Set `kind: area` for this camera in the cell file, or put the profile's depth into z.",
        )


def _largest_radius_mm(radius_mm: float, settings: SphereSettings) -> float:
    return radius_mm * (1 + settings.max_radius_error_share) + settings.max_radius_error_mm


def _ransac(plane: FloatArray, radius_mm: float, settings: SphereSettings) -> FloatArray:
    """(x, z, r) of the circle that most points lie on: triples from windows of every size, scored on a subsample."""
    rng = np.random.default_rng(settings.seed)
    n = len(plane)
    # partners near the first point: an arc that is a tenth of the profile is then found as surely as a whole one
    by_x = plane[np.argsort(plane[:, 0], kind="stable")]
    window = np.exp(rng.uniform(np.log(0.04), 0.0, (_HYPOTHESES, 1))) * n
    first = rng.uniform(0, n, (_HYPOTHESES, 1))
    places = first + (rng.uniform(-0.5, 0.5, (_HYPOTHESES, 3))) * window
    triples = by_x[np.clip(places, 0, n - 1).astype(np.int64)]
    circles = _circles(triples)
    fits = (circles[:, 2] <= _largest_radius_mm(radius_mm, settings)) & (circles[:, 2] >= settings.min_arc_radius_share * radius_mm)
    circles = circles[fits]
    scored = plane if n <= _SCORED else plane[np.unique(rng.integers(0, n, _SCORED))]
    if len(circles) == 0:
        raise SphereNotFound("no_arc", f"no arc of radius up to {radius_mm:.2f} mm among {n} points", remedy=_REMEDY)
    distance = np.hypot(scored[None, :, 0] - circles[:, :1], scored[None, :, 1] - circles[:, 1:2])
    tolerance = np.clip(0.005 * radius_mm, 0.05, 0.3)
    hits = (np.abs(distance - circles[:, 2:3]) < tolerance).sum(axis=1)
    return np.asarray(circles[int(np.argmax(hits))])


def _circles(triples: FloatArray) -> FloatArray:
    """Circles (k, 3) = (x, z, r) through three points each (k, 3, 2); NaN radius where they lie on a line."""
    a, b = triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0]
    cross = 2 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    aa, bb = (a**2).sum(axis=1), (b**2).sum(axis=1)
    scale = np.where(np.abs(cross) > 1e-9, cross, np.nan)
    centre = np.stack([b[:, 1] * aa - a[:, 1] * bb, a[:, 0] * bb - b[:, 0] * aa], axis=1) / scale[:, None]
    return np.column_stack([centre + triples[:, 0], np.hypot(centre[:, 0], centre[:, 1])])


def _refine(plane: FloatArray, circle: FloatArray, radius_mm: float, settings: SphereSettings) -> tuple[FloatArray, IntArray]:
    gate = float(np.clip(0.02 * radius_mm, 0.2, 1.0))
    selected = np.zeros(0, dtype=np.int64)
    side = _side(plane, circle, gate)
    for step in range(20):
        offset = plane - circle[:2]
        residual = np.hypot(offset[:, 0], offset[:, 1]) - circle[2]
        facing = side * offset[:, 1] > np.cos(settings.max_arc_angle_rad) * circle[2]
        chosen = np.flatnonzero(facing & (np.abs(residual) < gate))
        if len(chosen) < settings.min_points:
            raise SphereNotFound("too_few_points", f"{len(chosen)} points lie on the best arc, {settings.min_points} needed", remedy=_REMEDY)
        settled = step > 4 and np.array_equal(chosen, selected)
        selected = chosen
        noise = 1.4826 * float(np.median(np.abs(residual[selected] - np.median(residual[selected]))))
        circle = circle + _circle_step(plane[selected], circle)
        gate = max(settings.gate_sigmas * noise, 0.5 * gate, 0.005) if step < 4 else max(settings.gate_sigmas * noise, 0.005)
        if settled:
            break
    if not settings.min_arc_radius_share * radius_mm <= circle[2] <= _largest_radius_mm(radius_mm, settings):
        raise SphereNotFound("radius", f"the arc has radius {circle[2]:.2f} mm, the sphere {radius_mm:.2f} mm", remedy=_REMEDY)
    return circle, selected


def _side(plane: FloatArray, circle: FloatArray, gate_mm: float) -> float:
    """+1 or -1: the side of the circle that the arc is on faces the sensor, whichever way its z points."""
    offset = plane - circle[:2]
    on_it = np.abs(np.hypot(offset[:, 0], offset[:, 1]) - circle[2]) < gate_mm
    return float(np.sign(np.median(offset[on_it, 1])))


def _circle_step(points: FloatArray, circle: FloatArray) -> FloatArray:
    """One Gauss-Newton step of the free-radius circle."""
    offset = points - circle[:2]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    design = np.column_stack([offset / distance[:, None], np.ones(len(points))])
    return np.asarray(np.linalg.lstsq(design, distance - circle[2], rcond=None)[0])


def _turn(points: FloatArray, circle: FloatArray) -> float:
    """Angle over which the points turn round the circle's centre."""
    angle = np.arctan2(points[:, 0] - circle[0], np.abs(points[:, 1] - circle[1]))
    return float(np.quantile(angle, 0.99) - np.quantile(angle, 0.01))
