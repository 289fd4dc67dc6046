"""How much memory a job may take, and how much there is."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

MB = 1024.0 * 1024.0
_PROGRAM_MB = 330.0
"""A worker with everything loaded and compiled (resident, measured on Linux x86_64: 290 MB)."""
_SCAN_FACTOR = 8.0
"""A scan and the one read ahead, each as bytes, as points and as masks."""
_BYTES_PER_VOXEL = 200.0
_BYTES_PER_POINT = 12.0
_SHARE = 0.7


def estimated_mb(scan_bytes: Sequence[int]) -> float:
    """What a job takes at most: program, the largest scan while it is worked on, and a voxel of its own for every point.

    Args:
        scan_bytes: sizes of the part's clouds.
    """
    largest, total = max(scan_bytes, default=0), sum(scan_bytes)
    return _PROGRAM_MB + (_SCAN_FACTOR * largest + _BYTES_PER_VOXEL * total / _BYTES_PER_POINT) / MB


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
