"""Which views saw a patch, and how it moves with the calibration's parameters and with the noise of each view's pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from drivers.errors import DataError
from drivers.files.ply import PointCloud
from drivers.files.session import Session, Shot, read_scan
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.inspecting.fitting import Response
from measure.inspecting.uncertainty import FieldError, SeenField
from measure.placing import check_fits
from measure.stitch import scans_once
from measure.stitching.scan import KnowsItsErrors

FieldSource = Callable[[Sequence[Response], FloatArray], FieldError]
"""Makes the field of errors for some responses and part_from_base (4, 4)."""

_POINTS_PER_VIEW = 6_000


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One scan, thinned, and the pose it was taken from."""

    points_in_camera_mm: FloatArray
    """(n, 3) finite."""
    joints_rad: FloatArray | None
    base_from_flange: FloatArray | None

    def pose(self, calibration: KnowsItsErrors) -> dict[str, FloatArray]:
        """The keyword that a calibration wants.

        Raises:
            DataError: the view lacks it.
        """
        given = {"joints_rad": self.joints_rad} if calibration.model is not None else {"base_from_flange": self.base_from_flange}
        found = {name: value for name, value in given.items() if value is not None}
        if not found:
            raise DataError(f"a shot has no {next(iter(given))}, which this calibration needs", remedy="Name the session that was stitched.")
        return found


def views_of(calibration: KnowsItsErrors, session: Session) -> list[View]:
    """The good scans of a session, thinned.

    Raises:
        DataError: the session does not fit the calibration.
        FileError: a scan is missing or broken.
    """
    check_fits(calibration, session)
    return [view_of(shot, read_scan(session, shot)) for shot in scans_once(session)]


def view_of(shot: Shot, cloud: PointCloud) -> View:
    """A scan, thinned."""
    points = cloud.points_mm
    points = points[np.isfinite(points).all(axis=1)]
    thinned = points[:: max(1, len(points) // _POINTS_PER_VIEW)].astype(np.float64)
    return View(thinned, shot.joints_rad, shot.base_from_flange)


def field_of(calibration: KnowsItsErrors, views: Sequence[View]) -> FieldSource:
    """What calibration and views tell of the errors that a cloud's points share, asked for once the part is aligned."""

    def source(responses: Sequence[Response], part_from_base: FloatArray) -> FieldError:
        return seen_field(calibration, views, responses, part_from_base)

    return source


def seen_field(calibration: KnowsItsErrors, views: Sequence[View], responses: Sequence[Response], part_from_base: FloatArray) -> SeenField:
    """The field of errors at the patches of some responses.

    A patch's error is the mean over the views that saw it, by the number of their points on the feature: a wall that one
    view sees has the whole error of that view, though others see the surface at its foot.

    Raises:
        DataError: no view shows the part.
    """
    centres = np.concatenate([response.centre_in_part_mm for response in responses])
    seen = [_seen_by(calibration, view, responses, part_from_base) for view in views]
    total = np.sum([one.n_points for one in seen], axis=0) if seen else np.zeros(len(centres))
    ends = np.cumsum([len(response.centre_in_part_mm) for response in responses])
    missed = [not part.any() for part in np.split(total, ends[:-1])]
    if any(missed):
        # too small for the thinned views: who sees its place tells
        loose = [replace(response, surface=None) if gone else response for response, gone in zip(responses, missed, strict=True)]
        seen = [_seen_by(calibration, view, loose, part_from_base) for view in views]
        total = np.sum([one.n_points for one in seen], axis=0) if seen else total
    if not total.any():
        raise DataError("no scan of the session shows the part where the cloud does", remedy="Name the session that the cloud was stitched from.")
    n_parameters = seen[0].by_parameter.shape[2]
    motion = np.zeros((len(centres), 3, n_parameters + 6 * len(views)))
    for number, one in enumerate(seen):
        share = (one.n_points / np.maximum(total, 1))[:, None, None]
        motion[:, :, :n_parameters] += share * one.by_parameter
        start = n_parameters + 6 * number
        motion[:, :, start : start + 6] = share * one.by_twist
    _fill_unseen(motion, total, centres)
    rotated = np.einsum("ij,kjm->kim", part_from_base[:3, :3], motion, optimize=True)
    noise = calibration.noise
    covariance = np.diag(np.concatenate([np.zeros(n_parameters), np.tile([noise.pose_mm**2] * 3 + [noise.pose_rad**2] * 3, len(views))]))
    covariance[:n_parameters, :n_parameters] = calibration.covariance[:n_parameters, :n_parameters]
    return SeenField(rotated, covariance, f"the calibration's covariance and pose noise, through {len(views)} views")


class _Seen(NamedTuple):
    """What one view tells of all K patches."""

    n_points: FloatArray
    """(K,)."""
    by_parameter: FloatArray
    """(K, 3, p) motion per parameter of the calibration; zero where the view shows nothing."""
    by_twist: FloatArray
    """(K, 3, 6) motion per twist of the flange about its own place."""


def _seen_by(calibration: KnowsItsErrors, view: View, responses: Sequence[Response], part_from_base: FloatArray) -> _Seen:
    pose = view.pose(calibration)
    in_part = se3.apply(part_from_base, calibration.points_in_base_mm(view.points_in_camera_mm, **pose))
    found = [_points_of(response, in_part, view.points_in_camera_mm) for response in responses]
    count = np.concatenate([n for n, _ in found])
    mean_in_camera = np.concatenate([mean for _, mean in found])
    taken = np.flatnonzero(count)
    # one point at least, for the number of parameters
    jacobian = calibration.point_jacobian(mean_in_camera[taken] if len(taken) else view.points_in_camera_mm[:1], **pose)
    by_parameter = np.zeros((len(count), 3, jacobian.shape[2]))
    by_parameter[taken] = jacobian[: len(taken)]
    flange = calibration.base_from_flange(pose["joints_rad"]) if "joints_rad" in pose else pose["base_from_flange"]
    centres = np.concatenate([response.centre_in_part_mm for response in responses])
    lever = se3.apply(se3.inverse(part_from_base), centres) - flange[:3, 3]
    by_twist = np.concatenate([np.broadcast_to(np.eye(3), (len(centres), 3, 3)), -se3.hat(lever)], axis=2)
    return _Seen(count, by_parameter, by_twist)


def _points_of(response: Response, in_part: FloatArray, in_camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Number (K,) and mean in the camera (K, 3) of a view's points on the patches of one feature, each the nearest patch's."""
    from scipy.spatial import cKDTree

    centres = response.centre_in_part_mm
    low, high = centres.min(axis=0) - response.size_mm, centres.max(axis=0) + response.size_mm
    rows = np.flatnonzero(((in_part > low) & (in_part < high)).all(axis=1))
    if response.surface is not None:
        rows = rows[response.surface.holds(in_part[rows])]
    found = cKDTree(centres).query(in_part[rows], distance_upper_bound=response.size_mm)
    near, patch = np.isfinite(found[0]), np.asarray(found[1], dtype=np.int64)
    count = np.bincount(patch[near], minlength=len(centres)).astype(np.float64)
    columns = [np.bincount(patch[near], in_camera[rows[near], axis], len(centres)) for axis in range(3)]
    return count, np.column_stack(columns) / np.maximum(count, 1)[:, None]


def _fill_unseen(motion: FloatArray, total: FloatArray, centres: FloatArray) -> None:
    """Patches too small for the thinned views move as their nearest seen neighbour."""
    from scipy.spatial import cKDTree

    seen, unseen = np.flatnonzero(total > 0), np.flatnonzero(total == 0)
    if len(unseen):
        motion[unseen] = motion[seen[cKDTree(centres[seen]).query(centres[unseen])[1]]]
