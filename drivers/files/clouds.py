"""Clouds of other programs: PLY, PCD and NPZ, told apart by their first bytes and not by their names."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from drivers.errors import FileError
from drivers.files.pcd import parse_pcd
from drivers.files.ply import AnyArray, PointCloud, parse_ply

SUFFIXES = (".ply", ".pcd", ".npz")
POINT_KEYS = ("xyz_mm", "xyz", "points", "point_cloud")


def parse_cloud(data: bytes | memoryview, *, file: str | Path) -> PointCloud:
    """The cloud in the bytes of a file; numbers are as they stand there, whatever their unit.

    Raises:
        FileError: neither PLY, PCD nor NPZ, cut off or broken.
    """
    start = bytes(data[:4])
    if start[:3] == b"ply":
        return parse_ply(data, file=file)
    if start[:2] == b"PK":
        return parse_npz(data, file=file)
    if b"DATA" in bytes(data[: 1 << 16]):
        return parse_pcd(data, file=file)
    what = "is empty" if not start else "is neither PLY nor PCD nor NPZ"
    raise FileError(what, file=file, remedy="Export the cloud as PLY, PCD or NPZ.")


def parse_npz(data: bytes | memoryview, *, file: str | Path) -> PointCloud:
    """The cloud in a NumPy archive: points (n, 3) or (height, width, 3) under one of POINT_KEYS, other arrays of that size beside them.

    Raises:
        FileError: cut off, broken, or without such an array; nothing in it is ever executed.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays: dict[str, AnyArray] = {name: archive[name] for name in archive.files}
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, NotImplementedError, SyntaxError) as error:
        raise FileError(f"is no whole NPZ file ({error})", file=file, remedy="Copy or export the file again.") from error
    name = next((key for key in POINT_KEYS if key in arrays), None)
    points = None if name is None else arrays.pop(name)
    if points is None or points.ndim not in {2, 3} or points.shape[-1] != 3 or points.dtype.kind != "f":
        found = ", ".join(f"{key} {values.shape} {values.dtype}" for key, values in arrays.items()) or "nothing else"
        shown = "" if points is None else f"{name} {points.shape} {points.dtype}, "
        remedy = f"Store floats (n, 3) or (height, width, 3) as one of {', '.join(POINT_KEYS)}."
        raise FileError(f"holds no points: {shown}{found}", file=file, remedy=remedy)
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = np.array(points, dtype=np.float32)
    xyz[~np.isfinite(xyz).all(axis=-1)] = np.nan
    return PointCloud(xyz, {key: values for key, values in arrays.items() if values.shape == xyz.shape[:-1]})
