"""One scan made ready for fusion: camera correction, corrected chain, base frame; cleaned, weighed, with normals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibrate.normal import NoiseModel
from drivers.errors import DataError
from drivers.files.ply import PointCloud
from drivers.files.session import Session, Shot
from drivers.kinematics.se3 import FloatArray
from measure.length_uncertainty import KnowsItsCovariance
from measure.placing import MeasuringSystem, points_of_shot_in_base_mm

if TYPE_CHECKING:
    from measure.stitching.scan_kernels import PointNoise, View

_LATTICE = (5, 5, 3)
_COVARIANCE_EVERY = 8
"""Pixels of a row that share one covariance: it changes over centimetres."""
_REFERENCE_LEVER_MM = 500.0
_LINES_LOOKED_AT = 32
_FAR_OFF = 3.0
_ANY_DEPTH_MM = (100.0, 4000.0)
"""Taken where the calibration saw nothing: external points alone."""
_UNITS = {"metres": 1e3, "inches": 25.4, "centimetres": 10.0, "tenths of a millimetre": 0.1, "micrometres": 1e-3}


class KnowsItsErrors(MeasuringSystem, KnowsItsCovariance, Protocol):
    """A measuring system that knows its uncertainty; `calibrate.Calibration` is one."""

    @property
    def noise(self) -> NoiseModel:
        """What was found of noise."""
        ...

    def base_from_flange(self, joints_rad: ArrayLike) -> FloatArray:
        """Corrected robot (4, 4)."""
        ...


class StitchingSystem(KnowsItsErrors, Protocol):
    """What stitching needs besides."""

    @property
    def flange_from_camera(self) -> FloatArray:
        """(4, 4)."""
        ...

    @property
    def camera_seen_volume_mm(self) -> FloatArray:
        """(2, 3) lower and upper corner of the part of the camera frame in which points were seen."""
        ...


@dataclass(frozen=True, slots=True)
class Cleaning:
    """What is dropped of organised scans before they are fused."""

    edges: bool = True
    """Points without enough near neighbours (flying pixels at depth edges), and small patches."""
    max_step_ratio: float = 6.0
    """Neighbours are near within so many lateral pixel steps; 6 leaves surfaces tilted up to 80 degrees alone."""
    min_neighbours: int = 3
    """Of 8."""
    max_incidence_deg: float = 75.0
    """Surfaces that are seen more grazing are dropped."""
    min_patch_points: int = 12
    """Patches of fewer connected points are dropped."""


DEFAULT_CLEANING = Cleaning()
NO_CLEANING = Cleaning(edges=False, max_incidence_deg=90.0, min_patch_points=0)


@dataclass(frozen=True, slots=True, eq=False)
class PreparedScan:
    """A scan in the base; arrays (h, w), or (1, n) without a grid."""

    points_in_base_mm: FloatArray
    """(h, w, 3)."""
    weights: NDArray[np.uint8]
    """0 where a point was dropped, else in units of 1 / UNIT_WEIGHT."""
    normals: NDArray[np.int16]
    """(h, w, 3) in steps of 1 / NORMAL_STEPS; zeros where unknown."""
    variances: NDArray[np.uint32]
    """The calibration's variance along the normal in steps of VARIANCE_STEP_MM2."""
    n_valid: int
    n_edge: int
    n_grazing: int
    n_speck: int


def unit_variance_mm2(noise: NoiseModel) -> float:
    """Predicted random variance of a point of weight 1: average incidence, 500 mm from the flange."""
    return noise.pose_mm**2 + (noise.pose_rad * _REFERENCE_LEVER_MM) ** 2 + noise.form_mm**2 + noise.point_mm**2


def prepare_scan(system: StitchingSystem, session: Session, shot: Shot, cloud: PointCloud, cleaning: Cleaning, *, full: bool = True) -> PreparedScan:
    """Correct, move, clean and weigh the points of a shot; the variances are zero where not all (`full`) is wanted.

    Raises:
        DataError: the shot lacks the pose that the calibration needs, or its scan is in another unit.
    """
    from measure.stitching import scan_kernels as kernels

    in_camera = _as_grid(cloud.xyz_mm)
    low, high = system.camera_seen_volume_mm
    require_likely(in_camera, (float(low[2]), float(high[2])), session, shot)
    height, width = in_camera.shape[:2]
    in_base = points_of_shot_in_base_mm(system, session, shot, in_camera.reshape(-1, 3)).reshape(height, width, 3)
    view, noise = _view(system, shot), _point_noise(system.noise)
    weights = np.empty((height, width), dtype=np.uint8)
    normals = np.zeros((height, width, 3), dtype=np.int16)
    fates = np.zeros(kernels.FATES, dtype=np.int64)
    step = pixel_step_per_depth(in_camera) if min(height, width) >= 3 else float("nan")
    if np.isfinite(step):
        links = np.empty((height, width), dtype=np.uint8)
        least_cosine = float(np.cos(np.radians(cleaning.max_incidence_deg)))
        neighbours = cleaning.min_neighbours if cleaning.edges else 0
        kernels.examine_grid(in_base, view, noise, cleaning.max_step_ratio * step, neighbours, least_cosine, weights, normals, links, fates)
        if cleaning.min_patch_points > 1:
            kernels.drop_specks(weights, links, cleaning.min_patch_points, fates)
    else:
        kernels.weigh_loose(in_base.reshape(1, -1, 3), view, noise, weights.reshape(1, -1), fates)
    variances = np.zeros((height, width), dtype=np.uint32)
    if full and weights.any():
        low, spacing, covariances = _lattice(system, shot, in_camera)
        every = _COVARIANCE_EVERY if np.isfinite(step) else 1
        kernels.variances_along_normals(in_camera, in_base, view, low, spacing, covariances, every, weights, normals, variances)
    n_valid = height * width - int(fates[kernels.INVALID])
    return PreparedScan(in_base, weights, normals, variances, n_valid, *(int(fates[i]) for i in (kernels.EDGE, kernels.GRAZING, kernels.SPECK)))


def _as_grid(xyz_mm: NDArray[np.float32]) -> NDArray[np.float32]:
    grid = xyz_mm if xyz_mm.ndim == 3 else xyz_mm.reshape(1, -1, 3)
    return np.ascontiguousarray(grid)


def require_likely(in_camera: NDArray[np.float32], seen_depth_mm: tuple[float, float], session: Session, shot: Shot) -> None:
    """Refuse scans that are plainly in another unit, or of another axis order.

    Args:
        in_camera: (h, w, 3).
        seen_depth_mm: least and greatest depth at which the calibration saw anything; equal where it saw nothing.
        session: that the shot belongs to, for the error.
        shot: of the scan, for the error.

    Raises:
        DataError: most points lie behind the camera, or three times nearer or farther than anything that was calibrated.
    """
    depth = in_camera.reshape(-1, 3)[:: max(1, in_camera.size // 30_000)].astype(np.float64)
    depth = depth[np.isfinite(depth).all(axis=1), 2]
    if not len(depth):  # only a few points of many are valid
        depth = in_camera[np.isfinite(in_camera).all(axis=-1)][:, 2].astype(np.float64)
    middle = float(np.median(depth)) if len(depth) else float("nan")
    near, far = seen_depth_mm if seen_depth_mm[0] < seen_depth_mm[1] else _ANY_DEPTH_MM
    if np.isnan(middle) or near / _FAR_OFF <= middle <= far * _FAR_OFF:
        return
    if middle <= 0:
        raise DataError(
            f"the scan of shot {shot.index} lies at the camera or behind it (z {middle:.3g})",
            file=session.folder / str(shot.scan),
            remedy="Is z its line of sight? Holes are NaN, not zero.",
        )
    ratio = (near * far) ** 0.5 / middle
    unit, _ = min(_UNITS.items(), key=lambda unit: abs(np.log(ratio / unit[1])))
    raise DataError(
        f"the scan of shot {shot.index} lies {middle:.3g} from the camera, which was calibrated from {near:.0f} to {far:.0f} mm",
        file=session.folder / str(shot.scan),
        remedy=f"It is probably in {unit}: scans are in mm.",
    )


def _view(system: StitchingSystem, shot: Shot) -> View:
    from measure.stitching.scan_kernels import View

    flange = np.asarray(shot.base_from_flange if system.model is None else system.base_from_flange(np.asarray(shot.joints_rad)), dtype=np.float64)
    camera = flange @ system.flange_from_camera
    return View(np.ascontiguousarray(camera[:3, 3]), np.ascontiguousarray(camera[:3, 2]), np.ascontiguousarray(flange[:3, 3]))


def _point_noise(noise: NoiseModel) -> PointNoise:
    from measure.stitching.scan_kernels import PointNoise

    squares = (noise.pose_mm**2, noise.pose_rad**2, noise.form_mm**2, noise.point_mm**2)
    return PointNoise(*squares, noise.flat, noise.steep, noise.range_power, noise.range_mm, unit_variance_mm2(noise))


def _lattice(system: StitchingSystem, shot: Shot, in_camera: NDArray[np.float32]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lower corner (3,) and spacing (3,) of a lattice over x/z, y/z and z, and the calibration's covariances (a, b, c, 6) on it."""
    some = in_camera.reshape(-1, 3)[:: max(1, in_camera.size // 15_000)].astype(np.float64)
    some = some[np.isfinite(some).all(axis=1) & (np.abs(some[:, 2]) > 1e-3)]
    if not len(some):
        some = np.array([[0.0, 0.0, 400.0]])
    # single points far away must not stretch the lattice
    low, high = np.percentile(np.column_stack([some[:, 0] / some[:, 2], some[:, 1] / some[:, 2], some[:, 2]]), [0.5, 99.5], axis=0)
    spacing = np.maximum((high - low) / (np.array(_LATTICE) - 1), [1e-3, 1e-3, 1.0])
    tx, ty, z = (axis.reshape(-1) for axis in np.meshgrid(*(low[i] + spacing[i] * np.arange(n) for i, n in enumerate(_LATTICE)), indexing="ij"))
    nodes = np.column_stack([tx * z, ty * z, z])
    pose = {"base_from_flange": shot.base_from_flange} if system.model is None else {"joints_rad": shot.joints_rad}
    jacobian = system.point_jacobian(nodes, **pose)
    used = system.covariance[: jacobian.shape[-1], : jacobian.shape[-1]]
    covariance = jacobian @ used @ np.swapaxes(jacobian, -1, -2)
    rows, columns = np.triu_indices(3)
    return low, spacing, np.ascontiguousarray(covariance[:, rows, columns].reshape(*_LATTICE, 6))


def pixel_step_per_depth(xyz_mm: NDArray[np.float32]) -> float:
    """Median distance of neighbouring lines of sight at depth 1, NaN where no two neighbours are valid.

    Taken from x/z and y/z, which a step in depth does not change, along some rows and some columns.
    """
    medians = [_median_step(lines) for lines in (_some(xyz_mm), _some(xyz_mm.swapaxes(0, 1)))]
    return max((median for median in medians if np.isfinite(median)), default=float("nan"))


def _some(lines: NDArray[np.float32]) -> NDArray[np.float32]:
    return lines[:: max(1, len(lines) // _LINES_LOOKED_AT)]


def _median_step(lines_mm: NDArray[np.float32]) -> float:
    """Of points (k, m, 3) along their second axis."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        rays = lines_mm[..., :2].astype(np.float64) / lines_mm[..., 2:]
        lengths = np.linalg.norm(np.diff(rays, axis=1), axis=-1)
    steps = lengths[np.isfinite(lengths)]
    return float(np.median(steps)) if len(steps) else float("nan")
