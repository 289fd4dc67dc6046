"""Exported clouds of any vendor as points of a frame: grid, unit, axes, and what else stands beside the points."""

from __future__ import annotations

import re

import numpy as np

from drivers.cameras.points import Axes, FloatImage, as_image, optical_points_mm, unit_interval
from drivers.errors import CameraMisconfigured
from drivers.files.ply import AnyArray, PointCloud

_BRIGHTNESS = ("intensity", "scalar_intensity", "scalar_Intensity", "gray", "grey")
_COLOURS = ("red", "green", "blue")
_GRID = re.compile(r"(num_cols|num_rows)[ \t]+([0-9]{1,9})")


def frame_points(cloud: PointCloud, *, unit_mm: float, axes: Axes, grid: tuple[int, int] | None) -> FloatImage:
    """Points (height, width, 3) in mm and the optical frame, (1, n, 3) for a cloud without a grid.

    Args:
        cloud: as it stood in the file, in its own unit and frame.
        unit_mm: that unit in mm.
        axes: as `drivers.cameras.points.parse_axes`.
        grid: (width, height), where the file does not tell them.

    Raises:
        CameraMisconfigured: the points do not fill the grid, or a PCD file carries a viewpoint.
    """
    moved = next((comment for comment in cloud.comments if comment.startswith("viewpoint ")), None)
    if moved is not None:
        remedy = "Switch off the transform of the camera's software: points must be in the camera's own frame."
        raise CameraMisconfigured(f"the scan carries a {moved}, so its points may have been moved", remedy=remedy)
    points = optical_points_mm(cloud.xyz_mm, unit_mm=unit_mm, axes=axes)
    shape = grid_of(cloud, grid)
    return as_image(points) if shape is None else points.reshape(*shape, 3)


def grid_of(cloud: PointCloud, grid: tuple[int, int] | None) -> tuple[int, int] | None:
    """(height, width) of a cloud, None where it has no grid; `grid` is (width, height).

    Raises:
        CameraMisconfigured: the points do not fill the grid that is named.
    """
    n_points = cloud.points_mm.shape[0]
    if cloud.xyz_mm.ndim == 3:
        grid = grid or (cloud.xyz_mm.shape[1], cloud.xyz_mm.shape[0])
    elif grid is None:
        sizes = {match[1]: int(match[2]) for comment in cloud.comments if (match := _GRID.fullmatch(comment.strip()))}
        grid = (sizes["num_cols"], sizes["num_rows"]) if len(sizes) == 2 and sizes["num_cols"] * sizes["num_rows"] == n_points else None
    if grid is None:
        return None
    if grid[0] * grid[1] != n_points or (cloud.xyz_mm.ndim == 3 and cloud.xyz_mm.shape[:2] != grid[::-1]):
        remedy = "Export organised clouds, invalid points included, or leave `grid` out."
        raise CameraMisconfigured(f"{n_points} points do not fill a grid of {grid[0]} x {grid[1]}", where="camera.grid", remedy=remedy)
    return grid[::-1]


def brightness(cloud: PointCloud, shape: tuple[int, ...]) -> FloatImage | None:
    """Intensity or mean colour (height, width) in 0..1 of a cloud, None where it has neither."""
    found = next((cloud.properties[name] for name in _BRIGHTNESS if name in cloud.properties), None)
    if found is None and set(_COLOURS) <= set(cloud.properties):
        colours: list[AnyArray] = [cloud.properties[name] for name in _COLOURS]
        found = np.mean([unit_interval(colour) for colour in colours], axis=0)
    return None if found is None else unit_interval(found).reshape(shape)
