"""Refinement by registration: small motions of the scans that make them agree, as far as the calibration believes possible.

Every scan may move by a small rigid motion about the middle of the surface, x_s = (translation there in mm, rotation in
rad). What is believed of all of them beforehand is one Gaussian: the calibration's covariance, which moves scans of like
poses alike, and the pose noise of each scan. Overlapping scans are registered in pairs by GICP (Segal, Haehnel, Thrun
2009; library small_gicp); a pair tells x_source - x_target, with the information that its surface holds (a plane tells
nothing of sliding along it). The pose graph is linear, and its solution is the mean of that Gaussian given the pairs.

A pair of thousands of points would be believed to a micrometre, which no pair is worth: errors of the camera's field bend
a scan, neighbours share them, and registration takes a bend for a motion. So each patch of a scan counts once with what
the calibration says of that (`_bend_variance_mm2`, its expanded uncertainty), and pairs that contradict each other more than all
that allows are believed less by the ratio (R. T. Birge, Phys. Rev. 40, 1932).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibrate.normal import PATCHES
from drivers.errors import SettingsError
from drivers.files.session import Shot
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.fuse import VoxelGrid
from measure.stitching.scan import PreparedScan, StitchingSystem

IntArray = NDArray[np.int64]

VOXEL_MM = 1.5
"""Of the clouds that are registered."""
_OVERLAP_VOXEL_MM = 6.0
_LEAST_OVERLAP = 0.3
_PAIRS_PER_SCAN = 4
_LEAST_POINTS = 200
_REACH_MM = 3.0
_EDGE_CELL_MM, _LEAST_AGREEING = 4.5, 0.97
"""A bore of 12 mm radius stays, a step does not: registered with their rims, scans slid along planes by what rims are worth."""
_BOUND = 27.9
"""Of the squared Mahalanobis distance of a scan's motion: 99.99 % of a Gaussian in six dimensions."""
_COVERAGE = 2.0
_NODES_MM = np.array([[x, y, z] for x in (-50.0, 0.0, 50.0) for y in (-50.0, 0.0, 50.0) for z in (-25.0, 0.0, 25.0)])
"""About the middle of a scan, where its bend is looked at."""
_LEVERS_MM = np.array([[0.0, 0.0, 0.0], [40.0, 0.0, 0.0], [0.0, 40.0, 0.0], [0.0, 0.0, 40.0]])


@dataclass(frozen=True, slots=True, eq=False)
class ScanSurface:
    """What registration needs of a scan."""

    shot: Shot
    points_in_base_mm: FloatArray
    """(n, 3) one a voxel."""
    normals: FloatArray
    """(n, 3)."""
    middle_in_camera_mm: FloatArray
    """(3,)."""


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """Small motions of the scans, and what they are worth."""

    motions: Mapping[int, FloatArray]
    """(4, 4) by index of the shot: refined_base_from_base."""
    shift_mm: Mapping[int, float]
    """How far each scan's middle moves."""
    bounded: tuple[int, ...]
    """Shots whose motion was cut back to what the calibration believes possible."""
    n_pairs: int
    disagreement_before_mm: float
    """Rms distance, along the normals, between the scans of all pairs."""
    disagreement_after_mm: float

    def to_json_dict(self) -> dict[str, object]:
        """For `--json`."""
        return {
            "n_pairs": self.n_pairs,
            "disagreement_before_mm": _finite(self.disagreement_before_mm),
            "disagreement_after_mm": _finite(self.disagreement_after_mm),
            "shift_mm": {str(index): shift for index, shift in self.shift_mm.items()},
            "bounded": list(self.bounded),
        }


def require_registration() -> Any:
    """The registration library.

    Raises:
        SettingsError: it is not installed.
    """
    try:
        import small_gicp
    except ImportError as error:
        what = "refinement needs the library small_gicp, which is not installed"
        raise SettingsError(what, remedy="pip install 'spherecal[registration]', or stitch without refinement.") from error
    return small_gicp


def surface_of(shot: Shot, xyz_in_camera_mm: NDArray[np.float32], scan: PreparedScan) -> ScanSurface:
    """The points that are registered: means of coarse voxels with a normal."""
    grid = VoxelGrid(VOXEL_MM)
    grid.add(scan.points_in_base_mm, weights=scan.weights, normals=scan.normals)
    fused = grid.fused()
    kept = np.flatnonzero(np.isfinite(fused.normals).all(axis=1))
    kept = kept[_off_edges(fused.points_mm[kept], fused.normals[kept].astype(np.float64))]
    used = xyz_in_camera_mm.reshape(-1, 3)[scan.weights.reshape(-1) > 0]
    middle = used.mean(axis=0, dtype=np.float64) if len(used) else np.array([0.0, 0.0, 1.0])
    return ScanSurface(shot, fused.points_mm[kept], fused.normals[kept].astype(np.float64), np.asarray(middle, dtype=np.float64))


def _off_edges(points_mm: FloatArray, normals: FloatArray) -> NDArray[np.bool_]:
    """Which points (n, 3) lie where normals (n, 3) hardly turn: rims are rounded and cut short by each view in its own way."""
    _, cell, count = np.unique(np.floor(points_mm / _EDGE_CELL_MM).astype(np.int64), axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(cell.reshape(-1), along, minlength=len(count)) for along in normals.T], axis=1)
    return np.asarray((np.linalg.norm(sums, axis=1) > _LEAST_AGREEING * count)[cell.reshape(-1)])


def refine(system: StitchingSystem, surfaces: Sequence[ScanSurface]) -> Refinement:
    """Find the motions.

    Args:
        system: whose covariance and noise say what is possible.
        surfaces: of all scans, in any order.

    Raises:
        SettingsError: the registration library is not installed.
    """
    library = require_registration()
    scans = sorted((s for s in surfaces if len(s.points_in_base_mm) >= _LEAST_POINTS), key=lambda s: s.shot.index)
    if len(scans) < 2:
        return Refinement({}, {}, (), 0, float("nan"), float("nan"))
    centre = np.mean([s.points_in_base_mm.mean(axis=0) for s in scans], axis=0)
    prior = _prior(system, scans, centre)
    pairs = _overlapping(scans)
    bends = [_bend_variance_mm2(system, scan) for scan in scans]
    links = []
    for target, source in pairs:
        twist, weight, match = _registered(library, system, scans[target], scans[source], centre, (bends[target] + bends[source]) / 2)
        links.append(_Link(target, source, twist, weight, match))
    motions, bounded = _bounded(_likeliest(links, prior), prior)
    matched = [(link.target, link.source, *link.match) for link in links]
    still = np.zeros_like(motions)
    return Refinement(
        motions={s.shot.index: _matrix(motion, centre) for s, motion in zip(scans, motions, strict=True)},
        shift_mm={s.shot.index: _shift_mm(s, motion, centre) for s, motion in zip(scans, motions, strict=True)},
        bounded=tuple(scans[i].shot.index for i in np.flatnonzero(bounded)),
        n_pairs=len(pairs),
        disagreement_before_mm=_disagreement_mm(scans, matched, still, centre),
        disagreement_after_mm=_disagreement_mm(scans, matched, motions, centre),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Link:
    """What a registered pair tells."""

    target: int
    source: int
    twist: FloatArray
    """(6,) of the source less that of the target."""
    weight: FloatArray
    """(6, 6) information."""
    match: tuple[IntArray, IntArray]
    """Rows of the source, and of the target."""


def _likeliest(links: Sequence[_Link], prior: FloatArray) -> FloatArray:
    """(m, 6) mean of the Gaussian of covariance `prior` (6 m, 6 m) given the pairs."""
    information, gradient = np.zeros_like(prior), np.zeros(len(prior))
    for link in links:
        a, b = (slice(6 * at, 6 * at + 6) for at in (link.target, link.source))
        for one, sign_one in ((a, -1.0), (b, 1.0)):
            gradient[one] += sign_one * link.weight @ link.twist
            for other, sign_other in ((a, -1.0), (b, 1.0)):
                information[one, other] += sign_one * sign_other * link.weight

    def given(share: float) -> FloatArray:
        return np.asarray(prior @ np.linalg.solve(np.eye(len(prior)) + share * information @ prior, share * gradient)).reshape(-1, 6)

    motions = given(1.0)
    left = [link.twist - (motions[link.source] - motions[link.target]) for link in links]
    squares = sum(float(one @ link.weight @ one) for one, link in zip(left, links, strict=True))
    n_told = float(np.trace(np.linalg.solve(np.eye(len(prior)) + prior @ information, prior @ information)))
    ratio = squares / max(6 * len(links) - n_told, 1.0)
    return given(1.0 / ratio) if ratio > 1.0 else motions


def _bend_variance_mm2(system: StitchingSystem, scan: ScanSurface) -> float:
    """Variance of a coordinate by what of the calibration's error is no rigid motion of the scan, taken at its expanded uncertainty."""
    pose = {"base_from_flange": scan.shot.base_from_flange} if system.model is None else {"joints_rad": scan.shot.joints_rad}
    nodes = scan.middle_in_camera_mm + _NODES_MM
    places = system.points_in_base_mm(nodes, **pose)
    moved = system.point_jacobian(nodes, **pose).reshape(3 * len(nodes), -1)
    levers = places - places.mean(axis=0)
    rigid = se3.point_columns(levers).reshape(-1, 6) * _SCALE
    bent = moved - rigid @ np.linalg.lstsq(rigid, moved, rcond=None)[0]
    used = system.covariance[: bent.shape[1], : bent.shape[1]]
    return _COVERAGE**2 * float(np.einsum("ij,jk,ik->i", bent, used, bent).mean())


def _prior(system: StitchingSystem, scans: Sequence[ScanSurface], centre: FloatArray) -> FloatArray:
    """(6 m, 6 m) covariance of the motions about the middle of the surface."""
    shares, noises = [], []
    for scan in scans:
        pose = {"base_from_flange": scan.shot.base_from_flange} if system.model is None else {"joints_rad": scan.shot.joints_rad}
        nodes = scan.middle_in_camera_mm + _LEVERS_MM
        places = system.points_in_base_mm(nodes, **pose)
        moved = system.point_jacobian(nodes, **pose)
        design = se3.point_columns(places - centre).reshape(12, 6)
        shares.append(np.linalg.lstsq(design * _SCALE, moved.reshape(12, -1), rcond=None)[0] * _SCALE[:, None])
        flange = np.asarray(scan.shot.base_from_flange if system.model is None else system.base_from_flange(np.asarray(scan.shot.joints_rad)))
        at_centre = np.eye(6)
        at_centre[:3, 3:] = -se3.hat(centre - flange[:3, 3])
        noise = system.noise
        noises.append(at_centre @ np.diag([noise.pose_mm**2] * 3 + [noise.pose_rad**2] * 3) @ at_centre.T)
    share = np.concatenate(shares)
    used = system.covariance[: share.shape[1], : share.shape[1]]
    result = share @ used @ share.T
    for i, block in enumerate(noises):
        result[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += block
    return np.asarray(result)


_SCALE = np.array([1.0, 1.0, 1.0, 1e-2, 1e-2, 1e-2])


def _overlapping(scans: Sequence[ScanSurface]) -> list[tuple[int, int]]:
    """Pairs of scans that share surface, for each scan those that share most."""
    cells = [set(map(tuple, np.floor(s.points_in_base_mm / _OVERLAP_VOXEL_MM).astype(np.int64).tolist())) for s in scans]
    shared = {(i, j): len(cells[i] & cells[j]) / min(len(cells[i]), len(cells[j])) for i, j in itertools.combinations(range(len(scans)), 2)}
    chosen: set[tuple[int, int]] = set()
    for i in range(len(scans)):
        mine = sorted((pair for pair in shared if i in pair and shared[pair] >= _LEAST_OVERLAP), key=lambda pair: (-shared[pair], pair))
        chosen.update(mine[:_PAIRS_PER_SCAN])
    return sorted(chosen)


def _registered(
    library: Any, system: StitchingSystem, target: ScanSurface, source: ScanSurface, centre: FloatArray, bend_variance_mm2: float
) -> tuple[FloatArray, FloatArray, tuple[IntArray, IntArray]]:
    """The motion (6,) that brings the source to the target, its information (6, 6), and matched rows of source and target."""
    from scipy.spatial import cKDTree

    shifted = [np.ascontiguousarray(s.points_in_base_mm - centre) for s in (target, source)]
    found = library.align(
        *shifted, registration_type="GICP", downsampling_resolution=VOXEL_MM / 2, max_correspondence_distance=_REACH_MM,
        max_iterations=40, rotation_epsilon=1e-6, translation_epsilon=1e-5,
    )  # fmt: skip
    moved = np.asarray(found.T_target_source)
    # about the centre, which is the origin here, a small motion is its translation and rotation vector
    twist = np.concatenate([moved[:3, 3], se3.log_so3(moved[:3, :3])])
    distance, nearest = cKDTree(shifted[0]).query(se3.apply(moved, shifted[1]), distance_upper_bound=_REACH_MM)
    row, rows = np.asarray(nearest, dtype=np.int64), np.flatnonzero(np.isfinite(distance)).astype(np.int64)
    rows = rows[(source.normals[rows] * target.normals[row[rows]]).sum(axis=1) > 0.8]
    normals = source.normals[rows]
    lever = np.concatenate([normals, np.cross(shifted[1][rows], normals)], axis=1)
    n = max(len(rows), 1)
    variance_mm2 = 1.0 / float(system.noise.point_weight(np.array([float(n)]))[0]) + n / PATCHES * bend_variance_mm2
    weight = 0.5 / variance_mm2
    return twist, np.asarray(weight * lever.T @ lever), (rows, row[rows])


def _bounded(motions: FloatArray, prior: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Motions (m, 6) cut back to what is believed possible of each, and which ones were."""
    bounded = np.zeros(len(motions), dtype=np.bool_)
    result = motions.copy()
    for i, motion in enumerate(motions):
        own = prior[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] / np.outer(_SCALE, _SCALE)
        scaled = motion / _SCALE
        distance2 = float(scaled @ np.linalg.pinv(own, hermitian=True) @ scaled)
        if distance2 > _BOUND:
            bounded[i] = True
            result[i] *= np.sqrt(_BOUND / distance2)
    return result, bounded


def _matrix(motion: FloatArray, centre: FloatArray) -> FloatArray:
    rotation = se3.exp_so3(motion[3:])
    return se3.from_rotation_translation(rotation, centre + motion[:3] - rotation @ centre)


def _shift_mm(scan: ScanSurface, motion: FloatArray, centre: FloatArray) -> float:
    middle = scan.points_in_base_mm.mean(axis=0) - centre
    return float(np.linalg.norm(motion[:3] + np.cross(motion[3:], middle)))


def _disagreement_mm(
    scans: Sequence[ScanSurface], matched: Sequence[tuple[int, int, IntArray, IntArray]], motions: FloatArray, centre: FloatArray
) -> float:
    squares, n = 0.0, 0
    for target, source, rows, others in matched:
        one = se3.apply(_matrix(motions[source], centre), scans[source].points_in_base_mm[rows])
        other = se3.apply(_matrix(motions[target], centre), scans[target].points_in_base_mm[others])
        along = ((one - other) * scans[target].normals[others]).sum(axis=1)
        squares, n = squares + float(along @ along), n + len(along)
    return float(np.sqrt(squares / n)) if n else float("nan")


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
