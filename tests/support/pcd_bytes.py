"""PCD files as PCL writes them."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray


def encode_pcd(points: NDArray[np.float32], encoding: str, *, viewpoint: str = "0 0 0 1 0 0 0", extra: NDArray[np.uint32] | None = None) -> bytes:
    """A cloud (n, 3) or (height, width, 3), with one more field `rgb` if given; `encoding` as behind DATA."""
    height, width = points.shape[:2] if points.ndim == 3 else (1, len(points))
    fields, types, sizes = ("x y z rgb", "F F F U", "4 4 4 4") if extra is not None else ("x y z", "F F F", "4 4 4")
    head = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {' '.join('1' for _ in fields.split())}\n"
    head += f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT {viewpoint}\nPOINTS {width * height}\nDATA {encoding}\n"
    flat = points.reshape(-1, 3).astype("<f4")
    columns = [flat[:, i] for i in range(3)] + ([] if extra is None else [extra.ravel().astype("<u4")])
    if encoding == "ascii":
        rows = zip(*(column.tolist() for column in columns), strict=True)
        return (head + "".join(" ".join(repr(value) for value in row) + "\n" for row in rows)).encode()
    if encoding == "binary":
        return head.encode() + np.rec.fromarrays(columns).tobytes()
    body = b"".join(column.tobytes() for column in columns)
    packed = lzf_literals(body)
    return head.encode() + struct.pack("<II", len(packed), len(body)) + packed


def lzf_literals(data: bytes) -> bytes:
    """LZF that copies nothing: runs of at most 32 literals."""
    runs = [data[i : i + 32] for i in range(0, len(data), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)
