"""One pure decoder for whatever a GenICam camera sends: points of one frame from its parts and its Scan3d description.

Read: Coord3D ABC as one interleaved or planar part, or A, B and C as parts of their own; Coord3D C alone with a pinhole
description; each as 8 or 16 bit whole numbers or 32 bit floats. Parts are told apart by their pixel formats, because
transports do not agree on names or order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.genicam.pfnc import FORMATS, PixelFormat
from drivers.cameras.genicam.scan3d import AXES, Coordinate, Pinhole, Scan3d
from drivers.cameras.points import Axes, FloatImage, optical_points_mm
from drivers.errors import CameraMisconfigured, IncompleteFrame

Raw = NDArray[np.generic]


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """One image of a frame, its bytes still those of the transport's buffer."""

    pixel_format: str
    width: int
    height: int
    data: NDArray[np.uint8]
    """Flat."""
    row_padding: int = 0
    """Bytes behind every row."""


@dataclass(frozen=True, slots=True, eq=False)
class Decoded:
    """What a frame holds; every array is owned."""

    xyz_mm: FloatImage
    intensity: FloatImage | None
    confidence: FloatImage | None


def decode(parts: Sequence[Part], scan3d: Scan3d, axes: Axes | None = None) -> Decoded:
    """Points (height, width, 3) in mm and the optical frame, and the brightness and confidence that came along at that size.

    Args:
        parts: of one frame.
        scan3d: without problems (`drivers.cameras.genicam.scan3d.problems`).
        axes: as `drivers.cameras.points.parse_axes`, for cameras whose own frame is not optical.

    Raises:
        CameraMisconfigured: there are no coordinates among the parts, or in a format that is not read.
        IncompleteFrame: a part has fewer bytes than its size needs, or A, B and C are of different sizes.
    """
    images = {part.pixel_format: part_image(part) for part in parts if part.pixel_format in FORMATS}
    raw = _coordinates(images)
    if raw is None:
        sent = ", ".join(part.pixel_format for part in parts) or "nothing"
        raise CameraMisconfigured(f"the camera sends {sent}, and no coordinates that are read", remedy="Set PixelFormat to Coord3D_ABC32f.")
    xyz = _points(raw, scan3d)
    if scan3d.output_mode.endswith("_PointCloud"):
        xyz = xyz.reshape(1, -1, 3)
    xyz_mm = optical_points_mm(xyz, unit_mm=scan3d.unit_mm, axes=axes)
    fitting = {name: image for name, image in images.items() if image.shape[:2] == xyz_mm.shape[:2]}
    return Decoded(xyz_mm, _brightness(fitting), _confidence(fitting))


def part_image(part: Part) -> Raw:
    """A view (height, width) or (height, width, channels) into the bytes of a part.

    Raises:
        IncompleteFrame: there are too few.
    """
    pixel_format = FORMATS[part.pixel_format]
    n_planes = pixel_format.channels if pixel_format.planar else 1
    row = part.width * pixel_format.n_bytes_per_pixel // n_planes
    n_rows = part.height * n_planes
    needed = n_rows * (row + part.row_padding)
    if part.data.size < needed - part.row_padding or needed == 0:
        found = f"a part of {part.width} x {part.height} {part.pixel_format} holds {part.data.size} of {needed} bytes"
        raise IncompleteFrame(found, remedy="Capture again; check cable, switch and packet size.")
    if part.row_padding:
        padded = np.zeros(needed, dtype=np.uint8)
        padded[: min(needed, part.data.size)] = part.data[:needed]
        data = np.ascontiguousarray(padded.reshape(n_rows, -1)[:, :row])
    else:
        data = part.data[:needed].reshape(n_rows, row)
    return _shaped(data, pixel_format, part.height, part.width)


def _shaped(data: NDArray[np.uint8], pixel_format: PixelFormat, height: int, width: int) -> Raw:
    values = data.reshape(-1).view(pixel_format.dtype)
    if pixel_format.planar:
        return np.moveaxis(values.reshape(pixel_format.channels, height, width), 0, -1)
    return values.reshape(height, width) if pixel_format.channels == 1 else values.reshape(height, width, pixel_format.channels)


def _coordinates(images: dict[str, Raw]) -> dict[str, Raw] | None:
    """The raw image of each axis that was sent."""
    whole = next((image for name, image in images.items() if name.startswith("Coord3D_ABC")), None)
    if whole is not None:
        return {axis: whole[..., i] for i, axis in enumerate(AXES)}
    single = {name[8]: image for name, image in images.items() if name.startswith("Coord3D_")}
    if set(single) not in ({"A", "B", "C"}, {"C"}):
        return None
    if len({image.shape for image in single.values()}) > 1:
        sizes = ", ".join(f"{axis} {image.shape}" for axis, image in single.items())
        raise IncompleteFrame(f"the axes have different sizes: {sizes}", remedy="Capture again; enable the component Range alone.")
    return single


def _points(raw: dict[str, Raw], scan3d: Scan3d) -> NDArray[np.floating]:
    described = {"A": scan3d.a, "B": scan3d.b, "C": scan3d.c}
    if set(raw) == {"C"}:
        if scan3d.pinhole is None:
            remedy = "Set PixelFormat to Coord3D_ABC32f and Scan3dOutputMode to CalibratedABC_Grid."
            raise CameraMisconfigured("the camera sends depths alone and tells no lines of sight", remedy=remedy)
        return _sight_points(_valued(raw["C"], described["C"]), scan3d.pinhole)
    return np.stack([_valued(raw[axis], described[axis]) for axis in AXES], axis=-1)


def _valued(raw: Raw, coordinate: Coordinate) -> NDArray[np.floating]:
    """Coordinates of one axis, NaN where the sent value marks a hole. Floats stay floats; whole numbers become doubles."""
    plain = coordinate.scale == 1.0 and coordinate.offset == 0.0
    values: NDArray[np.floating] = raw.astype(np.float32 if plain and raw.dtype.kind == "f" else np.float64)
    if not plain:
        values = values * coordinate.scale + coordinate.offset
    if coordinate.invalid is not None:
        values[raw == np.asarray(coordinate.invalid).astype(raw.dtype if raw.dtype.kind == "f" else np.float64)] = np.nan
    return values


def _sight_points(depth: NDArray[np.floating], pinhole: Pinhole) -> NDArray[np.floating]:
    """Points of a depth map; a depth of exactly zero is a hole."""
    height, width = depth.shape
    z = np.where(depth == 0, np.nan, depth).astype(np.float64)
    x = (np.arange(width) - pinhole.principal_u_px) / pinhole.focal_px * z
    y = ((np.arange(height) - pinhole.principal_v_px) / (pinhole.focal_px * pinhole.aspect))[:, None] * z
    return np.stack([x, y, z], axis=-1)


def _brightness(images: dict[str, Raw]) -> FloatImage | None:
    found = next(((FORMATS[name], image) for name, image in images.items() if name.startswith(("Mono", "RGB", "BGR"))), None)
    if found is None:
        return None
    pixel_format, image = found
    grey = image[..., :3].astype(np.float32).mean(axis=-1) if image.ndim == 3 else image.astype(np.float32)
    return np.ascontiguousarray(np.clip(grey / np.float32(2**pixel_format.bits - 1), 0, 1))


def _confidence(images: dict[str, Raw]) -> FloatImage | None:
    found = next((image for name, image in images.items() if name.startswith("Confidence")), None)
    return None if found is None else np.array(found, dtype=np.float32)
