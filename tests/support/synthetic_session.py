"""Sessions on disk from `tests.support.synthetic` shots: what an external simulation would hand to the command line."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from drivers.files.ply import encode_ply
from drivers.files.yaml import dump_yaml, parse_yaml
from drivers.kinematics.se3 import FloatArray
from tests.support.synthetic import SyntheticCell, SyntheticShot

TIME = "2026-01-01T00:00:00Z"


def write_session(
    folder: Path,
    cell: SyntheticCell,
    shots: Mapping[str, Sequence[SyntheticShot]],
    *,
    flange_from_camera: FloatArray | None,
    lengths: Sequence[tuple[str, str, float, float]] = (),
    extra_cell: Mapping[str, object] | None = None,
    order: Sequence[int] | None = None,
) -> Path:
    """A session with shots of named spheres; `order` renumbers them."""
    (folder / "scans").mkdir(parents=True)
    (folder / "cell.yaml").write_text(dump_yaml(cell_data(cell, tuple(shots), flange_from_camera, lengths, extra_cell)))
    head = {"format": "spherecal-session/1", "purpose": "calibration", "cell": "cell.yaml", "created_utc": TIME, "software": "tests"}
    (folder / "session.yaml").write_text(dump_yaml(head))
    flat = [(name, shot) for name, members in shots.items() for shot in members]
    lines = []
    for index, source in enumerate(order if order is not None else range(len(flat))):
        name, shot = flat[source]
        data = bytes(encode_ply(shot.points_in_camera_mm.astype(np.float32), comments=("unit mm", "frame camera")))
        scan = f"scans/{index:04d}.ply"
        (folder / scan).write_bytes(data)
        line = {"index": index, "sphere": name, "joints_rad": shot.joints_rad.tolist(), "base_from_flange": None, "scan": scan}
        lines.append(json.dumps(line | {"sha256": hashlib.sha256(data).hexdigest(), "time_utc": TIME}))
    (folder / "shots.jsonl").write_text("\n".join(lines) + "\n")
    return folder


def warm(folder: Path, readings_c: Sequence[Mapping[str, float]]) -> Path:
    """Give the shots of a session temperatures, one mapping after the other and over again."""
    lines = [json.loads(line) for line in (folder / "shots.jsonl").read_text().splitlines()]
    told = [line | {"temperatures_c": dict(readings_c[i % len(readings_c)])} for i, line in enumerate(lines)]
    (folder / "shots.jsonl").write_text("\n".join(json.dumps(line) for line in told) + "\n")
    return folder


def cell_data(
    cell: SyntheticCell,
    spheres: Sequence[str],
    flange_from_camera: FloatArray | None,
    lengths: Sequence[tuple[str, str, float, float]],
    extra: Mapping[str, object] | None,
) -> dict[str, object]:
    """The cell file's data."""
    data: dict[str, object] = {
        "format": "spherecal-cell/1",
        "name": "synthetic",
        "robot": {"driver": "simulated", "model": cell.nominal.name},
        "camera": {"driver": "simulated", "kind": "area", "working_range_mm": [250, 750], "sight_crossing_mm": [60, 0, 500]},
        "flange_from_camera": None if flange_from_camera is None else flange_from_camera.tolist(),
        "spheres": {name: {"diameter_mm": 2 * cell.radius_mm, "expanded_uncertainty_mm": 0.001} for name in spheres},
        "lengths": [{"between": [a, b], "length_mm": length, "expanded_uncertainty_mm": u} for a, b, length, u in lengths],
    }
    return data | dict(extra or {})


def pose_only(folder: Path, base_from_flange: Sequence[FloatArray]) -> Path:
    """Take the axis angles out of a session, and the robot's model out of its cell; poses (4, 4) come instead."""
    lines = [json.loads(line) for line in (folder / "shots.jsonl").read_text().splitlines()]
    told = [line | {"joints_rad": None, "base_from_flange": pose.tolist()} for line, pose in zip(lines, base_from_flange, strict=True)]
    (folder / "shots.jsonl").write_text("\n".join(json.dumps(line) for line in told) + "\n")
    data = parse_yaml((folder / "cell.yaml").read_text(), file=folder / "cell.yaml")
    if isinstance(data, dict):
        data["robot"]["model"] = None
    (folder / "cell.yaml").write_text(dump_yaml(data))
    return folder
