"""Draws what stands in a cell and the ways through it into a Rerun recording; part of `measure.viewer`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from measure.scene import PathMark, Scene, SolidMark

if TYPE_CHECKING:
    import rerun as rr

PATH_COLOUR, TOUCHING_COLOUR, SOLID_COLOUR = (120, 190, 90), (230, 40, 30), (170, 150, 120, 255)
VIEWS_COLOURS = ((200, 60, 50), (235, 180, 60), (150, 200, 90), (60, 150, 130))
"""Of a part: seen by no pose, one, two, three or more."""
_MM = 1e-3


def log_surroundings(stream: rr.RecordingStream, scene: Scene) -> None:
    """Log the solids and paths of a scene, for all times."""
    for i, solid in enumerate(scene.solids):
        _log_solid(stream, f"base/solids/{i}", solid)
    for i, path in enumerate(scene.paths):
        _log_path(stream, f"base/paths/{i}", path)


def _log_solid(stream: rr.RecordingStream, entity: str, solid: SolidMark) -> None:
    import rerun as rr

    # every triangle with corners of its own, so that edges are edges
    corners = (solid.vertices_in_base_mm[solid.triangles] * _MM).astype(np.float32)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit = np.repeat(normals / np.where(length > 0, length, 1), 3, axis=0)
    if solid.views is None:
        mesh = rr.Mesh3D(vertex_positions=corners.reshape(-1, 3), vertex_normals=unit, albedo_factor=SOLID_COLOUR)
    else:
        colours = np.array(VIEWS_COLOURS, dtype=np.uint8)[np.minimum(solid.views, len(VIEWS_COLOURS) - 1)]
        mesh = rr.Mesh3D(vertex_positions=corners.reshape(-1, 3), vertex_normals=unit, vertex_colors=np.repeat(colours, 3, axis=0))
    stream.log(entity, mesh, static=True)
    label = rr.Points3D([corners.reshape(-1, 3).mean(axis=0)], labels=[solid.name], radii=-1.0, colors=SOLID_COLOUR)
    stream.log(f"{entity}/name", label, static=True)


def _log_path(stream: rr.RecordingStream, entity: str, path: PathMark) -> None:
    import rerun as rr

    points = path.points_in_base_mm * _MM
    for side, pieces, colour in zip(("clear", "touching"), pieces_of(path.touches), (PATH_COLOUR, TOUCHING_COLOUR), strict=True):
        if pieces:
            strips = [points[piece].astype(np.float32) for piece in pieces]
            stream.log(
                f"{entity}/{side}",
                rr.LineStrips3D(strips, colors=colour, radii=-1.5, labels=[path.name] * len(strips), show_labels=False),
                static=True,
            )


def pieces_of(touches: NDArray[np.bool_]) -> tuple[list[slice], list[slice]]:
    """Runs of a path (n,) that are clear, and that touch something; neighbouring runs share a point."""
    runs: tuple[list[slice], list[slice]] = ([], [])
    if len(touches) < 2:
        return runs
    # a piece of way touches where either of its ends does
    segments = touches[:-1] | touches[1:]
    starts = np.concatenate([[0], np.flatnonzero(segments[1:] != segments[:-1]) + 1])
    ends = np.concatenate([starts[1:], [len(segments)]])
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        runs[int(segments[start])].append(slice(start, end + 1))
    return runs
