"""No scan shows its sphere: are the clouds, or the diameter, in another unit? Tried on a few scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquire.cell import Cell
from acquire.sphere import SphereNotFound, find_arc, find_sphere
from drivers.errors import DataError
from drivers.files.session import Session, read_scan

_SCANS = 3
_MOST_POINTS = 400_000
_ANY_DISTANCE_MM = (50.0, 3000.0)


@dataclass(frozen=True, slots=True)
class _Attempt:
    name: str
    remedy: str
    points_times: float = 1.0
    radius_times: float = 1.0


_DIAMETER = "Correct diameter_mm of the spheres in the cell file."
_ATTEMPTS = (
    _Attempt("diameter_mm holds the radius of the sphere", _DIAMETER, radius_times=2.0),
    _Attempt("the diameter was doubled: diameter_mm holds twice the diameter", _DIAMETER, radius_times=0.5),
    _Attempt("the scans are in metres", "Write the clouds in mm (multiply x, y and z by 1000).", points_times=1000.0),
    _Attempt("the scans are in inches", "Write the clouds in mm (multiply x, y and z by 25.4).", points_times=25.4),
    _Attempt("the scans are in centimetres", "Write the clouds in mm (multiply x, y and z by 10).", points_times=10.0),
    _Attempt("the scans are in tenths of a mm", "Write the clouds in mm (divide x, y and z by 10).", points_times=0.1),
    _Attempt("the scans are in micrometres", "Write the clouds in mm (divide x, y and z by 1000).", points_times=0.001),
    _Attempt("diameter_mm is in inches", _DIAMETER, radius_times=25.4),
    _Attempt("diameter_mm is in centimetres", _DIAMETER, radius_times=10.0),
)


def check_units(sessions: Sequence[Session], cell: Cell) -> None:
    """To be called where no shot shows its sphere: try other units of scans and diameters on a few scans.

    Raises:
        DataError: most of them show their sphere in another unit; the error names it.
        FileError: a scan is missing, cut off or changed.
    """
    scans = _some_scans(sessions, cell)
    for attempt in _ATTEMPTS if scans else ():
        found = [distance for xyz_mm, radius_mm in scans if (distance := _distance_mm(xyz_mm, radius_mm, cell, attempt)) is not None]
        if 2 * len(found) > len(scans) and _reachable(float(np.median(found)), cell):
            raise DataError(
                f"no shot shows its sphere; most likely {attempt.name}: so read, {len(found)} of {len(scans)} scans tried show it, "
                f"{np.median(found):.0f} mm from the camera",
                file=sessions[0].folder,
                remedy=attempt.remedy,
            )


def _some_scans(sessions: Sequence[Session], cell: Cell) -> list[tuple[NDArray[np.float64], float]]:
    """A few scans (n, 3) from all over the sessions, with the radius that each should show."""
    usable = [(session, s) for session in sessions for s in session.shots if s.status == "ok" and s.scan is not None and s.sphere is not None]
    chosen = np.unique(np.linspace(0, len(usable) - 1, min(len(usable), _SCANS)).astype(np.int64))
    found = []
    for session, shot in (usable[i] for i in chosen):
        xyz_mm = read_scan(session, shot).xyz_mm.reshape(-1, 3).astype(np.float64)
        found.append((xyz_mm[:: max(1, len(xyz_mm) // _MOST_POINTS)], cell.spheres[str(shot.sphere)].radius_mm))
    return found


def _distance_mm(xyz_mm: NDArray[np.float64], radius_mm: float, cell: Cell, attempt: _Attempt) -> float | None:
    """How far from the camera the sphere is seen; None where it is not."""
    points, radius = xyz_mm * attempt.points_times, radius_mm * attempt.radius_times
    try:
        if cell.camera.kind == "line_profile":
            return float(np.linalg.norm(find_arc(points, radius_mm=radius).arc_centre_in_camera_mm))
        return float(np.linalg.norm(find_sphere(points, radius_mm=radius).centre_in_camera_mm))
    except SphereNotFound as error:
        # several spheres of the size are as good a proof as one
        return _middle_mm(points) if error.reason == "ambiguous" else None


def _middle_mm(points_mm: NDArray[np.float64]) -> float:
    return float(np.nanmedian(np.linalg.norm(points_mm, axis=1)))


def _reachable(distance_mm: float, cell: Cell) -> bool:
    low, high = _ANY_DISTANCE_MM if cell.camera.working_range_mm is None else cell.camera.working_range_mm
    return low / 2 <= distance_mm <= 2 * high
