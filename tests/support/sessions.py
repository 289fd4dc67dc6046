"""Sessions written by hand, without the code under test: what an integrator's own script would write."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

IDENTITY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]

CELL = """\
format: spherecal-cell/1
name: by hand
robot: {driver: recorded, model: ur5e}
camera: {driver: recorded}
flange_from_camera: null
spheres:
  A: {diameter_mm: 38.1, expanded_uncertainty_mm: 0.001}
"""

HEAD = """\
format: spherecal-session/1
purpose: calibration
cell: cell.yaml
created_utc: 2026-01-31T12:00:00Z
software: by hand
"""


def ply(points: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> bytes:
    """Bytes of a cloud (n, 3)."""
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    return header.encode() + points.astype("<f4").tobytes()


def shot_dict(index: int, **changes: object) -> dict[str, Any]:
    """A good line of shots.jsonl; its scan is not written."""
    shot: dict[str, Any] = {
        "index": index,
        "sphere": "A",
        "joints_rad": [0.1 * index, -1.5, 1.5, 0.0, 0.5, 0.0],
        "base_from_flange": IDENTITY,
        "scan": f"scans/{index:04d}.ply",
        "sha256": hashlib.sha256(scan_bytes(index)).hexdigest(),
        "time_utc": "2026-01-31T12:00:00Z",
    }
    return shot | changes


def scan_bytes(index: int) -> bytes:
    """The scan of a shot of `write_session`."""
    return ply(np.random.default_rng(index).normal([0, 0, 300], 1.0, size=(4, 3)).astype(np.float32))


def write_session(folder: Path, n_shots: int = 3, change: Callable[[list[dict[str, Any]]], None] | None = None) -> Path:
    """A good session of a UR5e, or one with changed lines."""
    shots = [shot_dict(i) for i in range(n_shots)]
    if change is not None:
        change(shots)
    (folder / "scans").mkdir(parents=True)
    (folder / "session.yaml").write_text(HEAD, encoding="utf-8")
    (folder / "cell.yaml").write_text(CELL, encoding="utf-8")
    for i in range(n_shots):
        (folder / "scans" / f"{i:04d}.ply").write_bytes(scan_bytes(i))
    write_lines(folder, [json.dumps(shot) for shot in shots])
    return folder


def write_lines(folder: Path, lines: Sequence[str]) -> None:
    """Replace shots.jsonl."""
    (folder / "shots.jsonl").write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
