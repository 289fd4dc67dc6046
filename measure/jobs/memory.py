"""How much memory a job may take, and how much there is."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

MB = 1024.0 * 1024.0
TABLE_MB = 700.0
"""Budget of the voxel table, which goes to disk beyond it."""
_PROGRAM_MB = 220.0
_BYTES_A_BYTE = 8.0
"""Of a scan while it is worked on, for each byte of its file."""
_BYTES_PER_VOXEL = 200.0
_TABLE_FACTOR = 1.6
"""Of the table's budget, while it is put in order and written."""
_BYTES_PER_POINT = 12.0
_SHARE = 0.7


def estimated_mb(scan_bytes: Sequence[int], n_threads: int) -> float:
    """What a job takes at most: program, the scans in hand, and the voxel table.

    The figures are of resident memory, measured for 6 scans of 1 M points on Linux x86_64: 272 MB with few voxels and one
    thread, 357 MB with two, 868 MB with 3.1 M voxels, 1392 MB with 5.9 M.

    Args:
        scan_bytes: sizes of the part's clouds.
        n_threads: scans worked on at a time.
    """
    voxels = min(_BYTES_PER_VOXEL * sum(scan_bytes) / _BYTES_PER_POINT / MB, _TABLE_FACTOR * TABLE_MB)
    return _PROGRAM_MB + n_threads * _BYTES_A_BYTE * max(scan_bytes, default=0) / MB + voxels


def budget_mb() -> float:
    """The part of the memory that is free now, in this computer or container, which jobs may share."""
    found = [_available_mb()]
    with suppress(OSError, ValueError):
        limit = Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii").strip()
        used = int(Path("/sys/fs/cgroup/memory.current").read_text(encoding="ascii"))
        if limit != "max":
            found.append((int(limit) - used) / MB)
    return _SHARE * min(found)


def _available_mb() -> float:
    with suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return float(line.split()[1]) / 1024.0
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / MB
