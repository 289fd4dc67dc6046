"""Streaming voxel fusion: any number of clouds into one growing table, one weighted mean point per voxel.

Voxels are cubes anchored at the origin of the base (voxel i spans [i, i + 1) * voxel_mm), so clouds of different
scans, runs and computers fall into the same ones. Sums are integers: the result is the same to the last bit for any
order of the clouds, any split of the work and any number of threads. Memory grows with the surface, not with the scans;
beyond a budget the table goes to disk (`measure.stitching.tiles`).
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DataError, SettingsError
from measure.stitching.tiles import Tiles

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

DEFAULT_MEMORY_MB = 700
PIECE = 1 << 17
"""Voxels that are summarised and written at a time."""


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
    """(n, 3) weighted mean of the voxel's points."""
    count: NDArray[np.int32]
    """(n,) points of the voxel."""
    weight: NDArray[np.float32]
    """(n,) sum of their weights; a reference point counts 1."""
    scans: NDArray[np.int32]
    """(n,) scans that the points come from."""
    spread_mm: NDArray[np.float32]
    """(n,) weighted rms distance of the voxel's points from their mean; 0 for a single point. NaN where only means are kept."""
    normals: NDArray[np.float32]
    """(n, 3) unit normal, out of the material; NaN where no organised scan told it."""
    uncertainty_mm: NDArray[np.float32]
    """(n,) standard uncertainty (k = 1) of the point along its normal; NaN where the calibration is not known."""
    voxel_mm: float

    @classmethod
    def joined(cls, pieces: list[Self], voxel_mm: float) -> Self:
        """Pieces one after the other."""
        if not pieces:
            empty, whole = np.zeros(0, dtype=np.float32), np.zeros(0, dtype=np.int32)
            return cls(np.zeros((0, 3)), whole, empty, whole, empty, np.zeros((0, 3), dtype=np.float32), empty, voxel_mm)
        names = [field.name for field in fields(cls) if field.name != "voxel_mm"]
        return cls(**{name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in names}, voxel_mm=voxel_mm)


class _Columns(NamedTuple):
    """The points of one scan as the kernels take them; see `fuse_kernels.insert`."""

    keys: IntArray
    fractions: NDArray[np.int16]
    parts: NDArray[np.uint8]
    present: NDArray[np.uint32]
    weights: NDArray[np.uint8]
    normals: NDArray[np.int16]
    variances: NDArray[np.uint32]


@dataclass(slots=True, eq=False)
class _Part:
    """The voxels of some blocks: an index of 32-bit entries, and rows in the order in which they were first seen."""

    index: NDArray[np.uint32]
    rows: IntArray
    n_rows: int
    lock: threading.Lock

    @classmethod
    def empty(cls, words: int) -> _Part:
        from measure import fuse_kernels as kernels

        index = np.zeros(2 * kernels.FIRST_CAPACITY, dtype=np.uint32)
        return cls(index, np.empty((kernels.FIRST_CAPACITY, words), dtype=np.int64), 0, threading.Lock())

    @property
    def n_bytes(self) -> int:
        """Memory of what is used: untouched pages cost nothing."""
        return int(self.n_rows * self.rows.shape[1] * 8 + self.index.nbytes)

    def make_room(self, n_rows: int) -> None:
        """Grow until so many rows fit; the rows by half, so that the copy needs little more than they do."""
        from measure import fuse_kernels as kernels

        if n_rows > kernels.ROW_LIMIT:
            raise DataError(f"more than {kernels.ROW_LIMIT * kernels.PARTS} voxels", remedy="Use larger voxels, or a smaller memory budget.")
        if n_rows > self.rows.shape[0]:
            rows = np.empty((max(n_rows, min(kernels.ROW_LIMIT, self.rows.shape[0] * 3 // 2)), self.rows.shape[1]), dtype=np.int64)
            rows[: self.n_rows] = self.rows[: self.n_rows]
            self.rows = rows
        size = len(self.index)
        while n_rows > size // 2:
            size *= 2 if size >= 1 << 14 else 4
        if size > len(self.index):
            self.index = np.zeros(size, dtype=np.uint32)
            kernels.index_rows(self.index, self.rows, self.n_rows)


class VoxelGrid:
    """A growing hash table of voxels, filled cloud by cloud; several threads may add at once."""

    def __init__(
        self,
        voxel_mm: float,
        *,
        full: bool = True,
        unit_variance_mm2: float = float("nan"),
        memory_mb: float = DEFAULT_MEMORY_MB,
        spill_folder: Path | None = None,
    ) -> None:
        """An empty grid.

        Args:
            voxel_mm: edge of the voxels.
            full: keep normals, spread and uncertainty too; otherwise means, counts and weights, in less than half the memory.
            unit_variance_mm2: predicted random variance of a point of weight 1, for the uncertainty.
            memory_mb: beyond it the table goes to disk.
            spill_folder: where to; the system's folder for temporary files if None.

        Raises:
            SettingsError: a size that is no positive number.
        """
        from measure import fuse_kernels as kernels

        for what, value in (("voxel size", voxel_mm), ("memory budget", memory_mb)):
            if not (np.isfinite(value) and value > 0):
                unit, where = ("mm", "voxel_mm") if what == "voxel size" else ("MB", "memory_mb")
                raise SettingsError(f"{what} {value} {unit} is not a positive number", where=where, remedy="Choose for example 0.5 mm and 700 MB.")
        self.voxel_mm = float(voxel_mm)
        self.full = full
        self._unit_variance_mm2 = unit_variance_mm2
        self._budget = memory_mb * 1e6
        self._words = kernels.FULL_WORDS if full else kernels.MEAN_WORDS
        self._parts = [_Part.empty(self._words) for _ in range(kernels.PARTS)]
        self._tiles = Tiles(self._words, spill_folder)
        self._scans = itertools.count(1)
        self._emptying = threading.Lock()

    @property
    def n_voxels(self) -> int:
        """Number of occupied voxels; those on disk are merged for it."""
        return self._settled_tiles().n_rows if self._tiles.n_runs else sum(part.n_rows for part in self._parts)

    @property
    def n_tiles(self) -> int:
        """How often the table went to disk."""
        return self._tiles.n_spills

    def add(
        self,
        points_mm: NDArray[np.floating],
        *,
        weights: NDArray[np.uint8] | None = None,
        normals: NDArray[np.int16] | None = None,
        variances: NDArray[np.uint32] | None = None,
    ) -> AddedPoints:
        """Add the points (n, 3) or (h, w, 3) of one scan in the frame of the grid, mm; rows with NaN are counted and left out.

        Args:
            points_mm: the points.
            weights: (n,) or (h, w), in units of 1 / UNIT_WEIGHT; 0 leaves a point out. None: all weigh 1.
            normals: like the points, in steps of 1 / NORMAL_STEPS.
            variances: like the weights: the calibration's variance along the normal, in steps of VARIANCE_STEP_MM2.

        Raises:
            DataError: a voxel holds more points than the integer sums can carry (8 million of the greatest weight).
            FileError: the table must go to disk, and cannot.
        """
        from measure import fuse_kernels as kernels

        points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 3)
        n = len(points)
        weight = np.full(n, kernels.UNIT_WEIGHT, dtype=np.uint8) if weights is None else weights.reshape(-1)
        normal = np.zeros((0, 3), dtype=np.int16) if normals is None else normals.reshape(-1, 3)
        variance = np.zeros(0, dtype=np.uint32) if variances is None else variances.reshape(-1)
        keys, fractions, parts = np.empty(n, dtype=np.int64), np.empty((n, 3), dtype=np.int16), np.empty(n, dtype=np.uint8)
        present, fates = np.zeros(-(-n // kernels.BAND), dtype=np.uint32), np.zeros(kernels.FATES, dtype=np.int64)
        kernels.quantise(points, weight, self.voxel_mm, keys, fractions, parts, present, fates)
        columns = _Columns(keys, fractions, parts, present, weight, normal, variance)
        self._insert(next(self._scans), int(np.bitwise_or.reduce(present, initial=0)), columns, fates)
        if fates[kernels.CROWDED]:
            raise DataError(
                f"a voxel of {self.voxel_mm:g} mm holds more points than can be summed (8 million of the greatest weight)",
                remedy="Use smaller voxels, or check that the robot really moved between the scans.",
            )
        if sum(part.n_bytes for part in self._parts) > self._budget:
            self._empty_to_disk()
        return AddedPoints(int(fates[kernels.ADDED]), int(fates[kernels.INVALID]), int(fates[kernels.OUTSIDE]))

    def _insert(self, scan: int, present: int, columns: _Columns, fates: IntArray) -> None:
        """One scan into the parts that its points belong to; each part is locked for the whole scan, so that scans are counted once."""
        from measure import fuse_kernels as kernels

        waiting = [number for number in range(kernels.PARTS) if present >> number & 1]
        while waiting:
            number = next((number for number in waiting if self._parts[number].lock.acquire(blocking=False)), None)
            if number is None:
                number = waiting[scan % len(waiting)]
                self._parts[number].lock.acquire()
            waiting.remove(number)
            part = self._parts[number]
            try:
                row, n_points = 0, len(columns.keys)
                while row < n_points:
                    halves = part.rows.view(np.int32)
                    row, part.n_rows = kernels.insert(part.index, part.rows, halves, part.n_rows, number, row, *columns, scan, fates)
                    if row < n_points:
                        part.make_room(part.n_rows + 1)
            finally:
                part.lock.release()

    def merge(self, other: VoxelGrid) -> None:
        """Add all that another grid of the same kind holds, of other scans; exact, as if they had been added here.

        Raises:
            SettingsError: voxel sizes or kinds differ, or the other one went to disk.
        """
        from measure import fuse_kernels as kernels

        if (other.voxel_mm, other.full) != (self.voxel_mm, self.full) or other.n_tiles:
            raise SettingsError(
                f"grids of {self.voxel_mm:g} and {other.voxel_mm:g} mm, of two kinds, or on disk cannot be merged", remedy="Use one voxel size."
            )
        for part, added in zip(self._parts, other._parts, strict=True):
            rows = added.rows[: added.n_rows]
            with part.lock:
                part.make_room(part.n_rows + len(rows))
                part.n_rows = kernels.absorb(part.index, part.rows, part.rows.view(np.int32), part.n_rows, rows, rows.view(np.int32))

    def fused(self, *, min_count: int = 1, box_mm: FloatArray | None = None) -> FusedCloud:
        """The cloud so far, in memory; voxels with fewer than `min_count` points are left out.

        Of a box (2, 3) the voxels that touch it, as they stand in the whole cloud.
        """
        return FusedCloud.joined(list(self.pieces(min_count=min_count, box_mm=box_mm)), self.voxel_mm)

    def n_fused(self, *, min_count: int = 1) -> int:
        """Number of points that `fused` has."""
        from measure import fuse_kernels as kernels

        if min_count <= 1:
            return self.n_voxels
        return sum(int((rows.view(np.int32)[:, kernels.COUNT] >= min_count).sum()) for rows in self._unsorted())

    def pieces(self, *, min_count: int = 1, box_mm: FloatArray | None = None) -> Iterator[FusedCloud]:
        """The cloud so far, piece by piece in order; the grid must not be filled meanwhile. For `box_mm` see `fused`."""
        from measure import fuse_kernels as kernels

        for rows in self._sorted() if box_mm is None else self._sorted_in(box_mm):
            kept = rows if min_count <= 1 else rows[rows.view(np.int32)[:, kernels.COUNT] >= min_count]
            if len(kept):
                yield self._summarised(kept)

    def _unsorted(self) -> Iterator[IntArray]:
        return self._settled_tiles().pieces(PIECE) if self._tiles.n_runs else (part.rows[: part.n_rows] for part in self._parts)

    def _sorted(self) -> Iterator[IntArray]:
        return self._settled_tiles().pieces(PIECE) if self._tiles.n_runs else self._sorted_parts()

    def _sorted_in(self, box_mm: FloatArray) -> Iterator[IntArray]:
        """The rows of a box, in order, none of the others put in order or copied."""
        from measure import fuse_kernels as kernels

        low, high = (np.clip(np.floor(corner / self.voxel_mm), -kernels.HALF_RANGE, kernels.HALF_RANGE) for corner in np.asarray(box_mm))

        def inside(rows: IntArray) -> IntArray:
            chosen = np.arange(len(rows))
            for axis in range(3):
                at = kernels.voxel_index(rows[chosen, kernels.KEY], axis)
                chosen = chosen[(at >= low[axis]) & (at <= high[axis])]
            return rows[chosen]

        found = [inside(rows) for rows in self._unsorted()]
        together = np.concatenate(found) if found else np.empty((0, self._words), dtype=np.int64)
        together = together[np.argsort(together[:, kernels.KEY])]
        return (together[first : first + PIECE] for first in range(0, len(together), PIECE))

    def _sorted_parts(self) -> Iterator[IntArray]:
        from measure import fuse_kernels as kernels

        starts = np.concatenate([[0], np.cumsum([part.n_rows for part in self._parts])])
        # no key stands twice in a table, so any way of sorting gives the same order
        order = np.argsort(np.concatenate([part.rows[: part.n_rows, kernels.KEY] for part in self._parts]))
        tables = tuple(part.rows for part in self._parts)
        for first in range(0, len(order), PIECE):
            chosen = order[first : first + PIECE]
            rows = np.empty((len(chosen), self._words), dtype=np.int64)
            kernels.gather(tables, starts, chosen, rows)
            yield rows

    def _settled_tiles(self) -> Tiles:
        """The tiles, with all that is still in memory, as one sorted run."""
        if any(part.n_rows for part in self._parts):
            self._empty_to_disk()
        self._tiles.settle()
        return self._tiles

    def _empty_to_disk(self) -> None:
        with self._emptying:
            for part in self._parts:
                part.lock.acquire()
            try:
                if any(part.n_rows for part in self._parts):
                    self._tiles.write_run(self._sorted_parts())
                for part in self._parts:
                    fresh = _Part.empty(self._words)
                    part.index, part.rows, part.n_rows = fresh.index, fresh.rows, 0
            finally:
                for part in self._parts:
                    part.lock.release()

    def _summarised(self, rows: IntArray) -> FusedCloud:
        from measure import fuse_kernels as kernels

        n, halves = len(rows), rows.view(np.int32)
        points = np.empty((n, 3))
        spread, uncertainty = np.full(n, np.nan, dtype=np.float32), np.full(n, np.nan, dtype=np.float32)
        normals = np.full((n, 3), np.nan, dtype=np.float32)
        kernels.means(rows, halves, self.voxel_mm, points)
        if self.full:
            kernels.details(rows, halves, self.voxel_mm, self._unit_variance_mm2, spread, normals, uncertainty)
        weight = (halves[:, kernels.WEIGHT] / kernels.UNIT_WEIGHT).astype(np.float32)
        count, scans = halves[:, kernels.COUNT].copy(), halves[:, kernels.SCANS].copy()
        return FusedCloud(points, count, weight, scans, spread, normals, uncertainty, self.voxel_mm)
