"""The simulated 3D camera: rays into the true scene from the true pose, the camera's own errors, then noise.

Not modelled: blur (a frame shows the scene at its trigger, even while the robot moves), intensity, temperature.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CameraNotReached, CameraTimeout
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import CameraInfo, Frame3D
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.optics import measured_points, noisy_points, seen_under_incidence
from drivers.simulated.scene import Hits, RayGrid, nearest_hits, ray_grid
from drivers.simulated.truth import CameraTruth

_EDGE_JUMP_MM = 3.0
# so that a chunk's intermediate arrays stay in the processor's cache
_CHUNK = 32768


class SimulatedCamera:
    """A camera of the `Camera3D` protocol on a simulated cell.

    Args:
        cell: The truth that it sees.
        follow: Called before every exposure, to bring the cell's axes where a robot in another process has its own.
    """

    def __init__(self, cell: SimulatedCell, follow: Callable[[SimulatedCell], None] | None = None) -> None:
        self._cell = cell
        self._follow = follow
        self._opened = False
        self._sequence = 0
        self._grid: RayGrid | None = None

    def open(self) -> CameraInfo:
        """Identity: what a data sheet would say, nothing of the camera's errors."""
        camera = self._cell.truth.camera
        self._opened = True
        public = repr((camera.kind, camera.resolution_px, camera.field_of_view_deg, camera.working_range_mm))
        return CameraInfo(
            adapter="simulated",
            model=f"simulated {camera.resolution_px[0]} x {camera.resolution_px[1]}",
            settings_digest=hashlib.sha256(public.encode()).hexdigest()[:16],
            working_range_mm=camera.working_range_mm,
            kind=camera.kind,
        )

    def capture(self, *, timeout_s: float) -> Frame3D:
        """A frame of the scene as it is now; the exposure then takes its time on the cell's clock.

        Raises:
            CameraNotReached: before `open` or after `close`, or the simulated controller that it follows is gone.
            CameraTimeout: the exposure is longer than `timeout_s`.
            FileError: the workpiece's mesh file cannot be read.
        """
        cell, camera = self._cell, self._cell.truth.camera
        if not self._opened:
            raise CameraNotReached("the simulated camera is not open", remedy="Open it first, e.g. in a `with devices:` block.")
        if camera.exposure_s > timeout_s:
            raise CameraTimeout(f"the exposure takes {camera.exposure_s} s, {timeout_s} s are allowed", remedy="Allow more time.")
        if self._follow is not None:
            self._follow(cell)
        self._sequence += 1
        self._grid = self._grid or ray_grid(camera)
        time_s = cell.clock_s
        hits = nearest_hits(cell.truth, cell.true_base_from_camera(), self._grid, cell.mesh())
        xyz_mm = frame_points(camera, self._grid, hits, cell.frame_rng(self._sequence))
        cell.advance(camera.exposure_s)
        return Frame3D(xyz_mm=xyz_mm, sequence=self._sequence, time_s=time_s)

    def close(self) -> None:
        """Release the camera."""
        self._opened = False


def frame_points(camera: CameraTruth, grid: RayGrid, hits: Hits, rng: np.random.Generator) -> NDArray[np.float32]:
    """Measured points (h, w, 3) of hits, NaN where the camera gives none.

    In this order: incidence drop-out, random loss, flying pixels, systematic error, range noise, working range.
    """
    depth = hits.depth_mm.ravel()
    index = np.flatnonzero(depth < np.inf)
    index = index[seen_under_incidence(camera, hits.cos_incidence.ravel()[index], rng)]
    if camera.invalid_fraction > 0:
        index = index[rng.random(len(index)) >= camera.invalid_fraction]
    z = depth[index] + _flying(camera, hits, index, rng)
    xyz_mm = np.full((depth.size, 3), np.nan, dtype=np.float32)
    for start in range(0, len(index), _CHUNK):
        part = slice(start, start + _CHUNK)
        points = _measured(camera, grid, index[part], z[part], rng)
        xyz_mm[index[part]] = points
    return xyz_mm.reshape(*grid.shape, 3)


def _measured(camera: CameraTruth, grid: RayGrid, index: NDArray[np.int64], z: FloatArray, rng: np.random.Generator) -> FloatArray:
    row, column = np.divmod(index, grid.shape[1])
    true_points = np.column_stack([grid.x_slopes[column] * z, grid.y_slopes[row] * z, z])
    points = noisy_points(camera, measured_points(camera.error, true_points), rng)
    near, far = camera.working_range_mm
    points[(points[:, 2] < near) | (points[:, 2] > far)] = np.nan
    return points


def _flying(camera: CameraTruth, hits: Hits, index: NDArray[np.int64], rng: np.random.Generator) -> FloatArray:
    """Extra depth (k,) of the hits at `index`: some of those at a depth edge are drawn into the gap behind."""
    if camera.flying_pixel_fraction == 0.0:
        return np.zeros(len(index))
    from drivers.simulated.scene_kernels import depth_gaps

    gap = np.empty_like(hits.depth_mm)
    depth_gaps(hits.depth_mm, _EDGE_JUMP_MM, camera.flying_pixel_mm, gap)
    extra = gap.ravel()[index]
    edge = np.flatnonzero(extra)
    flies = rng.random(len(edge)) < camera.flying_pixel_fraction
    extra[edge] *= flies * rng.random(len(edge))
    return extra
