"""Streaming voxel fusion: any number of clouds into one table, one mean point per voxel.

Voxels are cubes anchored at the origin of the base (voxel i spans [i, i + 1) * voxel_mm), so clouds of different
scans, runs and computers fall into the same ones. Sums are integers: the result is the same to the last bit for any
order of the clouds, any split of the work and any number of threads. Memory grows with the surface, not with the scans.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DataError, SettingsError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_LOAD_LIMIT = 0.7
_START_CAPACITY = 1 << 12
_GROWS_FOURFOLD_BELOW = 1 << 20
_LINES_LOOKED_AT = 32


@dataclass(frozen=True, slots=True)
class AddedPoints:
    """What became of one cloud."""

    n_added: int
    n_invalid: int
    """Rows with a NaN or an infinity."""
    n_outside: int
    """Rows more than 2^20 voxels from the base's origin (105 m with 0.1 mm voxels), which no robot reaches."""


@dataclass(frozen=True, slots=True, eq=False)
class FusedCloud:
    """One point per occupied voxel, in rising order of the voxel's x, y and z index."""

    points_mm: FloatArray
    """(n, 3) mean of the voxel's points."""
    count: NDArray[np.int64]
    """(n,) points of the voxel."""
    spread_mm: FloatArray
    """(n,) rms distance of the voxel's points from their mean; 0 for a single point."""
    voxel_mm: float


class VoxelGrid:
    """A growing hash table of voxels, filled cloud by cloud."""

    def __init__(self, voxel_mm: float) -> None:
        if not (np.isfinite(voxel_mm) and voxel_mm > 0):
            raise SettingsError(f"voxel size {voxel_mm} mm is not a positive number", where="voxel_mm", remedy="Choose for example 0.5.")
        self.voxel_mm = float(voxel_mm)
        self._table = _empty_table(_START_CAPACITY)
        self._n_used = 0

    @property
    def n_voxels(self) -> int:
        """Number of occupied voxels."""
        return self._n_used

    def add(self, points_mm: NDArray[np.floating]) -> AddedPoints:
        """Add points (n, 3) or (h, w, 3) in the frame of the grid, mm; rows with NaN are counted and left out.

        Raises:
            DataError: a voxel holds more points than the integer sums can carry (67 million).
        """
        from measure import fuse_kernels as kernels

        points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 3)
        fates = np.zeros(kernels.FATES, dtype=np.int64)
        row = 0
        while row < points.shape[0]:
            limit = int(_LOAD_LIMIT * self._table.shape[0])
            row, self._n_used = kernels.insert(self._table, fates, points, row, self._n_used, limit, self.voxel_mm)
            if self._n_used >= limit:
                capacity = self._table.shape[0]
                self._grow_to((4 if capacity < _GROWS_FOURFOLD_BELOW else 2) * capacity)
        if fates[kernels.CROWDED]:
            raise DataError(
                f"a voxel of {self.voxel_mm:g} mm holds more than {kernels.COUNT_LIMIT} points",
                remedy="Use smaller voxels, or check that the robot really moved between the scans.",
            )
        return AddedPoints(int(fates[kernels.ADDED]), int(fates[kernels.INVALID]), int(fates[kernels.OUTSIDE]))

    def merge(self, other: VoxelGrid) -> None:
        """Add all that another grid of the same voxel size holds; exact, as if its points had been added here.

        Raises:
            SettingsError: the voxel sizes differ.
        """
        from measure import fuse_kernels as kernels

        if other.voxel_mm != self.voxel_mm:
            raise SettingsError(f"grids of {self.voxel_mm:g} and {other.voxel_mm:g} mm cannot be merged", remedy="Use one voxel size.")
        self._reserve(self._n_used + other.n_voxels)
        self._n_used += int(kernels.absorb(self._table, other._table))

    def fused(self, *, min_count: int = 1) -> FusedCloud:
        """The cloud so far; voxels with fewer than `min_count` points are left out."""
        from measure import fuse_kernels as kernels

        slots = np.flatnonzero(self._table[:, kernels.COUNT] >= max(1, min_count))
        slots = slots[np.argsort(self._table[slots, kernels.KEY])]
        points, spread = np.empty((len(slots), 3)), np.empty(len(slots))
        kernels.summarise(self._table, slots, self.voxel_mm, points, spread)
        return FusedCloud(points, self._table[slots, kernels.COUNT], spread, self.voxel_mm)

    def _reserve(self, n_voxels: int) -> None:
        capacity = self._table.shape[0]
        while n_voxels >= int(_LOAD_LIMIT * capacity):
            capacity *= 2
        if capacity > self._table.shape[0]:
            self._grow_to(capacity)

    def _grow_to(self, capacity: int) -> None:
        from measure import fuse_kernels as kernels

        larger = _empty_table(capacity)
        kernels.absorb(larger, self._table)
        self._table = larger


def flying_pixel_mask(xyz_mm: NDArray[np.float32], *, max_step_ratio: float = 6.0, min_neighbours: int = 3) -> NDArray[np.bool_]:
    """Which points of an organised scan (h, w, 3) lie on a surface: True to keep, (h, w).

    A flying pixel hangs between the front and the back of a depth edge, away from its neighbours. A point is kept
    when at least `min_neighbours` of its 8 neighbours are nearer than `max_step_ratio` lateral pixel steps, which
    at 6 leaves surfaces tilted up to 80 degrees alone. NaN rows and scans without a grid's neighbours give False.
    """
    from measure import fuse_kernels as kernels

    xyz = np.ascontiguousarray(xyz_mm, dtype=np.float32)
    step = _pixel_step_per_depth(xyz)
    if not np.isfinite(step):
        return np.zeros(xyz.shape[:2], dtype=np.bool_)
    return np.asarray(kernels.supported(xyz, max_step_ratio * step, min_neighbours))


def _pixel_step_per_depth(xyz_mm: NDArray[np.float32]) -> float:
    """Median distance of neighbouring lines of sight at depth 1, NaN where no two neighbours are valid.

    Taken from x/z and y/z, which a step in depth does not change, along some rows and some columns.
    """
    medians = [_median_step(lines) for lines in (_some(xyz_mm), _some(xyz_mm.swapaxes(0, 1)))]
    return max((median for median in medians if np.isfinite(median)), default=float("nan"))


def _some(lines: NDArray[np.float32]) -> NDArray[np.float32]:
    return lines[:: max(1, len(lines) // _LINES_LOOKED_AT)]


def _median_step(lines_mm: NDArray[np.float32]) -> float:
    """Of points (k, m, 3) along their second axis."""
    with np.errstate(invalid="ignore", divide="ignore"):
        rays = lines_mm[..., :2].astype(np.float64) / lines_mm[..., 2:]
    steps = np.hypot(*np.moveaxis(np.diff(rays, axis=1), -1, 0))
    finite = steps[np.isfinite(steps)]
    return float(np.median(finite)) if finite.size else float("nan")


def _empty_table(capacity: int) -> IntArray:
    from measure import fuse_kernels as kernels

    return np.zeros((capacity, kernels.COLUMNS), dtype=np.int64)
