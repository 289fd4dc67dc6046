"""PCD point clouds (PCL's format 0.7): ASCII, binary and binary_compressed, organised by WIDTH and HEIGHT.

A viewpoint other than the origin stays in the comments as `viewpoint tx ty tz qw qx qy qz`: whoever reads camera frames
must refuse it, because points may have been moved by it. Format: pointclouds.org, "The PCD file format".
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.errors import FileError
from drivers.files.ply import AnyArray, PointCloud

_TYPES = {
    **{("F", 4): "<f4", ("F", 8): "<f8", ("I", 1): "i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8"},
    **{("U", 1): "u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8"},
}
_DATA = re.compile(rb"(?:^|\n)DATA[ \t]+(ascii|binary|binary_compressed)[ \t]*\r?\n")
_HEADER_LIMIT = 1 << 16
_EXPORT = "Export the cloud again as binary PCD or PLY with float x y z."
_LARGEST = 1 << 31


@dataclass(frozen=True, slots=True)
class _Header:
    dtype: np.dtype[np.void]
    counts: tuple[int, ...]
    width: int
    height: int
    encoding: str
    size: int
    comments: tuple[str, ...]

    @property
    def n_points(self) -> int:
        return self.width * self.height


def parse_pcd(data: bytes | memoryview, *, file: str | Path) -> PointCloud:
    """The cloud in the bytes of a PCD file; `file` is only named in errors.

    Raises:
        FileError: no PCD, cut off, longer than its header says, without x y z, or of a kind that is not read.
    """
    header = _header(bytes(data[:_HEADER_LIMIT]), file)
    body = memoryview(data)[header.size :]
    if header.encoding == "ascii":
        columns = _text_columns(body, header, file)
    elif header.encoding == "binary":
        columns = _record_columns(_exactly(body, header.n_points * header.dtype.itemsize, file), header)
    else:
        columns = _packed_columns(body, header, file)
    shape = (header.height, header.width) if header.height > 1 else (header.width,)
    xyz = np.stack([columns.pop(axis).astype(np.float32) for axis in "xyz"], axis=-1)
    xyz[~np.isfinite(xyz).all(axis=1)] = np.nan
    others = {name: values.reshape(shape) for name, values in columns.items() if values.ndim == 1 and not name.startswith("_")}
    return PointCloud(xyz.reshape(*shape, 3), others, header.comments)


def _header(start: bytes, file: str | Path) -> _Header:
    end = _DATA.search(start)
    if end is None:
        raise FileError("no PCD file: there is no line `DATA ascii`, `binary` or `binary_compressed`", file=file, remedy=_EXPORT)
    lines = [line.split() for line in start[: end.start()].decode("utf-8", errors="replace").split("\n")]
    entries = {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}
    names = entries.get("FIELDS", [])
    sizes, counts = _whole(entries, "SIZE", len(names), file), _whole(entries, "COUNT", len(names), file, default=1)
    kinds = [_TYPES.get((kind, size)) for kind, size in zip(entries.get("TYPE", []), sizes, strict=False)]
    if not set("xyz") <= set(names) or len(set(names) - {"_"}) + names.count("_") < len(names):
        raise FileError(f"the fields are {' '.join(names) or 'not given'}", file=file, where="FIELDS", remedy=_EXPORT)
    if len(kinds) != len(names) or any(kind is None for kind in kinds):
        raise FileError("TYPE and SIZE do not fit FIELDS", file=file, where="header", remedy=_EXPORT)
    if any(kinds[names.index(axis)] not in {"<f4", "<f8"} or counts[names.index(axis)] != 1 for axis in "xyz"):
        raise FileError("x y z are not single floats", file=file, where="header", remedy=_EXPORT)
    width, height = (_whole(entries, key, 1, file)[0] for key in ("WIDTH", "HEIGHT"))
    if width * height != _whole(entries, "POINTS", 1, file, default=width * height)[0] or width * height > _LARGEST:
        raise FileError(f"WIDTH {width} times HEIGHT {height} is not POINTS", file=file, where="header", remedy=_EXPORT)
    fields = [(_unique(name, i), kind, (count,)) for i, (name, kind, count) in enumerate(zip(names, kinds, counts, strict=True))]
    viewpoint = tuple(entries.get("VIEWPOINT", []))
    comments = (f"viewpoint {' '.join(viewpoint)}",) if viewpoint and not _is_origin(viewpoint) else ()
    return _Header(np.dtype(fields), tuple(counts), width, height, end[1].decode(), end.end(), comments)


def _whole(entries: dict[str, list[str]], key: str, n: int, file: str | Path, default: int | None = None) -> list[int]:
    words = entries.get(key, [] if default is None else [str(default)] * n)
    if len(words) != n or not all(re.fullmatch(r"[0-9]{1,10}", word) for word in words):
        raise FileError(f"{key} is {' '.join(words)[:40] or 'missing'}", file=file, where="header", remedy=_EXPORT)
    return [int(word) for word in words]


def _unique(name: str, place: int) -> str:
    return f"_{place}" if name == "_" else name


def _is_origin(words: tuple[str, ...]) -> bool:
    try:
        return [float(word) for word in words] == [0, 0, 0, 1, 0, 0, 0]
    except ValueError:
        return False


def _exactly(body: memoryview, needed: int, file: str | Path) -> memoryview:
    if len(body) < needed:
        found = f"is cut off: {len(body)} bytes of data where the header promises {needed}"
        raise FileError(found, file=file, remedy="Copy or export the file again.")
    # PCL pads files to whole pages of zeros
    if bytes(body[needed : needed + 4096]).strip(b"\0\n\r") or len(body) > needed + 65536:
        raise FileError(f"has {len(body) - needed} bytes more than its header says", file=file, remedy=_EXPORT)
    return body[:needed]


def _record_columns(body: memoryview, header: _Header) -> dict[str, AnyArray]:
    records = np.frombuffer(body, dtype=header.dtype) if header.n_points else np.zeros(0, header.dtype)
    return {name: _column(records[name]) for name in header.dtype.names or ()}


def _column(values: AnyArray) -> AnyArray:
    values = np.array(values, dtype=values.dtype.newbyteorder("="))
    return values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values


def _packed_columns(body: memoryview, header: _Header, file: str | Path) -> dict[str, AnyArray]:
    from drivers.files.lzf_kernels import decompress

    needed = header.n_points * header.dtype.itemsize
    if len(body) < 8:
        raise FileError("is cut off behind its header", file=file, remedy="Copy or export the file again.")
    n_packed, n_unpacked = struct.unpack("<II", body[:8])
    if n_unpacked != needed:
        raise FileError(f"unpacks to {n_unpacked} bytes where the header promises {needed}", file=file, where="DATA", remedy=_EXPORT)
    packed, out = np.frombuffer(_exactly(body[8:], n_packed, file), dtype=np.uint8), np.zeros(needed, dtype=np.uint8)
    if decompress(packed, out) != needed:
        raise FileError("the packed data are broken", file=file, where="DATA", remedy="Copy or export the file again.")
    columns: dict[str, AnyArray] = {}
    begin = 0
    for name in header.dtype.names or ():
        kind = header.dtype[name]
        end = begin + kind.itemsize * header.n_points
        columns[name] = _column(out[begin:end].view(kind.base).reshape(header.n_points, -1))
        begin = end
    return columns


def _text_columns(body: memoryview, header: _Header, file: str | Path) -> dict[str, AnyArray]:
    lines = [line for line in bytes(body).decode("latin-1").split("\n") if line.strip(" \t\r\0")]
    if len(lines) != header.n_points:
        what = "is cut off" if len(lines) < header.n_points else "is longer than its header says"
        raise FileError(f"{what}: {len(lines)} lines where the header promises {header.n_points} points", file=file, remedy=_EXPORT)
    try:
        table = np.loadtxt(lines, dtype=np.float64, comments=None, ndmin=2) if lines else np.zeros((0, sum(header.counts)))
    except ValueError as error:
        raise FileError(f"a line is broken ({error})", file=file, remedy=_EXPORT) from error
    if table.shape[1] != sum(header.counts):
        raise FileError(f"{table.shape[1]} numbers a line where the header promises {sum(header.counts)}", file=file, remedy=_EXPORT)
    ends = np.cumsum(header.counts)
    return {name: _column(table[:, end - count : end]) for name, end, count in zip(header.dtype.names or (), ends, header.counts, strict=True)}
