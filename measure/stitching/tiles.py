"""Voxel tables beyond memory: sorted runs of rows on disk, merged into one.

A run holds what one full table held, in rising order of the keys. Runs are merged range by range, so that a small part
of them is in memory at a time; since rows hold integer sums, the merged table is the one that memory would have held.
"""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Iterable, Iterator
from pathlib import Path
from shutil import rmtree

import numpy as np
from numpy.typing import NDArray

from drivers.errors import FileError

IntArray = NDArray[np.int64]

_MERGED_AT_ONCE = 1 << 18


class Tiles:
    """Runs in a folder of their own, which goes away with this object."""

    def __init__(self, words: int, parent: Path | None) -> None:
        self._words = words
        self._parent = parent
        self._runs: list[Path] = []
        self._folder: Path | None = None
        self._n_written = 0
        self.n_spills = 0
        """How often a table went to disk."""

    @property
    def n_runs(self) -> int:
        """Runs on disk."""
        return len(self._runs)

    @property
    def n_rows(self) -> int:
        """Rows of all runs: voxels, once they are settled."""
        return sum(path.stat().st_size for path in self._runs) // (8 * self._words)

    def write_run(self, pieces: Iterable[IntArray]) -> None:
        """Write rows (n, words), sorted by key over all pieces.

        Raises:
            FileError: the folder is not writable or full.
        """
        try:
            path = self._new_path()
            with open(path, "wb") as stream:
                for rows in pieces:
                    stream.write(np.ascontiguousarray(rows).data)
        except OSError as error:
            raise FileError(
                f"the voxel table does not fit in memory and cannot be written ({error.strerror or error})",
                file=self._parent or tempfile.gettempdir(),
                remedy="Free room on that disk, allow more memory, or use larger voxels.",
            ) from error
        self._runs.append(path)
        self.n_spills += 1

    def settle(self) -> None:
        """Merge all runs into one; raises as `write_run`."""
        if len(self._runs) < 2:
            return
        old, spills = self._runs, self.n_spills
        self._runs = []
        try:
            self.write_run(_merged([_Run(path, self._words) for path in old]))
        except FileError:
            self._runs = old
            raise
        finally:
            self.n_spills = spills
        for path in old:
            path.unlink()

    def pieces(self, size: int) -> Iterator[IntArray]:
        """Rows (<= size, words) of the one run, in order."""
        for path in self._runs:
            run = _Run(path, self._words)
            for first in range(0, len(run), size):
                yield run.rows(first, size)

    def _new_path(self) -> Path:
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix=".voxels.", dir=self._parent))
            weakref.finalize(self, rmtree, self._folder, ignore_errors=True)
        self._n_written += 1
        return self._folder / f"{self._n_written:04d}.run"


class _Run:
    """Rows of a file, read and not mapped: mapped pages would count as memory of ours."""

    def __init__(self, path: Path, words: int) -> None:
        self._path = path
        self._words = words
        self._n_rows = path.stat().st_size // (8 * words)

    def __len__(self) -> int:
        return self._n_rows

    def rows(self, first: int, most: int) -> IntArray:
        """Up to so many rows from one on."""
        count = max(0, min(most, self._n_rows - first)) * self._words
        return np.fromfile(self._path, dtype=np.int64, count=count, offset=8 * self._words * first).reshape(-1, self._words)


def _merged(runs: list[_Run]) -> Iterator[IntArray]:
    """Rows of sorted runs in order, those of one voxel added up."""
    from measure import fuse_kernels as kernels

    step = max(1, _MERGED_AT_ONCE // len(runs))
    at = [0] * len(runs)
    while any(begin < len(run) for begin, run in zip(at, runs, strict=True)):
        blocks = [run.rows(begin, step) for begin, run in zip(at, runs, strict=True)]
        last = min(int(block[-1, kernels.KEY]) for block in blocks if len(block))
        taken = [int(np.searchsorted(block[:, kernels.KEY], last, side="right")) for block in blocks]
        rows = np.concatenate([block[:n] for block, n in zip(blocks, taken, strict=True)])
        rows = rows[np.argsort(rows[:, kernels.KEY], kind="stable")]
        at = [begin + n for begin, n in zip(at, taken, strict=True)]
        yield rows[: kernels.sum_equal_keys(rows, rows.view(np.int32))]
