"""Which views saw a patch, and how it moves with the calibration's parameters and with the noise of each view's pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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

_POINTS_PER_VIEW = 40_000
_WELL_SEEN = 20
"""Points of a view on a patch."""
_MOST_OVERLAPS = 150
"""Patches that views are compared on."""


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
    return View(thinned(points), shot.joints_rad, shot.base_from_flange)


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
    motion = _motion(calibration, views, seen, total, se3.apply(se3.inverse(part_from_base), centres))
    n_parameters = motion.shape[2] - 6 * len(views)
    _fill_unseen(motion, total, centres)
    rotated = np.einsum("ij,kjm->kim", part_from_base[:3, :3], motion, optimize=True)
    noise = calibration.noise
    covariance = np.diag(np.concatenate([np.zeros(n_parameters), np.tile([noise.pose_mm**2] * 3 + [noise.pose_rad**2] * 3, len(views))]))
    covariance[:n_parameters, :n_parameters] = calibration.covariance[:n_parameters, :n_parameters]
    more = pose_noise_factor(_overlaps(calibration, views, seen, responses, part_from_base), covariance, n_parameters)
    covariance[n_parameters:, n_parameters:] *= more
    words = f"the calibration's covariance and pose noise, through {len(views)} views"
    if more > 1:
        words += f", which differ {np.sqrt(more):.1f} times as much where they overlap as that pose noise tells: it is taken so"
    return SeenField(rotated, covariance, words)


class Overlaps(NamedTuple):
    """Where views see the same patches: N pairs of a view and a patch."""

    off_mm: FloatArray
    """(N,) how far a view shows a patch above the mean of all views."""
    noise_mm2: FloatArray
    """(N,) variance of that by the noise of points."""
    n_points: FloatArray
    """(N,)."""
    motion: FloatArray
    """(N, M) of it per unknown of the field."""


def pose_noise_factor(overlaps: Overlaps, covariance: FloatArray, n_parameters: int) -> float:
    """How many times the variance of the calibration's pose noise the views of this session show; at least 1.

    R. T. Birge, Phys. Rev. 40, 1932: an external scatter beyond the stated one is taken for it. Below it proves nothing:
    the views of one part are few.
    """
    of_calibration, of_poses = overlaps.motion[:, :n_parameters], overlaps.motion[:, n_parameters:]
    weight = overlaps.n_points
    by_calibration = np.einsum("nm,nm->n", of_calibration @ covariance[:n_parameters, :n_parameters], of_calibration)
    by_poses = np.einsum("nm,nm->n", of_poses @ covariance[n_parameters:, n_parameters:], of_poses)
    stated = float(weight @ by_poses)
    shown = float(weight @ (overlaps.off_mm**2 - overlaps.noise_mm2 - by_calibration))
    return max(shown / stated, 1.0) if stated > 0 else 1.0


def thinned(points_mm: NDArray[np.floating]) -> FloatArray:
    """Enough of a scan's points to tell which walls it shows."""
    return points_mm[:: max(1, len(points_mm) // _POINTS_PER_VIEW)].astype(np.float64)


class _Seen(NamedTuple):
    """What one view shows of all K patches."""

    n_points: FloatArray
    """(K,)."""
    mean_in_camera_mm: FloatArray
    """(K, 3) of these points."""
    mean_off_mm: FloatArray
    """(K,) of their distances from the fitted surface."""
    variance_mm2: FloatArray
    """(K,) of these distances."""


def _seen_by(calibration: KnowsItsErrors, view: View, responses: Sequence[Response], part_from_base: FloatArray) -> _Seen:
    in_part = se3.apply(part_from_base, calibration.points_in_base_mm(view.points_in_camera_mm, **view.pose(calibration)))
    found = [_points_of(response, in_part, view.points_in_camera_mm) for response in responses]
    return _Seen(*(np.concatenate(columns) for columns in zip(*found, strict=True)))


def _motion(calibration: KnowsItsErrors, views: Sequence[View], seen: Sequence[_Seen], total: FloatArray, in_base_mm: FloatArray) -> FloatArray:
    """(K, 3, P + 6 V) of patches at (K, 3) per parameter of the calibration and per twist of each view's flange about its own place; base frame."""
    motion = np.zeros((0, 3, 0))
    for number, (view, one) in enumerate(zip(views, seen, strict=True)):
        pose = view.pose(calibration)
        taken = np.flatnonzero(one.n_points)
        # one point at least, for the number of parameters
        jacobian = calibration.point_jacobian(one.mean_in_camera_mm[taken] if len(taken) else view.points_in_camera_mm[:1], **pose)
        n_parameters = jacobian.shape[2]
        if not len(motion):
            motion = np.zeros((len(total), 3, n_parameters + 6 * len(views)))
        share = (one.n_points[taken] / total[taken])[:, None, None]
        flange = calibration.base_from_flange(pose["joints_rad"]) if "joints_rad" in pose else pose["base_from_flange"]
        by_twist = se3.point_columns(in_base_mm[taken] - flange[:3, 3])
        start = n_parameters + 6 * number
        motion[taken, :, :n_parameters] += share * jacobian[: len(taken)]
        motion[taken, :, start : start + 6] = share * by_twist
    return motion


def _points_of(response: Response, in_part: FloatArray, in_camera: FloatArray) -> _Seen:
    """A view's points on the patches of one feature, each the nearest patch's."""
    from scipy.spatial import cKDTree

    centres = response.centre_in_part_mm
    low, high = centres.min(axis=0) - response.size_mm, centres.max(axis=0) + response.size_mm
    rows = np.flatnonzero(((in_part > low) & (in_part < high)).all(axis=1))
    if response.surface is not None:
        rows = rows[response.surface.holds(in_part[rows])]
    found = cKDTree(centres).query(in_part[rows], distance_upper_bound=response.size_mm)
    near, patch = np.isfinite(found[0]), np.asarray(found[1], dtype=np.int64)
    rows, patch = rows[near], patch[near]
    off = np.zeros(len(rows)) if response.surface is None else response.surface.distances(in_part[rows]).residual_mm
    count = np.bincount(patch, minlength=len(centres)).astype(np.float64)
    columns = np.column_stack([np.bincount(patch, column, len(centres)) for column in (*in_camera[rows].T, off, off**2)])
    mean = columns / np.maximum(count, 1)[:, None]
    return _Seen(count, mean[:, :3], mean[:, 3], np.maximum(mean[:, 4] - mean[:, 3] ** 2, 0.0))


def _overlaps(
    calibration: KnowsItsErrors, views: Sequence[View], seen: Sequence[_Seen], responses: Sequence[Response], part_from_base: FloatArray
) -> Overlaps:
    """Of the patches that two views at least see well."""
    known = np.concatenate([np.full(len(response.centre_in_part_mm), response.surface is not None) for response in responses])
    count = np.stack([one.n_points for one in seen])
    well = count >= _WELL_SEEN
    patches = np.flatnonzero(known & (well.sum(axis=0) >= 2))
    patches = patches[:: max(1, -(-len(patches) // _MOST_OVERLAPS))]
    normals = np.concatenate(
        [np.zeros_like(r.centre_in_part_mm) if r.surface is None else r.surface.distances(r.centre_in_part_mm).gradient for r in responses]
    )
    in_base = se3.apply(se3.inverse(part_from_base), np.concatenate([response.centre_in_part_mm for response in responses]))
    motions = []
    for number, (view, one) in enumerate(zip(views, seen, strict=True)):
        # a view that does not see a patch counts nothing there, wherever its motion is taken
        alone = one._replace(mean_in_camera_mm=one.mean_in_camera_mm[patches], n_points=np.maximum(one.n_points[patches], 1e-9))
        motion = _motion(calibration, [view], [alone], alone.n_points, in_base[patches])
        n_parameters = motion.shape[2] - 6
        along = np.einsum("ki,kim->km", normals[patches] @ part_from_base[:3, :3], motion)
        placed = np.zeros((len(patches), n_parameters + 6 * len(views)))
        placed[:, :n_parameters] = along[:, :n_parameters]
        placed[:, n_parameters + 6 * number : n_parameters + 6 * number + 6] = along[:, n_parameters:]
        motions.append(placed)
    weight = np.where(well, count, 0.0)[:, patches]
    share = weight / np.maximum(weight.sum(axis=0), 1e-9)
    off = np.stack([one.mean_off_mm[patches] for one in seen])
    noise = np.stack([one.variance_mm2[patches] for one in seen]) / np.maximum(weight, 1)
    moved = np.stack(motions)
    kept = weight > 0
    return Overlaps(
        off_mm=(off - np.sum(share * off, axis=0))[kept],
        noise_mm2=(noise * (1 - share))[kept],
        n_points=weight[kept],
        motion=(moved - np.einsum("vk,vkm->km", share, moved))[kept],
    )


def _fill_unseen(motion: FloatArray, total: FloatArray, centres: FloatArray) -> None:
    """Patches too small for the thinned views move as their nearest seen neighbour."""
    from scipy.spatial import cKDTree

    seen, unseen = np.flatnonzero(total > 0), np.flatnonzero(total == 0)
    if len(unseen):
        motion[unseen] = motion[seen[cKDTree(centres[seen]).query(centres[unseen])[1]]]
