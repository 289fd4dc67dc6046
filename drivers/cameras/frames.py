"""Whether camera and settings are the right ones: serial number, digest, and what a frame tells (units, axes that look backwards or mirror)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.points import FloatImage
from drivers.errors import CameraMisconfigured

METRES_BELOW_MM = 10.0
_SAMPLES = 20_000
_FEWEST = 50


def settings_digest(applied: Mapping[str, object]) -> str:
    """16 hex digits of everything that was set and that changes where points lie; the order of keys is no matter."""
    return hashlib.sha256(json.dumps(applied, sort_keys=True, default=str).encode()).hexdigest()[:16]


def require_serial(found: str | None, named: str | None) -> None:
    """Nothing, where the camera's serial number is the one that the settings name, or where they name none.

    Raises:
        CameraMisconfigured: another camera.
    """
    if named is not None and found != named:
        what = f"the camera has the serial number {found}, the cell file names {named}"
        raise CameraMisconfigured(what, where="camera.serial", remedy="Connect the right camera, or correct the cell file and calibrate again.")


def frame_problems(xyz_mm: FloatImage) -> list[str]:
    """What is wrong with a frame (height, width, 3) in mm and the optical frame; nothing in view is no fault."""
    rows, columns = np.nonzero(np.isfinite(xyz_mm).all(axis=-1))
    if len(rows) == 0:
        return []
    step = max(1, len(rows) // _SAMPLES)
    rows, columns = rows[::step], columns[::step]
    points = xyz_mm[rows, columns].astype(np.float64)
    middle = float(np.median(points[:, 2]))
    if middle < 0:
        return [f"the points lie behind the camera (median depth {middle:.0f} mm): its z axis looks the other way. Set its axes."]
    if middle < METRES_BELOW_MM:
        return [f"the median depth is {middle:.3f} mm, as if these were metres. Set the camera, or the unit of its files, to mm."]
    return _mirror_problems(points, np.column_stack([columns, rows]).astype(np.float64)) if min(xyz_mm.shape[:2]) > 1 else []


def _mirror_problems(points: NDArray[np.float64], pixels: NDArray[np.float64]) -> list[str]:
    """The image (column, row) and the lines of sight (x/z, y/z) must turn the same way round."""
    ahead = points[:, 2] > METRES_BELOW_MM
    pixels, slopes = pixels[ahead], points[ahead, :2] / points[ahead, 2:]
    if len(pixels) < _FEWEST or min(np.ptp(pixels, axis=0)) < 2:
        return []
    centred = pixels - pixels.mean(axis=0)
    slopes_by_pixels, *_ = np.linalg.lstsq(centred, slopes - slopes.mean(axis=0), rcond=None)
    if np.linalg.det(slopes_by_pixels) >= 0:
        return []
    return ["the image is a mirror image of its points: one axis has the wrong sign, or the grid's rows run the other way. Set its axes."]


def require_plausible(xyz_mm: FloatImage, device: str) -> None:
    """Nothing, for a frame without a fault of settings.

    Raises:
        CameraMisconfigured: metres, points behind the camera, a mirrored image.
    """
    problems = frame_problems(xyz_mm)
    if problems:
        found, _, remedy = problems[0].rpartition(". ")
        raise CameraMisconfigured(f"{device}: {found}", remedy=remedy)
