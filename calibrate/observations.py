"""From sessions on disk to points on spheres: every shot is used, or rejected with a reason."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquire.cell import Cell
from acquire.sphere import SphereFinding, SphereNotFound, SphereSettings, find_arc, find_sphere
from calibrate.external_points import ExternalShot, external_shots
from drivers.errors import DataError
from drivers.files.session import Session, Shot, read_scan
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

CentrePrediction = Callable[[Shot], FloatArray | None]
"""Where a shot's sphere should be, (3,) in the camera frame, or None."""


@dataclass(frozen=True, slots=True, eq=False)
class SphereShot:
    """The points of one sphere in one scan."""

    session: str
    """Digest of the session."""
    index: int
    sphere: str
    scan_sha256: str
    """Two shots with the same scan see two spheres in it."""
    joints_rad: FloatArray | None
    """(n,)"""
    base_from_flange: FloatArray
    """(4, 4): the nominal model's where there are joints, else as reported."""
    points_in_camera_mm: FloatArray
    """(m, 3) selected points on the sphere, as measured."""
    radius_mm: float
    """Certified."""
    centre_in_camera_mm: FloatArray | None
    """(3,) fitted with the certified radius; None for a line profile."""
    time_utc: str | None = None
    note: str | None = None
    """What is worth telling of this shot, e.g. that the controller's own pose differs from the model's."""

    @property
    def key(self) -> tuple[str, int]:
        """Session and index: a name for the shot that no order changes."""
        return self.session, self.index


@dataclass(frozen=True, slots=True)
class RejectedShot:
    """A shot that is not used, and why."""

    session: str
    index: int
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """All sphere shots of some sessions, in the order of their keys."""

    shots: tuple[SphereShot, ...]
    rejected: tuple[RejectedShot, ...]
    external: tuple[ExternalShot, ...] = ()
    """External reference points, which need no scan."""

    @property
    def n_shots(self) -> int:
        """Used and rejected."""
        return len(self.shots) + len(self.external) + len(self.rejected)


def gather_observations(
    sessions: Sequence[Session],
    *,
    cell: Cell,
    model: RobotModel | None,
    settings: SphereSettings | None = None,
    predict: CentrePrediction | None = None,
) -> Observations:
    """Find the sphere of every shot.

    Shots of status `skipped` are not counted, `failed` ones are rejected with their own reason. Scans are read one at a
    time; of each only the points on its sphere are kept.

    Raises:
        FileError: a scan is missing, cut off or changed.
        DataError: all scans look as if they were in metres.
    """
    predict = predict or nominal_prediction(cell, model)
    shots: list[SphereShot] = []
    rejected: list[RejectedShot] = []
    n_metres = 0
    for session in sessions:
        for shot in session.shots:
            if shot.is_reference_point and shot.status == "failed":
                rejected.append(RejectedShot(session.digest, shot.index, f"marked failed: {shot.reason or 'no reason given'}"))
            if shot.status == "skipped" or shot.is_reference_point or shot.sphere is None:
                continue
            try:
                shots.append(observe(session, shot, cell=cell, model=model, settings=settings, predict=predict))
            except SphereNotFound as error:
                n_metres += error.reason == "unit_metres"
                rejected.append(RejectedShot(session.digest, shot.index, f"{error.reason}: {error.message}"))
            except _FailedShotError as error:
                rejected.append(RejectedShot(session.digest, shot.index, str(error)))
    if n_metres and not shots:
        raise DataError(
            "every scan looks as if it were in metres",
            file=sessions[0].folder / "scans",
            remedy="Write the clouds in mm (multiply x, y and z by 1000).",
        )
    return Observations(tuple(sorted(shots, key=lambda s: s.key)), tuple(rejected), external_shots(sessions))


def observe(
    session: Session,
    shot: Shot,
    *,
    cell: Cell,
    model: RobotModel | None,
    settings: SphereSettings | None = None,
    predict: CentrePrediction | None = None,
) -> SphereShot:
    """One shot's points on its sphere; raises SphereNotFound with the reason of its refusal."""
    if shot.status == "failed" or shot.scan is None or shot.sha256 is None or shot.sphere is None:
        raise _FailedShotError(f"marked {shot.status}: {shot.reason or 'no reason given'}")
    radius_mm = cell.spheres[shot.sphere].radius_mm
    xyz_mm = read_scan(session, shot).xyz_mm
    predicted = predict(shot) if predict else None
    centre: FloatArray | None = None
    if cell.camera.kind == "line_profile":
        points = find_arc(xyz_mm, radius_mm=radius_mm, settings=settings).points_in_camera_mm
    else:
        finding = _find(xyz_mm, radius_mm, settings, predicted)
        points, centre = finding.points_in_camera_mm, finding.centre_in_camera_mm
    return sphere_shot(session, shot, cell=cell, model=model, points_in_camera_mm=points, centre_in_camera_mm=centre)


def sphere_shot(
    session: Session, shot: Shot, *, cell: Cell, model: RobotModel | None, points_in_camera_mm: FloatArray, centre_in_camera_mm: FloatArray | None
) -> SphereShot:
    """A shot (with scan and sphere) and the points that were found on its sphere."""
    return SphereShot(
        session=session.digest,
        index=shot.index,
        sphere=str(shot.sphere),
        scan_sha256=str(shot.sha256),
        joints_rad=shot.joints_rad,
        base_from_flange=flange_pose(shot, model),
        points_in_camera_mm=np.ascontiguousarray(points_in_camera_mm),
        radius_mm=cell.spheres[str(shot.sphere)].radius_mm,
        centre_in_camera_mm=centre_in_camera_mm,
        time_utc=shot.time_utc,
    )


def _find(xyz_mm: NDArray[np.float32], radius_mm: float, settings: SphereSettings | None, predicted: FloatArray | None) -> SphereFinding:
    try:
        return find_sphere(xyz_mm, radius_mm=radius_mm, settings=settings, predicted_centre_in_camera_mm=predicted)
    except SphereNotFound as error:
        # a first guess may be further off than the search reaches; a lone sphere is found without it
        if predicted is None or error.reason != "far_from_prediction":
            raise
        return find_sphere(xyz_mm, radius_mm=radius_mm, settings=settings)


def flange_pose(shot: Shot, model: RobotModel | None) -> FloatArray:
    """(4, 4) of the nominal model where the shot has joints, else as recorded; DataError where it has neither."""
    if shot.joints_rad is not None and model is not None:
        return mdh.base_from_flange(model, shot.joints_rad)
    if shot.base_from_flange is None:
        raise DataError(
            f"shot {shot.index} has axis angles but the cell names no robot model",
            remedy="Name the robot's model in the cell file, or record flange poses.",
        )
    return shot.base_from_flange


def nominal_prediction(cell: Cell, model: RobotModel | None) -> CentrePrediction | None:
    """Where spheres should be by the cell file's first guesses; None where it gives none."""
    guess = cell.flange_from_camera
    if guess is None:
        return None

    def predict(shot: Shot) -> FloatArray | None:
        centre = cell.spheres[str(shot.sphere)].centre_in_base_mm
        if centre is None:
            return None
        return se3.apply(se3.inverse(flange_pose(shot, model) @ guess), centre)

    return predict


class _FailedShotError(Exception):
    """A shot that the capture run itself marked as failed."""
