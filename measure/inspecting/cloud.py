"""The measured cloud: what stitching wrote, or any PLY, PCD or NPZ of points in mm; checked before it is believed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DataError, FileError
from drivers.files.clouds import parse_cloud
from drivers.files.ply import PointCloud, read_ply
from drivers.kinematics.se3 import FloatArray
from drivers.registry import hardware_remark, untried_drivers

FEWEST_POINTS = 100
_FARTHEST_MM = 1e6
BoolArray = NDArray[np.bool_]
_COARSE_FROM_MM = 16_384.0
"""From here on float32 steps by more than 0.001 mm."""
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
_WEIGHTS = ("weight", "count")
_UNCERTAINTIES = ("uncertainty", "uncertainty_mm", "sigma", "sigma_mm")
_UNIT_MM = re.compile(r"unit[ :_]+(\w+)", re.IGNORECASE)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredCloud:
    """Finite points with what the file says of them."""

    file: Path
    points_mm: FloatArray
    """(n, 3)."""
    normals: FloatArray | None
    """(n, 3) unit, of either direction."""
    weights: FloatArray
    """(n,) of the raw points that each point stands for; 1 where the file does not tell."""
    standard_uncertainty_mm: float | None
    """Median of what the file states of a point's coordinate."""
    calibration_id: str | None
    session_digest: str | None
    voxel_mm: float | None
    notes: tuple[str, ...]


def load_cloud(path: str | Path) -> MeasuredCloud:
    """Read a cloud in the base.

    Raises:
        FileError: missing or broken; metres or a camera's frame in its header.
        DataError: too few finite points, or farther away than any robot reaches.
    """
    file = Path(path)
    return cloud_of(read_ply(file) if file.suffix.lower() == ".ply" else parse_cloud(_bytes(file), file=file), file)


def cloud_of(cloud: PointCloud, file: Path) -> MeasuredCloud:
    """What is measured of a cloud that was read, or that has not been written yet; raises as `load_cloud`."""
    header = _header(cloud)
    _require_base_in_mm(header, file)
    points = cloud.points_mm.astype(np.float64)
    finite: BoolArray = np.asarray(np.isfinite(points).all(axis=1))
    near = np.asarray(finite & (np.abs(np.where(finite[:, None], points, 0.0)) <= _FARTHEST_MM).all(axis=1))
    _require_some(len(points), int(finite.sum()), int(near.sum()), file)
    kept = points[near]
    untried = untried_drivers(*header.get("drivers", "").split())
    notes = (*_remarks(kept, int(finite.sum() - near.sum())), *map(hardware_remark, untried))
    return MeasuredCloud(
        file=file,
        points_mm=kept,
        normals=_normals(cloud, near),
        weights=_weights(cloud, near),
        standard_uncertainty_mm=_uncertainty(cloud, near),
        calibration_id=header.get("calibration"),
        session_digest=header.get("session"),
        voxel_mm=_number(header.get("voxel_mm")),
        notes=notes,
    )


def _bytes(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise FileError(f"cannot be read ({error.strerror})", file=file, remedy="Check the path and its permissions.") from error


def _header(cloud: PointCloud) -> Mapping[str, str]:
    """Comments "key value" of the file."""
    pairs = [comment.split(maxsplit=1) for comment in cloud.comments]
    return {pair[0].lower().rstrip(":"): pair[1] for pair in pairs if len(pair) == 2}


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None


def _require_base_in_mm(header: Mapping[str, str], file: Path) -> None:
    unit = header.get("unit", "mm").split()[0].lower()
    if unit not in {"mm", "millimetre", "millimeter", "millimetres", "millimeters"}:
        raise FileError(f"its header says unit {unit}", file=file, where="header", remedy="Clouds are in mm: stitch or export it again.")
    if header.get("frame", "base").split()[0].lower() == "camera":
        raise FileError("is a scan in the camera frame", file=file, where="header", remedy="Stitch the session first: `spherecal stitch`.")


def _require_some(n_all: int, n_finite: int, n_near: int, file: Path) -> None:
    if n_near >= FEWEST_POINTS:
        return
    if n_finite > n_near:
        message = f"{n_finite - n_near} of {n_finite} points lie more than {_FARTHEST_MM / 1e6:g} km away"
        raise DataError(message, file=file, remedy="These are no coordinates in mm of a robot's base.")
    found = "holds no points" if n_all == 0 else f"holds {n_finite} finite points of {n_all}"
    raise DataError(f"{found}; an inspection takes {FEWEST_POINTS} at least", file=file, remedy="Look at the scans and at how they were stitched.")


def _remarks(points: FloatArray, n_far: int) -> tuple[str, ...]:
    notes = [f"{n_far} points beyond {_FARTHEST_MM / 1e6:g} km were dropped"] if n_far else []
    farthest = float(np.abs(np.median(points, axis=0)).max())
    if farthest > _COARSE_FROM_MM:
        step = float(np.spacing(np.float32(farthest)))
        notes.append(f"the cloud lies {farthest / 1000:.0f} m from its origin, where float coordinates step by {step:.2g} mm")
    return tuple(notes)


def _normals(cloud: PointCloud, kept: BoolArray) -> FloatArray | None:
    names = next((names for names in _NORMALS if all(name in cloud.properties for name in names)), None)
    if names is None:
        return None
    normals = np.column_stack([np.asarray(cloud.properties[name], dtype=np.float64).reshape(-1)[kept] for name in names])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(length > 0.5, normals / np.where(length > 0, length, 1.0), np.nan))


def _weights(cloud: PointCloud, kept: BoolArray) -> FloatArray:
    name = next((name for name in _WEIGHTS if name in cloud.properties), None)
    if name is None:
        return np.ones(int(kept.sum()))
    values = np.asarray(cloud.properties[name], dtype=np.float64).reshape(-1)[kept]
    return np.where(np.isfinite(values) & (values > 0), values, 0.0)


def _uncertainty(cloud: PointCloud, kept: BoolArray) -> float | None:
    name = next((name for name in _UNCERTAINTIES if name in cloud.properties), None)
    if name is None:
        return None
    values = np.asarray(cloud.properties[name], dtype=np.float64).reshape(-1)[kept]
    values = values[np.isfinite(values) & (values > 0)]
    return float(np.median(values)) if len(values) else None
