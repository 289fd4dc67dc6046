"""Depth images of a pinhole camera as points; pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.points import FloatImage
from drivers.errors import CameraMisconfigured


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Pinhole of a depth image, in its pixels; a pixel's centre is at whole numbers."""

    width: int
    height: int
    focal_x_px: float
    focal_y_px: float
    principal_x_px: float
    principal_y_px: float
    distortion: tuple[float, ...] = ()


def depth_points_mm(depth: NDArray[np.uint16], unit_mm: float, intrinsics: Intrinsics) -> FloatImage:
    """Points (height, width, 3) in mm of a depth image (height, width); a depth of 0 is a hole.

    x = (column - principal_x) z / focal_x, y alike, z = depth * unit: librealsense's rs2_deproject_pixel_to_point without
    distortion.

    Raises:
        CameraMisconfigured: the image is distorted, or of another size than its intrinsics.
    """
    if any(intrinsics.distortion):
        found = f"the depth image is distorted {intrinsics.distortion}"
        raise CameraMisconfigured(found, remedy="Use a rectified depth stream (Z16 of a D400).")
    if depth.shape != (intrinsics.height, intrinsics.width):
        found = f"the depth image is {depth.shape[1]} x {depth.shape[0]}, its intrinsics are for {intrinsics.width} x {intrinsics.height}"
        raise CameraMisconfigured(found, remedy="Open the camera anew.")
    z = np.where(depth == 0, np.nan, depth * unit_mm)
    x = (np.arange(intrinsics.width) - intrinsics.principal_x_px) / intrinsics.focal_x_px * z
    y = ((np.arange(intrinsics.height) - intrinsics.principal_y_px) / intrinsics.focal_y_px)[:, None] * z
    return np.stack([x, y, z], axis=-1).astype(np.float32)
