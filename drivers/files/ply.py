"""PLY point clouds: a header and fixed-size records, read through a memory map.

Read: binary little-endian and ASCII, any scalar properties, float or double; whatever follows the vertices (faces) is
skipped. Written: binary little-endian, float x y z. Organised grids keep their shape by the comments "width W" and
"height H", with NaN for holes. Format: G. Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.errors import FileError
from drivers.files.disk import write_atomic

FloatImage = NDArray[np.float32]
AnyArray = NDArray[np.generic]

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4", "float": "<f4", "double": "<f8"},
    **{"int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4", "float32": "<f4", "float64": "<f8"},
}
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}
_HEADER_LIMIT = 1 << 20
_END = re.compile(rb"(?:^|\n)end_header[ \t]*(\r?\n)")
_EXPORT = "Export the cloud again as binary little-endian PLY with float x y z."


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """A cloud as the camera gave it; arrays are owned and writable."""

    xyz_mm: FloatImage
    """(n, 3), or (height, width, 3) for an organised scan; a hole is NaN in all three."""
    properties: Mapping[str, AnyArray] = field(default_factory=dict)
    """Further values a point, (n,) or (height, width), by their name in the file."""
    comments: tuple[str, ...] = ()

    @property
    def points_mm(self) -> FloatImage:
        """(n, 3) view of the points in file order, holes included."""
        return self.xyz_mm.reshape(-1, 3)


@dataclass(frozen=True, slots=True)
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]]
    has_lists: bool


@dataclass(frozen=True, slots=True)
class _Header:
    text_format: bool
    elements: list[_Element]
    comments: tuple[str, ...]
    size: int


def read_ply(path: str | Path) -> PointCloud:
    """Read a cloud.

    Raises:
        FileError: missing, no PLY, cut off, longer than its header says, without x y z, or of a kind that is not read.
    """
    try:
        data = np.memmap(path, dtype=np.uint8, mode="r") if Path(path).stat().st_size else np.zeros(0, dtype=np.uint8)
    except FileNotFoundError as error:
        raise FileError("no such file", file=path, remedy="Check the path.") from error
    except (OSError, ValueError) as error:
        raise FileError(f"cannot be read ({error})", file=path, remedy="Check the path and its permissions.") from error
    return parse_ply(data.data, file=path)


def parse_ply(data: bytes | memoryview, *, file: str | Path) -> PointCloud:
    """The cloud in the bytes of a PLY file; `file` is only named in errors.

    Raises:
        FileError: as `read_ply`.
    """
    header = _header(bytes(data[:_HEADER_LIMIT]), file)
    vertex = _vertex_element(header, file)
    body = memoryview(data)[header.size :]
    columns = _text_columns(body, header, vertex, file) if header.text_format else _binary_columns(body, header, vertex, file)
    return _cloud(columns, header.comments, vertex.count, file)


def write_ply(path: str | Path, xyz_mm: ArrayLike, *, properties: Mapping[str, ArrayLike] | None = None, comments: Sequence[str] = ()) -> None:
    """Write points (n, 3) or (height, width, 3) as float x y z, in one step (see `write_atomic`).

    Args:
        path: the file; its folder must exist.
        xyz_mm: the points; NaN marks a hole.
        properties: further values a point, each (n,) or (height, width).
        comments: header comments, e.g. "unit mm", "frame camera"; width and height are added for a grid.

    Raises:
        FileError: when the file cannot be written.
    """
    write_atomic(path, encode_ply(xyz_mm, properties=properties, comments=comments))


def encode_ply(xyz_mm: ArrayLike, *, properties: Mapping[str, ArrayLike] | None = None, comments: Sequence[str] = ()) -> bytes:
    """The bytes that `write_ply` writes.

    Raises:
        ValueError: for shapes or types that are a bug of the caller.
    """
    xyz = np.asarray(xyz_mm, dtype=np.float32)
    if xyz.ndim not in {2, 3} or xyz.shape[-1] != 3:
        msg = f"points must be (n, 3) or (height, width, 3), not {xyz.shape}"
        raise ValueError(msg)
    columns = {name: _column(name, values, xyz.shape[:-1]) for name, values in (properties or {}).items()}
    points = xyz.reshape(-1, 3)
    records = np.empty(len(points), dtype=[(axis, "<f4") for axis in "xyz"] + [(name, values.dtype) for name, values in columns.items()])
    for i, axis in enumerate("xyz"):
        records[axis] = points[:, i]
    for name, values in columns.items():
        records[name] = values
    return ply_header(records.dtype, xyz.shape[:-1], comments).encode() + records.tobytes()


def _column(name: str, values: ArrayLike, shape: tuple[int, ...]) -> AnyArray:
    array = np.asarray(values)
    array = array.astype(np.uint8) if array.dtype == np.bool_ else array
    if array.shape != shape or array.dtype.str[1:] not in _NAMES or name in {"x", "y", "z"} or not re.fullmatch(r"[!-~]+", name):
        msg = f"property {name!r} with shape {array.shape} and type {array.dtype} does not fit points {shape}"
        raise ValueError(msg)
    return array.astype(array.dtype.newbyteorder("<"), copy=False).reshape(-1)


def ply_header(dtype: np.dtype[np.void], shape: tuple[int, ...], comments: Sequence[str]) -> str:
    """Header of records (n,) or of a grid (height, width), little-endian scalars x y z first."""
    kept = [text for text in (" ".join(comment.split()) for comment in comments) if not re.fullmatch(r"(width|height) \d+", text)]
    grid = [f"width {shape[1]}", f"height {shape[0]}"] if len(shape) == 2 else []
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in kept + grid)]
    lines += [f"element vertex {int(np.prod(shape))}"]
    lines += [f"property {_NAMES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    return "\n".join([*lines, "end_header", ""])


def _header(start: bytes, file: str | Path) -> _Header:
    if not re.match(rb"ply[ \t]*\r?\n", start):
        raise FileError("does not begin with `ply`", file=file, where="line 1", remedy=f"This is no PLY file. {_EXPORT}")
    end = _END.search(start)
    if end is None:
        raise FileError("the header has no `end_header`: the file is cut off or is no PLY file", file=file, remedy=_EXPORT)
    lines = start[: end.start()].decode("utf-8", errors="replace").split("\n")
    formats: list[str] = []
    elements: list[_Element] = []
    comments: list[str] = []
    for number, line in enumerate(lines[1:], start=2):
        _header_line(line.strip(), formats, elements, comments, file, f"line {number}")
    if formats not in (["binary_little_endian"], ["ascii"]):
        raise FileError(f"the format is {' and '.join(formats) or 'not given'}", file=file, where="header", remedy=_EXPORT)
    return _Header(formats == ["ascii"], elements, tuple(comments), end.end())


def _header_line(line: str, formats: list[str], elements: list[_Element], comments: list[str], file: str | Path, where: str) -> None:
    keyword, *words = line.split() or [""]
    if keyword in {"comment", "obj_info"}:
        comments.append(line[len(keyword) :].strip())
    elif keyword == "format" and len(words) == 2:
        formats.append(words[0])
    elif keyword == "element" and len(words) == 2 and re.fullmatch(r"[0-9]{1,15}", words[1]):
        elements.append(_Element(words[0], int(words[1]), [], has_lists=False))
    elif keyword == "property" and elements and len(words) == 4 and words[0] == "list":
        elements[-1] = _Element(elements[-1].name, elements[-1].count, elements[-1].properties, has_lists=True)
    elif keyword == "property" and elements and len(words) == 2 and words[0] in _TYPES:
        elements[-1].properties.append((words[1], _TYPES[words[0]]))
    else:
        raise FileError(f"the header line {line[:60]!r} is not understood", file=file, where=where, remedy=_EXPORT)


def _vertex_element(header: _Header, file: str | Path) -> _Element:
    vertices = [element for element in header.elements if element.name == "vertex"]
    if len(vertices) != 1:
        raise FileError(f"{len(vertices) or 'no'} `element vertex` in the header", file=file, where="header", remedy=_EXPORT)
    vertex = vertices[0]
    names = [name for name, _ in vertex.properties]
    if missing := [axis for axis in "xyz" if axis not in names]:
        raise FileError(f"the vertices have no {' '.join(missing)}", file=file, where="header", remedy=_EXPORT)
    if any(dict(vertex.properties)[axis][-2] != "f" for axis in "xyz"):
        raise FileError("x y z are whole numbers", file=file, where="header", remedy=_EXPORT)
    if len(set(names)) < len(names):
        raise FileError("a vertex property is given twice", file=file, where="header", remedy=_EXPORT)
    before = header.elements[: header.elements.index(vertex)]
    if vertex.has_lists or any(element.has_lists for element in before):
        raise FileError("list properties stand in or before the vertices", file=file, where="header", remedy=_EXPORT)
    return vertex


def _binary_columns(body: memoryview, header: _Header, vertex: _Element, file: str | Path) -> dict[str, AnyArray]:
    before = header.elements[: header.elements.index(vertex)]
    skipped = sum(element.count * np.dtype(element.properties).itemsize for element in before)
    dtype = np.dtype(vertex.properties)
    needed = skipped + vertex.count * dtype.itemsize
    _check_size(len(body), needed, is_last=header.elements[-1] is vertex, n_points=vertex.count, file=file)
    records = np.frombuffer(body[skipped:needed], dtype=dtype) if vertex.count else np.zeros(0, dtype)
    return {name: np.array(records[name], dtype=records[name].dtype.newbyteorder("=")) for name, _ in vertex.properties}


def _check_size(found: int, needed: int, *, is_last: bool, n_points: int, file: str | Path) -> None:
    if found < needed:
        raise FileError(
            f"is cut off: {found} bytes of data where the header promises {n_points} points in {needed} bytes",
            file=file,
            remedy="Copy or export the file again.",
        )
    if is_last and found > needed:
        raise FileError(f"has {found - needed} bytes more than its header says", file=file, remedy=_EXPORT)


def _text_columns(body: memoryview, header: _Header, vertex: _Element, file: str | Path) -> dict[str, AnyArray]:
    lines = [line for line in bytes(body).decode("latin-1").split("\n") if line.strip()]
    skipped = sum(element.count for element in header.elements[: header.elements.index(vertex)])
    found = len(lines) - skipped
    if found < vertex.count or (header.elements[-1] is vertex and found > vertex.count):
        what = "is cut off" if found < vertex.count else "is longer than its header says"
        raise FileError(f"{what}: {max(found, 0)} lines where the header promises {vertex.count} points", file=file, remedy=_EXPORT)
    table = _text_table(lines[skipped : skipped + vertex.count], len(vertex.properties), file)
    with np.errstate(all="ignore"):
        return {name: table[:, i].astype(np.dtype(kind).newbyteorder("=")) for i, (name, kind) in enumerate(vertex.properties)}


def _text_table(lines: list[str], n_columns: int, file: str | Path) -> NDArray[np.float64]:
    if not lines:
        return np.zeros((0, n_columns))
    try:
        table = np.loadtxt(lines, dtype=np.float64, comments=None, ndmin=2)
    except ValueError as error:
        raise FileError(f"a vertex line is broken ({error})", file=file, remedy=_EXPORT) from error
    if table.shape != (len(lines), n_columns):
        raise FileError(f"{table.shape[1]} numbers a line where the header promises {n_columns}", file=file, remedy=_EXPORT)
    return table


def _cloud(columns: dict[str, AnyArray], comments: tuple[str, ...], count: int, file: str | Path) -> PointCloud:
    shape = _grid_shape(comments, count, file)
    xyz = np.empty((count, 3), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for i, axis in enumerate("xyz"):
            xyz[:, i] = columns.pop(axis)
    xyz[~np.isfinite(xyz).all(axis=1)] = np.nan
    return PointCloud(xyz.reshape(*shape, 3), {name: values.reshape(shape) for name, values in columns.items()}, comments)


def _grid_shape(comments: tuple[str, ...], count: int, file: str | Path) -> tuple[int, ...]:
    sizes = {match[1]: int(match[2]) for comment in comments if (match := re.fullmatch(r"(width|height) ([0-9]{1,9})", comment))}
    if len(sizes) < 2:
        return (count,)
    if sizes["width"] * sizes["height"] != count:
        raise FileError(
            f"{count} points do not fill the grid of {sizes['width']} x {sizes['height']} that its comments name",
            file=file,
            where="header",
            remedy="Correct or remove the comments width and height.",
        )
    return (sizes["height"], sizes["width"])
