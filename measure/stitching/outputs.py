"""Fused clouds as files: PLY and PCD piece by piece, E57 and LAZ where their libraries are installed, and PLY back again."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import FileError, SettingsError
from drivers.files.disk import sync_folder, usual_mode, write_atomic_pieces
from drivers.files.ply import PointCloud, ply_header, read_ply
from measure.fuse import FusedCloud

SUFFIXES = (".ply", ".pcd", ".e57", ".laz", ".las")
_FLOATS, _WHOLE, _FURTHER = ("x", "y", "z", "nx", "ny", "nz"), ("count", "scans"), ("weight", "spread", "uncertainty")
_RECORD = np.dtype([(name, "<u4" if name in _WHOLE else "<f4") for name in (*_FLOATS, *_WHOLE, *_FURTHER)])
_LAS_SCALE_MM = 1e-4
_METRES_PER_MM = 1e-3


@dataclass(frozen=True, slots=True)
class CloudLabel:
    """What a file says of the cloud in it."""

    comments: tuple[str, ...]
    """Unit, frame, calibration, session and how the cloud was made, one fact a line."""
    identifier: str
    """One line for formats that have no comments."""


def check_suffix(out: Path) -> None:
    """Raise where a cloud cannot be written, before any work.

    Raises:
        SettingsError: an unknown ending, or a library that is not installed.
        FileError: no such folder.
    """
    if _ending(out) not in SUFFIXES:
        raise SettingsError(f"clouds are not written as {out.suffix}", where=str(out), remedy=f"Choose one of {', '.join(SUFFIXES)}.")
    if not out.parent.is_dir():
        raise FileError("no such folder", file=out.parent, remedy="Make it first.")
    if _ending(out) == ".e57":
        _pye57()
    if _ending(out) in {".laz", ".las"}:
        _laspy()


def _ending(out: Path) -> str:
    """A name without an ending is a PLY file."""
    return out.suffix.lower() or ".ply"


def write_cloud(out: Path, pieces: Iterable[FusedCloud], n_points: int, label: CloudLabel) -> None:
    """Write a cloud of n points, in the format that the name ends in; the file appears whole or not at all.

    Coordinates are mm in PLY, PCD and LAS/LAZ, and metres in E57, which knows no other unit.

    Raises:
        FileError: it cannot be written.
        SettingsError: as `check_suffix`.
    """
    check_suffix(out)
    match _ending(out):
        case ".ply":
            header = ply_header(_RECORD, (n_points,), label.comments)
            write_atomic_pieces(out, _with_header(header, pieces))
        case ".pcd":
            write_atomic_pieces(out, _with_header(_pcd_header(n_points, label.comments), pieces))
        case ".e57":
            _write_beside(out, lambda path: _write_e57(path, list(pieces), label))
        case _:
            _write_beside(out, lambda path: _write_las(path, pieces, label))


def as_written(cloud: FusedCloud, label: CloudLabel) -> PointCloud:
    """What `read_ply` gives of the PLY file that `write_cloud` makes of a cloud, without the file."""
    records = _records(cloud)
    points = np.column_stack([records[name] for name in ("x", "y", "z")])
    return PointCloud(points, {name: records[name] for name in (_RECORD.names or ())[3:]}, label.comments)


def read_fused(path: str | Path) -> FusedCloud:
    """A cloud that `write_cloud` wrote as PLY; what the file does not tell is NaN (counts: 1).

    Raises:
        FileError: as `read_ply`; it is not in mm.
    """
    cloud = read_ply(path)
    told = dict(line.split(maxsplit=1) for line in cloud.comments if len(line.split(maxsplit=1)) == 2)
    if told.get("unit", "mm") != "mm":
        raise FileError(f"the cloud is in {told['unit']}", file=path, remedy="Clouds are read in mm.")
    n, own = len(cloud.points_mm), cloud.properties
    missing = np.full(n, np.nan, dtype=np.float32)

    def column(name: str) -> NDArray[np.float32]:
        return np.asarray(own.get(name, missing), dtype=np.float32).reshape(-1)

    def whole(name: str) -> NDArray[np.int32]:
        return np.asarray(own.get(name, np.ones(n))).astype(np.int32).reshape(-1)

    normals = np.column_stack([column(name) for name in ("nx", "ny", "nz")])
    return FusedCloud(
        cloud.points_mm.astype(np.float64),
        whole("count"),
        column("weight"),
        whole("scans"),
        column("spread"),
        normals,
        column("uncertainty"),
        float(told.get("voxel_mm", "nan")),
    )


def _with_header(header: str, pieces: Iterable[FusedCloud]) -> Iterator[bytes]:
    yield header.encode()
    for piece in pieces:
        yield _records(piece).tobytes()


def _records(piece: FusedCloud) -> NDArray[np.void]:
    records = np.empty(len(piece.count), dtype=_RECORD)
    for name, values in _columns(piece).items():
        records[name] = values
    return records


def _columns(piece: FusedCloud) -> Mapping[str, NDArray[np.generic]]:
    axes = {name: piece.points_mm[:, i] for i, name in enumerate(("x", "y", "z"))}
    normals = {name: piece.normals[:, i] for i, name in enumerate(("nx", "ny", "nz"))}
    own = {"count": piece.count, "scans": piece.scans, "weight": piece.weight, "spread": piece.spread_mm, "uncertainty": piece.uncertainty_mm}
    return {**axes, **normals, **own}


def _pcd_header(n_points: int, comments: Sequence[str]) -> str:
    """Point Cloud Library's format, version 0.7; normals under the names that its readers know."""
    names = [{"nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}.get(name, name) for name in _RECORD.names or ()]
    types = ["U" if _RECORD[name].kind == "u" else "F" for name in _RECORD.names or ()]
    lines = ["# .PCD v0.7 - Point Cloud Data file format", *(f"# {' '.join(comment.split())}" for comment in comments), "VERSION 0.7"]
    lines += [f"FIELDS {' '.join(names)}", f"SIZE {' '.join(['4'] * len(names))}", f"TYPE {' '.join(types)}", f"COUNT {' '.join(['1'] * len(names))}"]
    lines += [f"WIDTH {n_points}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {n_points}", "DATA binary", ""]
    return "\n".join(lines)


def _pye57() -> Any:
    try:
        import pye57
    except ImportError as error:
        raise SettingsError("E57 needs the library pye57, which is not installed", remedy="pip install 'spherecal[clouds]', or write PLY.") from error
    return pye57


def _laspy() -> Any:
    try:
        import laspy
        import lazrs  # noqa: F401  laspy finds it by itself
    except ImportError as error:
        what = "LAZ needs the libraries laspy and lazrs, which are not installed"
        raise SettingsError(what, remedy="pip install 'spherecal[clouds]', or write PLY.") from error
    return laspy


def _write_e57(path: Path, pieces: Sequence[FusedCloud], label: CloudLabel) -> None:
    """ASTM E2807: one scan in the base, metres."""
    pye57 = _pye57()
    points = np.concatenate([piece.points_mm for piece in pieces]) * _METRES_PER_MM
    intensity = np.concatenate([piece.uncertainty_mm for piece in pieces]).astype(np.float32)
    data: dict[str, NDArray[np.floating]] = {f"cartesian{axis}": np.ascontiguousarray(points[:, i]) for i, axis in enumerate("XYZ")}
    if np.isfinite(intensity).all():
        data["intensity"] = intensity
    file = pye57.E57(str(path), mode="w")
    file.write_scan_raw(data, name=label.identifier)
    file.close()


def _write_las(path: Path, pieces: Iterable[FusedCloud], label: CloudLabel) -> None:
    """LAS 1.4, point format 6, mm in steps of 0.1 um, the further values as extra dimensions."""
    laspy = _laspy()
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, _LAS_SCALE_MM), np.zeros(3)
    header.system_identifier, header.generating_software = "mm, base frame", "spherecal"
    header.add_extra_dims([laspy.ExtraBytesParams(name=name, type=np.dtype(_RECORD[name]).newbyteorder("=")) for name in (_RECORD.names or ())[3:]])
    header.vlrs.append(laspy.VLR(user_id="spherecal", record_id=1, description=label.identifier[:31], record_data="\n".join(label.comments).encode()))
    with laspy.open(str(path), mode="w", header=header, do_compress=path.suffix.lower() == ".laz") as writer:
        for piece in pieces:
            points = laspy.ScaleAwarePointRecord.zeros(len(piece.count), header=header)
            for name, values in _columns(piece).items():
                points[name] = values
            writer.write_points(points)


def _write_beside(out: Path, write: Callable[[Path], None]) -> None:
    """Write through a temporary file beside the target, then rename it into place."""
    descriptor, name = tempfile.mkstemp(prefix=f".{out.stem}.", suffix=out.suffix, dir=out.parent)
    os.close(descriptor)
    temporary = Path(name)
    try:
        write(temporary)
        with open(temporary, "rb") as stream:
            os.fchmod(stream.fileno(), usual_mode())
            os.fsync(stream.fileno())
        os.replace(temporary, out)
        sync_folder(out.parent)
    except OSError as error:
        raise FileError(f"cannot be written ({error.strerror or error})", file=out, remedy="Check that its folder has room.") from error
    finally:
        with suppress(OSError):
            temporary.unlink()
