"""Units, axes and holes: the one place where a vendor's points become mm, camera-optical frame and NaN.

The camera-optical frame is x right, y down, z out, as seen in the image. `Axes` says how it is made from the source's own
frame: row i of the (3, 3) signed permutation picks what optical axis i is. Left-handed sources are allowed; the optical
frame is right-handed whatever came in.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.errors import SettingsError

FloatImage = NDArray[np.float32]
Axes = NDArray[np.float32]

UNITS_MM = {"mm": 1.0, "m": 1000.0, "um": 0.001, "inch": 25.4}
NAMED_AXES = {
    "optical": ("x", "y", "z"),
    "graphics": ("x", "-y", "-z"),
    "unity": ("x", "-y", "z"),
    "robot": ("-y", "-z", "x"),
}
"""`optical` x right, y down, z out; `graphics` (OpenGL) x right, y up, z back; `unity` x right, y up, z out; `robot` x out, y left, z up."""


def parse_axes(value: str | Sequence[str], *, where: str = "camera.axes") -> Axes:
    """(3, 3) signed permutation `optical_from_source` of a name in NAMED_AXES, or of three signed source axes such as x, -y, -z.

    Raises:
        SettingsError: neither.
    """
    names = NAMED_AXES.get(value, ()) if isinstance(value, str) else tuple(value)
    found = [re.fullmatch(r"([+-]?)([xyz])", name) for name in names]
    if len(found) != 3 or None in found or {match[2] for match in found if match} != {"x", "y", "z"}:
        remedy = f"One of {', '.join(NAMED_AXES)}, or three of the source's axes, each once, e.g. [x, -y, -z]: what is right, down and out."
        raise SettingsError(f"{value!r} names no axes", where=where, remedy=remedy)
    axes = np.zeros((3, 3), dtype=np.float32)
    for row, match in enumerate(found):
        if match is not None:
            axes[row, "xyz".index(match[2])] = -1 if match[1] == "-" else 1
    return axes


def optical_points_mm(points: ArrayLike, *, unit_mm: float, axes: Axes | None = None) -> FloatImage:
    """Points (..., 3) of a source as mm in the camera-optical frame; the result is owned and C-contiguous.

    Whatever is not finite, and the point (0, 0, 0), which is the camera itself, becomes NaN in all three: vendors mark
    their holes by either.

    Args:
        points: in the source's unit and frame; not changed.
        unit_mm: the source's unit, in mm.
        axes: as `parse_axes`; None where the source is optical.
    """
    source = np.asarray(points)
    if source.ndim < 1 or source.shape[-1] != 3:
        msg = f"points must be (..., 3), not {source.shape}"
        raise ValueError(msg)
    with np.errstate(over="ignore", invalid="ignore"):
        xyz_mm = np.array(source, dtype=np.float32, order="C", copy=True)
        holes = _holes(xyz_mm)
        if unit_mm != 1.0:
            xyz_mm = np.multiply(source, unit_mm, dtype=np.float64).astype(np.float32) if source.dtype == np.float64 else xyz_mm * np.float32(unit_mm)
    if axes is not None:
        xyz_mm = turned(xyz_mm, axes)
    xyz_mm[holes] = np.nan
    return xyz_mm


def _holes(xyz: FloatImage) -> NDArray[np.bool_]:
    """Where a point is not finite or zero; axis by axis, because reductions over an axis of three are slow."""
    x, y, z = xyz[..., 0], xyz[..., 1], xyz[..., 2]
    finite = np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
    return np.asarray(~finite | ((x == 0) & (y == 0) & (z == 0)))


def turned(xyz: FloatImage, axes: Axes) -> FloatImage:
    """Points (..., 3) with their axes picked and signed; owned, and exact (no sums)."""
    order, signs = np.abs(axes).argmax(axis=1), axes.sum(axis=1)
    return np.ascontiguousarray(xyz[..., order] * signs)


def as_image(xyz_mm: FloatImage) -> FloatImage:
    """Points (n, 3) as the (1, n, 3) of an unorganised frame; (height, width, 3) as they are."""
    return xyz_mm if xyz_mm.ndim == 3 else xyz_mm[None]


def unit_interval(values: ArrayLike) -> FloatImage:
    """Brightness (height, width) or (height, width, channels) as owned 0..1; whole numbers by their type's range, floats by their greatest."""
    source = np.asarray(values)
    top = float(np.iinfo(source.dtype).max) if source.dtype.kind in "ui" else max(1.0, float(np.nanmax(source, initial=1.0)))
    grey = source[..., :3].mean(axis=-1) if source.ndim == 3 else source
    return np.ascontiguousarray(np.clip(grey / top, 0.0, 1.0), dtype=np.float32)
