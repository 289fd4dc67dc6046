"""The sphere centre of every shot of a session, or the reason why there is none (`spherecal centres`)."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquire.cell import Cell
from acquire.sighting import base_from_flange_of, look_for, predicted_centre_in_camera_mm, prediction_error_mm
from acquire.sphere import SphereFinding, SphereNotFound, SphereSettings
from drivers.files.disk import write_text_atomic
from drivers.files.session import Session, read_scan
from drivers.files.shots import Shot
from drivers.kinematics.mdh import RobotModel

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class CentreRow:
    """What one shot says about its sphere."""

    index: int
    sphere: str | None
    reason: str | None
    """Why the shot is of no use; None where it is used."""
    message: str = ""
    """The refusal in words, with its numbers."""
    centre_in_camera_mm: FloatArray | None = None
    """(3,); None for arcs of a line profile, which fix no centre, and for refused shots."""
    covariance_mm2: FloatArray | None = None
    """(3, 3)"""
    n_points: int = 0
    rms_mm: float | None = None
    free_radius_mm: float | None = None
    """Radius of the free fit: of the sphere, or of the arc's circle."""
    cap_half_angle_rad: float | None = None
    """Half the angle that an arc turns through, for line profiles."""
    azimuth_coverage: float | None = None
    prediction_error_mm: float | None = None

    @property
    def used(self) -> bool:
        """Whether a sphere was found."""
        return self.reason is None


def centres_of_session(
    session: Session, cell: Cell, *, model: RobotModel | None = None, settings: SphereSettings | None = None
) -> Iterator[CentreRow]:
    """Rows of all shots that look at a sphere, one after the other: one scan is in memory at a time.

    Args:
        session: as read.
        cell: its cell.
        model: the nominal robot, which with the cell's hand-eye and sphere places predicts where to look; None: flange
            poses as recorded, or the whole scan.
        settings: gates of the sphere finder.

    Raises:
        FileError: a scan is missing, cut off or changed.
    """
    for shot in session.shots:
        if not shot.is_reference_point:
            yield centre_of_shot(session, shot, cell, model=model, settings=settings)


def centre_of_shot(
    session: Session, shot: Shot, cell: Cell, *, model: RobotModel | None = None, settings: SphereSettings | None = None
) -> CentreRow:
    """The row of one shot; arguments and errors as for `centres_of_session`."""
    sphere = shot.sphere
    if shot.status != "ok":
        return CentreRow(shot.index, sphere, shot.status, shot.reason or "no reason recorded")
    if sphere is None or shot.scan is None:
        return CentreRow(shot.index, sphere, "no_sphere_named" if shot.scan is not None else "no_scan", "the shot names no sphere or has no scan")
    flange = base_from_flange_of(model, shot.joints_rad, shot.base_from_flange)
    predicted = predicted_centre_in_camera_mm(cell, sphere, flange)
    try:
        finding = look_for(cell, sphere, read_scan(session, shot).xyz_mm, predicted, settings)
    except SphereNotFound as error:
        return CentreRow(shot.index, sphere, error.reason, str(error))
    if not isinstance(finding, SphereFinding):
        return CentreRow(
            index=shot.index,
            sphere=sphere,
            reason=None,
            n_points=finding.n_points,
            rms_mm=finding.rms_mm,
            free_radius_mm=finding.arc_radius_mm,
            cap_half_angle_rad=finding.arc_angle_rad / 2,
        )
    return CentreRow(
        index=shot.index,
        sphere=sphere,
        reason=None,
        centre_in_camera_mm=finding.centre_in_camera_mm,
        covariance_mm2=finding.covariance_mm2,
        n_points=finding.n_points,
        rms_mm=finding.rms_mm,
        free_radius_mm=finding.free_radius_mm,
        cap_half_angle_rad=finding.cap_half_angle_rad,
        azimuth_coverage=finding.azimuth_coverage,
        prediction_error_mm=prediction_error_mm(finding, predicted),
    )


_COLUMNS = (
    *("index", "sphere", "reason", "x_mm", "y_mm", "z_mm", "xx_mm2", "xy_mm2", "xz_mm2", "yy_mm2", "yz_mm2", "zz_mm2"),
    *("n_points", "rms_mm", "free_radius_mm", "cap_half_angle_deg", "azimuth_coverage", "prediction_error_mm", "message"),
)


def write_centres_csv(rows: Iterable[CentreRow], path: str | Path) -> None:
    """Write rows as CSV in one step: centre in the camera frame, upper triangle of its covariance; empty where unknown.

    Raises:
        FileError: when the file cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    writer.writerows(_cells(row) for row in rows)
    write_text_atomic(path, text.getvalue())


def _cells(row: CentreRow) -> list[str]:
    centre = [None] * 3 if row.centre_in_camera_mm is None else row.centre_in_camera_mm.tolist()
    covariance = [None] * 6 if row.covariance_mm2 is None else row.covariance_mm2[np.triu_indices(3)].tolist()
    half_angle_deg = None if row.cap_half_angle_rad is None else float(np.degrees(row.cap_half_angle_rad))
    numbers = [row.rms_mm, row.free_radius_mm, half_angle_deg, row.azimuth_coverage, row.prediction_error_mm]
    return [
        *(str(row.index), row.sphere or "", row.reason or ""),
        *map(_number, centre),
        *map(_number, covariance),
        str(row.n_points),
        *map(_number, numbers),
        row.message,
    ]


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.9g}"
