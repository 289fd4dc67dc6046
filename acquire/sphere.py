"""Find a sphere of certified radius in a scan: coarse search, robust fit, gates that say why not.

    finding = find_sphere(xyz_mm, radius_mm=19.05, settings=SphereSettings())

Area cameras stand at the origin of the camera frame and see the near side of a sphere. Selection is symmetric about
the surface that the camera sees, not about the ideal sphere: a smooth form (shift, tilt and bend over the cap) is
taken off before points are judged, so that a depth error or a radius that reads large never trims one side only.
Line profiles: `find_arc`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquire.arc import find_arc
from acquire.sphere_data import ArcFinding, FloatArray, Reason, SphereFinding, SphereNotFound, SphereSettings
from acquire.sphere_fit import fit_fixed_radius, fit_free_radius
from acquire.sphere_robust import LOOK_REMEDY, fit_and_judge
from acquire.sphere_search import Candidate, ValidPoints, search, valid_points

__all__ = [
    "ArcFinding",
    "Reason",
    "SphereFinding",
    "SphereNotFound",
    "SphereSettings",
    "find_arc",
    "find_sphere",
    "find_spheres",
    "fit_fixed_radius",
    "fit_free_radius",
]

_METRES_BELOW_MM = 5.0
# support of a flat table, as a share of a whole sphere's, stays below
_WORTH_A_LOOK = 0.33
_ELSEWHERE = 5.0


def find_sphere(
    xyz_mm: NDArray[Any],
    *,
    radius_mm: float,
    settings: SphereSettings | None = None,
    predicted_centre_in_camera_mm: ArrayLike | None = None,
) -> SphereFinding:
    """The sphere of this radius in a scan; with a prediction the one nearest to it, else the only one.

    Args:
        xyz_mm: (n, 3) or (height, width, 3), camera frame, NaN or all-zero where invalid.
        radius_mm: certified radius.
        settings: gates; the defaults suit 5..60 mm spheres at 200..1000 mm.
        predicted_centre_in_camera_mm: (3,) where the centre should be, within `settings.search_radius_mm`.

    Raises:
        SphereNotFound: with `.reason` and, in the message, the numbers that led to it.
    """
    settings = settings or SphereSettings()
    predicted = None if predicted_centre_in_camera_mm is None else np.asarray(predicted_centre_in_camera_mm, dtype=np.float64)
    found = find_spheres(xyz_mm, radius_mm=radius_mm, settings=settings, predicted_centre_in_camera_mm=predicted)
    if predicted is None:
        return _only_one(found, settings)
    return min(found, key=lambda finding: float(np.linalg.norm(finding.centre_in_camera_mm - predicted)))


def find_spheres(
    xyz_mm: NDArray[Any],
    *,
    radius_mm: float,
    settings: SphereSettings | None = None,
    predicted_centre_in_camera_mm: ArrayLike | None = None,
) -> tuple[SphereFinding, ...]:
    """Every sphere of this radius that passes the gates, best supported first; at least one, or SphereNotFound.

    Arguments as for `find_sphere`; with a prediction only spheres within `settings.search_radius_mm` of it.
    """
    settings = settings or SphereSettings()
    predicted = None if predicted_centre_in_camera_mm is None else np.asarray(predicted_centre_in_camera_mm, dtype=np.float64)
    try:
        return _find_near(xyz_mm, radius_mm, settings, predicted)
    except SphereNotFound:
        if predicted is not None:
            _refuse_elsewhere(xyz_mm, radius_mm, settings, predicted)
        raise


def _find_near(xyz_mm: NDArray[Any], radius_mm: float, settings: SphereSettings, predicted: FloatArray | None) -> tuple[SphereFinding, ...]:
    reach = settings.search_radius_mm + 1.5 * radius_mm
    scan = valid_points(xyz_mm, centre_mm=predicted, reach_mm=reach, furthest_mm=settings.furthest_mm)
    _check_scan(scan, settings, predicted)
    rng = np.random.default_rng(settings.seed)
    candidates = search(scan.points_mm, radius_mm, rng=rng, least_share=0.6 * settings.min_visible_share)
    found, refused = _judge(candidates, scan, radius_mm, settings, predicted)
    if found:
        return found
    _refuse_hollow(scan, radius_mm, settings)
    raise refused or SphereNotFound(
        "no_sphere", f"no surface of radius {radius_mm:.3f} mm among {len(scan.points_mm)} points{_near_text(predicted)}", remedy=LOOK_REMEDY
    )


def _refuse_elsewhere(xyz_mm: NDArray[Any], radius_mm: float, settings: SphereSettings, predicted: FloatArray) -> None:
    """Raise the reason `far_from_prediction` where the scan holds one such sphere, further off than the search reaches.

    Only up to some search radii: what is further away is rather another sphere of the cell.
    """
    try:
        found = _find_near(xyz_mm, radius_mm, settings, None)
    except SphereNotFound:
        return
    distance = float(np.linalg.norm(found[0].centre_in_camera_mm - predicted))
    if len(found) == 1 and distance <= _ELSEWHERE * settings.search_radius_mm:
        raise _far(distance, settings)


def _check_scan(scan: ValidPoints, settings: SphereSettings, predicted: FloatArray | None) -> None:
    if scan.n_valid == 0:
        raise SphereNotFound("no_points", "the scan holds no valid point", remedy="Check exposure and distance; every point is NaN or zero.")
    if scan.largest_mm < _METRES_BELOW_MM:
        raise SphereNotFound(
            "unit_metres",
            f"all {scan.n_valid} points lie within {scan.largest_mm:.3f} mm of the camera",
            remedy="The scan is in metres; spherecal wants mm: multiply by 1000 or set the camera's unit.",
        )
    if len(scan.points_mm) < settings.min_points:
        raise SphereNotFound(
            "too_few_points",
            f"{len(scan.points_mm)} valid points{_near_text(predicted)} ({scan.n_valid} in the scan), {settings.min_points} needed",
            remedy="Is the sphere in view? Check its centre_in_base_mm, the hand-eye guess, or the exposure.",
        )


def _near_text(predicted: FloatArray | None) -> str:
    return "" if predicted is None else " near the predicted centre ({:.0f}, {:.0f}, {:.0f}) mm".format(*predicted)


def _judge(
    candidates: list[Candidate], scan: ValidPoints, radius_mm: float, settings: SphereSettings, predicted: FloatArray | None
) -> tuple[tuple[SphereFinding, ...], SphereNotFound | None]:
    """Findings that pass every gate, best supported first, and the refusal of the best that does not."""
    passed: list[tuple[float, SphereFinding]] = []
    refused: SphereNotFound | None = None
    for candidate in candidates:
        if passed and candidate.support < _WORTH_A_LOOK * passed[0][0]:
            break
        try:
            finding = fit_and_judge(candidate.centre_in_camera_mm, scan, radius_mm, settings)
            _check_prediction(finding, predicted, settings)
        except SphereNotFound as error:
            refused = refused or error
            continue
        apart = [np.linalg.norm(finding.centre_in_camera_mm - other.centre_in_camera_mm) for _, other in passed]
        if min(apart, default=np.inf) > 0.5 * radius_mm:
            passed.append((candidate.support, finding))
    return tuple(replace(finding, runner_up=_runner_up(passed, k)) for k, (_, finding) in enumerate(passed)), refused


def _runner_up(passed: Sequence[tuple[float, SphereFinding]], k: int) -> float:
    others = [support for i, (support, _) in enumerate(passed) if i != k]
    return max(others, default=0.0) / passed[k][0]


def _only_one(found: Sequence[SphereFinding], settings: SphereSettings) -> SphereFinding:
    best = found[0]
    if best.runner_up > settings.ambiguity_share:
        places = "; ".join("({:.0f}, {:.0f}, {:.0f})".format(*finding.centre_in_camera_mm) for finding in found[:4])
        raise SphereNotFound(
            "ambiguous",
            f"{len(found)} spheres of the same size are in view, at {places} mm in the camera frame",
            remedy="Give centre_in_base_mm of the spheres and a first guess of flange_from_camera in the cell file.",
        )
    return best


def _check_prediction(finding: SphereFinding, predicted: FloatArray | None, settings: SphereSettings) -> None:
    if predicted is None:
        return
    distance = float(np.linalg.norm(finding.centre_in_camera_mm - predicted))
    if distance > settings.search_radius_mm:
        raise _far(distance, settings)


def _far(distance_mm: float, settings: SphereSettings) -> SphereNotFound:
    return SphereNotFound(
        "far_from_prediction",
        f"the sphere is {distance_mm:.1f} mm from its predicted place, {settings.search_radius_mm:.1f} mm allowed",
        remedy="Check centre_in_base_mm and flange_from_camera in the cell file.",
    )


def _refuse_hollow(scan: ValidPoints, radius_mm: float, settings: SphereSettings) -> None:
    """Raise the reason `mirror` where the scan holds a hollow of this radius: a dish, or a cloud with z turned round."""
    rng = np.random.default_rng(settings.seed)
    for candidate in search(scan.points_mm, radius_mm, rng=rng, facing=-1.0)[:2]:
        try:
            hollow = fit_and_judge(candidate.centre_in_camera_mm, scan, radius_mm, settings, facing=-1.0)
        except SphereNotFound:
            continue
        raise SphereNotFound(
            "mirror",
            f"{hollow.n_points} points lie on a hollow of radius {radius_mm:.3f} mm whose centre is on the camera's side",
            remedy="A sphere bulges towards the camera. Check that z points away from the camera in the scan.",
        )
