"""The camera's correction as a field: what of it the shots determine, how well, and where nobody looked.

A constant or a turn of the whole field cannot be told from the hand-eye transform, and single coefficients from each
other (METHOD.md 3). So the field is shown with its best-fit rigid motion over the seen volume taken out, in value and
in covariance alike: that part does not change when the hand-eye takes something over.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrate.camera_error import CameraError, correction_in_camera_mm
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

SHAPE = (10, 10, 8)
"""Cells across, down and in depth."""
_ANGLE_SCALE_MM = 300.0
_SEEN, _UNSEEN = "#", "."


@dataclass(frozen=True, slots=True, eq=False)
class SeenCells:
    """Which cells of the seen box of the camera frame held measured points."""

    box_mm: FloatArray
    """(2, 3) lower and upper corner."""
    seen: NDArray[np.bool_]
    """(nx, ny, nz)."""

    def holds(self, points_in_camera_mm: FloatArray) -> NDArray[np.bool_]:
        """(n,) whether points (n, 3) lie in a seen cell."""
        inside = ((points_in_camera_mm >= self.box_mm[0]) & (points_in_camera_mm <= self.box_mm[1])).all(axis=-1)
        return np.asarray(inside & self.seen[tuple(_indices(self.box_mm, self.seen.shape, points_in_camera_mm).T)])

    @property
    def centres_mm(self) -> FloatArray:
        """(k, 3) middles of the seen cells."""
        step = (self.box_mm[1] - self.box_mm[0]) / self.seen.shape
        return np.asarray(self.box_mm[0] + (np.argwhere(self.seen) + 0.5) * step)

    def to_data(self) -> list[str]:
        """For a file, to be looked at: one text per depth, from near to far; rows of x, one after the other in y."""
        return [" ".join("".join(_SEEN if cell else _UNSEEN for cell in row) for row in layer.T) for layer in np.moveaxis(self.seen, 2, 0)]


@dataclass(frozen=True, slots=True, eq=False)
class CameraField:
    """The correction at n points, its rigid part over the seen volume taken out."""

    correction_mm: FloatArray
    """(n, 3) to be added to a measured point."""
    covariance_mm2: FloatArray
    """(n, 3, 3)."""
    seen: NDArray[np.bool_]
    """(n,) whether a shot measured near the point: elsewhere the field is only continued."""

    @property
    def expanded_uncertainty_mm(self) -> FloatArray:
        """(n, 3), k = 2, of each component."""
        return np.asarray(2.0 * np.sqrt(np.maximum(np.diagonal(self.covariance_mm2, axis1=1, axis2=2), 0.0)))


def seen_cells(points_in_camera_mm: FloatArray, shape: tuple[int, int, int] = SHAPE) -> SeenCells:
    """Cells of the box around points (n, 3) that hold any of them."""
    box = np.array([points_in_camera_mm.min(axis=0), points_in_camera_mm.max(axis=0)])
    seen = np.zeros(shape, dtype=np.bool_)
    seen[tuple(_indices(box, shape, points_in_camera_mm).T)] = True
    return SeenCells(box, seen)


def seen_cells_from_data(rows: object, box_mm: FloatArray) -> SeenCells:
    """What `SeenCells.to_data` wrote; ValueError for anything else."""
    layers = [str(layer).split() for layer in rows] if isinstance(rows, list | tuple) else []
    sizes = {(len(layer), len(row)) for layer in layers for row in layer}
    if len(sizes) != 1 or {cell for layer in layers for row in layer for cell in row} - {_SEEN, _UNSEEN}:
        raise ValueError("seen_cells is no list of texts of # and . of one size")
    cells = np.array([[[cell == _SEEN for cell in row] for row in layer] for layer in layers], dtype=np.bool_)
    return SeenCells(box_mm, np.moveaxis(cells, 0, 2).swapaxes(0, 1))


def camera_field(
    camera_error: CameraError, coefficients_mm: FloatArray, covariance_mm2: FloatArray, cells: SeenCells, points_in_camera_mm: FloatArray
) -> CameraField:
    """The field of a camera error model with coefficients (k,) of covariance (k, k), at points (n, 3).

    The correction is linear in the coefficients c: `f(x) = B(x) c`. Its rigid part is `R(x) inv(R_v' R_v) R_v' B_v c`, R the
    six small motions and v the seen cells, so that value and covariance both come from `B(x) - R(x) inv(R_v' R_v) R_v' B_v`.
    """
    over = cells.centres_mm
    rigid = np.linalg.lstsq(_rigid(over).reshape(-1, 6), _columns(camera_error, over).reshape(3 * len(over), -1), rcond=None)[0]
    columns = _columns(camera_error, points_in_camera_mm) - _rigid(points_in_camera_mm) @ rigid
    return CameraField(columns @ coefficients_mm, columns @ covariance_mm2 @ np.swapaxes(columns, -1, -2), cells.holds(points_in_camera_mm))


def correction_mm(camera_error: CameraError, coefficients_mm: FloatArray, points_in_camera_mm: FloatArray) -> FloatArray:
    """(n, 3) correction as it is applied, rigid part and all; NaN rows stay NaN."""
    if not len(coefficients_mm):
        return points_in_camera_mm * 0.0
    return correction_in_camera_mm(camera_error, coefficients_mm, points_in_camera_mm)


def _columns(camera_error: CameraError, points_mm: FloatArray) -> FloatArray:
    """(n, 3, k) motion of points (n, 3) per coefficient."""
    axis = camera_error.axis
    columns = np.zeros((len(points_mm), 3, len(axis)))
    columns[:, axis, np.arange(len(axis))] = camera_error.basis(points_mm)
    return columns


def _rigid(points_mm: FloatArray) -> FloatArray:
    """(n, 3, 6) small motions of points (n, 3)."""
    return np.concatenate([np.broadcast_to(np.eye(3), (len(points_mm), 3, 3)), -se3.hat(points_mm) / _ANGLE_SCALE_MM], axis=-1)


def _indices(box_mm: FloatArray, shape: tuple[int, ...], points_mm: FloatArray) -> NDArray[np.int64]:
    """(n, 3) cell of each point, those outside the box in its outermost cells."""
    relative = (points_mm - box_mm[0]) / np.maximum(box_mm[1] - box_mm[0], 1e-9)
    return np.asarray(np.clip((np.nan_to_num(relative) * shape).astype(np.int64), 0, np.array(shape) - 1))


def seen_cells_data(cells: SeenCells | None) -> dict[str, object]:
    """The keys that a file holds of them; none where nothing is known."""
    return {} if cells is None else {"seen_cells": cells.to_data()}
