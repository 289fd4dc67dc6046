"""Exposures of one pose: fresh frames only, and the mean of several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from drivers.errors import InvalidFrame
from drivers.protocols import Camera3D, Frame3D

# frames of a standing scene differ by noise; a pixel that jumps further saw two surfaces, and its mean is on neither
_SAME_SURFACE_MM = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """The frames taken at one pose so far."""

    frames: tuple[Frame3D, ...] = ()
    retried: bool = False
    """Whether the one repetition is used up."""

    def with_retry(self) -> Self:
        """The same with the repetition used up."""
        return replace(self, retried=True)


def expose(camera: Camera3D, exposure: Exposure, *, after: int, timeout_s: float) -> Exposure:
    """One more frame.

    Args:
        camera: opened.
        exposure: frames so far.
        after: sequence number of the last frame before it.
        timeout_s: for the camera.

    Raises:
        CameraError: as the camera does.
        InvalidFrame: an older frame, of a wrong shape, or without a single point.
    """
    frame = camera.capture(timeout_s=timeout_s)
    if frame.sequence <= after:
        raise InvalidFrame(f"frame {frame.sequence} is not newer than frame {after}", remedy="Use triggered exposures only.")
    if frame.xyz_mm.ndim != 3 or frame.xyz_mm.shape[-1] != 3:
        raise InvalidFrame(f"the frame has the shape {frame.xyz_mm.shape}", remedy="A frame is (height, width, 3).")
    if not np.isfinite(frame.xyz_mm).any():
        raise InvalidFrame("the frame holds no valid point", remedy="Check exposure, distance and the camera's cover.")
    return replace(exposure, frames=(*exposure.frames, frame))


def average(frames: Sequence[Frame3D]) -> NDArray[np.float32]:
    """Mean (height, width, 3) of frames, NaN where any of them has no point or they saw different surfaces.

    Frames of different shapes (unorganised sources) cannot be averaged: then the first is the scan.
    """
    first = frames[0].xyz_mm
    if len(frames) == 1 or any(frame.xyz_mm.shape != first.shape for frame in frames):
        return first
    stack = np.stack([frame.xyz_mm for frame in frames]).astype(np.float64)
    spread = (stack.max(axis=0) - stack.min(axis=0)).max(axis=-1)
    same = spread < _SAME_SURFACE_MM
    return np.where(same[..., None], stack.mean(axis=0), np.nan).astype(np.float32)
