"""How much of the axes' ranges and of the camera's view the shots of a run have used, as a few lines of text."""

from __future__ import annotations

import numpy as np

from acquire.events import Captured
from acquire.sphere import SphereFinding
from acquire.visibility import CameraView
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_STRIP = 14
_CELLS = 3
_DEPTHS = ("near", "middle", "far")


class Coverage:
    """Counts shots; knows the ranges they could have."""

    def __init__(self, model: RobotModel | None, view: CameraView | None) -> None:
        self._limits = None if model is None else model.joint_limits_rad
        self._view = view
        self.joints_rad: list[FloatArray] = []
        self.counts = np.zeros((_CELLS, _CELLS, _CELLS), dtype=np.int64)
        """(depth, down, across) shots with the sphere's centre there."""

    def add(self, event: Captured) -> None:
        """Take a good shot."""
        if event.shot.joints_rad is not None:
            self.joints_rad.append(np.asarray(event.shot.joints_rad))
        if isinstance(event.finding, SphereFinding) and self._view is not None:
            self.counts[cell_of(event.finding.centre_in_camera_mm, self._view)] += 1

    def lines(self) -> list[str]:
        """For the screen; empty before the first shot."""
        return [*self._axes(), *self._in_view()]

    def _axes(self) -> list[str]:
        if not self.joints_rad or self._limits is None:
            return []
        joints = np.array(self.joints_rad)
        strips = [f"{i + 1} {strip(joints[:, i], limits)}" for i, limits in enumerate(self._limits)]
        return [f"{'axes' if i == 0 else '':5}{'  '.join(strips[i : i + 3])}" for i in range(0, len(strips), 3)]

    def _in_view(self) -> list[str]:
        if not self.counts.sum():
            return []
        layers = [f"{name} {'/'.join(''.join(_count(n) for n in row) for row in layer)}" for name, layer in zip(_DEPTHS, self.counts, strict=True)]
        return [f"{'view':5}{'  '.join(layers)}"]


def strip(joints_rad: FloatArray, limits_rad: FloatArray) -> str:
    """Where in its range an axis was: `#` for every stretch with a shot."""
    low, high = limits_rad if np.isfinite(limits_rad).all() else (-np.pi, np.pi)
    place = np.clip(((joints_rad - low) / (high - low) * _STRIP).astype(np.int64), 0, _STRIP - 1)
    return "[" + "".join("#" if i in place else "." for i in range(_STRIP)) + "]"


def cell_of(centre_in_camera_mm: FloatArray, view: CameraView) -> tuple[int, int, int]:
    """Which third in depth, down and across a point (3,) lies in."""
    near, far = view.working_range_mm
    x, y, z = centre_in_camera_mm
    across, down = (value / (z * np.tan(half)) for value, half in zip((x, y), view.half_angle_rad, strict=True))
    shares = ((z - near) / (far - near), (down + 1) / 2, (across + 1) / 2)
    depth, row, column = (int(np.clip(share * _CELLS, 0, _CELLS - 1)) for share in shares)
    return depth, row, column


def _count(n: int) -> str:
    return "." if n == 0 else str(n) if n < 10 else "+"
