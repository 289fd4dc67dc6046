"""What stands in the cell, seen along the rays of a camera: nearest hits, so that things hide what lies behind them.

Spheres and boxes are crossed exactly in float64 (a mesh of a sphere would be 0.06 mm too small); only a workpiece mesh
goes through Open3D's RaycastingScene, in float32 (3e-5 mm at half a metre).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.truth import CameraTruth, Truth

if TYPE_CHECKING:
    import open3d


@dataclass(frozen=True, slots=True, eq=False)
class RayGrid:
    """One ray per pixel from the camera's origin: direction (x_slopes[u], y_slopes[v], 1)."""

    x_slopes: FloatArray
    """(w,)"""
    y_slopes: FloatArray
    """(h,); one zero for a line profile."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return len(self.y_slopes), len(self.x_slopes)


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """Nearest hits of a grid of rays."""

    depth_mm: FloatArray
    """(h, w) camera z of the hit, infinite where there is none."""
    cos_incidence: FloatArray
    """(h, w) cosine between ray and surface normal."""


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A triangle mesh in its own frame, ready to be hit by rays."""

    vertices_in_part_mm: FloatArray
    """(v, 3)"""
    raycasting: open3d.t.geometry.RaycastingScene


def ray_grid(camera: CameraTruth) -> RayGrid:
    """The rays of a pinhole camera through the middle of its pixels, symmetric about its axis."""
    width, height = camera.resolution_px
    y_slopes = np.zeros(1) if camera.kind == "line_profile" else _slopes(height, camera.field_of_view_deg[1])
    return RayGrid(_slopes(width, camera.field_of_view_deg[0]), y_slopes)


def mesh_of(vertices_in_part_mm: FloatArray, faces: NDArray[np.int32]) -> Mesh:
    """A mesh of vertices (v, 3) and faces (f, 3) for `nearest_hits`; imports Open3D."""
    import open3d

    raycasting = open3d.t.geometry.RaycastingScene()
    vertices = open3d.core.Tensor.from_numpy(np.ascontiguousarray(vertices_in_part_mm, dtype=np.float32))
    raycasting.add_triangles(vertices, open3d.core.Tensor.from_numpy(np.ascontiguousarray(faces, dtype=np.uint32)))
    return Mesh(vertices_in_part_mm, raycasting)


def nearest_hits(truth: Truth, base_from_camera: FloatArray, grid: RayGrid, mesh: Mesh | None = None) -> Hits:
    """What each ray meets first, for a camera at `base_from_camera` (4, 4)."""
    from drivers.simulated.scene_kernels import cast_rays

    camera_from_base = se3.inverse(base_from_camera)
    depth, cos_incidence = np.full(grid.shape, np.inf), np.zeros(grid.shape)
    if mesh is not None and truth.workpiece is not None:
        part_from_camera = se3.inverse(truth.workpiece.base_from_part) @ base_from_camera
        _hit_mesh(mesh, part_from_camera, grid, depth, cos_incidence)
    centres = np.array([sphere.centre_in_base_mm for sphere in truth.spheres.values()]).reshape(-1, 3)
    radii = np.array([sphere.seen_radius_mm for sphere in truth.spheres.values()])
    half_sizes = np.array([box.size_mm for box in truth.boxes]).reshape(-1, 3) / 2
    base_from_box = np.array([box.base_from_box for box in truth.boxes]).reshape(-1, 4, 4)
    camera_from_box = camera_from_base @ base_from_box
    bounds = np.column_stack([camera_from_box[:, :3, 3], np.linalg.norm(half_sizes, axis=1)])
    box_from_camera = np.ascontiguousarray(se3.inverse(camera_from_box))
    centres = se3.apply(camera_from_base, centres)
    cast_rays(grid.x_slopes, grid.y_slopes, centres, radii, box_from_camera, half_sizes, bounds, depth, cos_incidence)
    return Hits(depth, cos_incidence)


def _slopes(n_pixels: int, angle_deg: float) -> FloatArray:
    half = np.tan(np.radians(angle_deg) / 2)
    return np.asarray((np.arange(n_pixels) + 0.5) * (2 * half / n_pixels) - half)


def _hit_mesh(mesh: Mesh, part_from_camera: FloatArray, grid: RayGrid, depth: FloatArray, cos_incidence: FloatArray) -> None:
    import open3d

    rows, columns = _window(mesh, part_from_camera, grid)
    if rows.stop <= rows.start or columns.stop <= columns.start:
        return
    directions = np.ones((rows.stop - rows.start, columns.stop - columns.start, 3))
    directions[..., 0] = grid.x_slopes[None, columns]
    directions[..., 1] = grid.y_slopes[rows, None]
    directions = directions @ part_from_camera[:3, :3].T
    rays = np.concatenate([np.broadcast_to(part_from_camera[:3, 3], directions.shape), directions], axis=-1).astype(np.float32)
    answer = mesh.raycasting.cast_rays(open3d.core.Tensor.from_numpy(rays))
    normals = answer["primitive_normals"].numpy()
    depth[rows, columns] = answer["t_hit"].numpy()
    facing = np.abs(np.sum(normals * directions, axis=-1))
    cos_incidence[rows, columns] = facing / np.linalg.norm(directions, axis=-1)


def _window(mesh: Mesh, part_from_camera: FloatArray, grid: RayGrid) -> tuple[slice, slice]:
    """Rows and columns that can see the mesh: all, where a part of it lies beside or behind the camera."""
    points = se3.apply(se3.inverse(part_from_camera), mesh.vertices_in_part_mm)
    if points[:, 2].min() <= 1.0:
        return slice(0, grid.shape[0]), slice(0, grid.shape[1])
    tangents = points[:, :2] / points[:, 2:]
    return _covering(grid.y_slopes, tangents[:, 1]), _covering(grid.x_slopes, tangents[:, 0])


def _covering(slopes: FloatArray, tangents: FloatArray) -> slice:
    first, last = np.searchsorted(slopes, [tangents.min() - 1e-6, tangents.max() + 1e-6])
    return slice(int(first), int(last))
