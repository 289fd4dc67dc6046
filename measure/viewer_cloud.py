"""A fused cloud as a Rerun recording: points coloured by their uncertainty and by their spread."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import FileError
from measure.viewer_file import recording_file

if TYPE_CHECKING:
    from measure.fuse import FusedCloud

_METRES_PER_MM = 1e-3
_MOST_POINTS = 2_000_000
_RADIUS_UI = -1.5
"""Negative: on the screen, not in the scene."""
_GREY = (150, 150, 150)
_MEANINGS = {"uncertainty": "uncertainty (k = 1) along the normal", "spread": "spread of a voxel's points, its own extent included"}


def write_cloud_recording(path: str | Path, cloud: FusedCloud, *, title: str) -> Path:
    """Write a recording of a cloud beside `path` and rename it into place; returns the path.

    Raises:
        FileError: the folder is missing or not writable.
    """
    import rerun as rr

    target = Path(path)
    if not target.parent.is_dir():
        raise FileError("no such folder", file=target.parent, remedy="Make it first.")
    shown = slice(None, None, max(1, -(-len(cloud.count) // _MOST_POINTS)))
    points = (cloud.points_mm[shown] * _METRES_PER_MM).astype(np.float32)
    shades = {name: values for name, values in (("uncertainty", cloud.uncertainty_mm), ("spread", cloud.spread_mm)) if np.isfinite(values).any()}
    lines = [f"**{title}**", "", f"{len(cloud.count)} points, voxels of {cloud.voxel_mm:g} mm, robot base, drawn in metres", ""]
    with recording_file(target, name="spherecal_cloud", layout=_layout(tuple(shades) or ("points",))) as stream:
        stream.log("base", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, values in shades.items():
            low, high = (float(limit) for limit in np.nanpercentile(values, [2, 98]))
            stream.log(f"base/{name}", rr.Points3D(points, colors=_colours(values[shown], low, high), radii=_RADIUS_UI), static=True)
            lines.append(f"* {_MEANINGS[name]}: blue {low:.4f} mm to yellow {high:.4f} mm")
        if not shades:
            stream.log("base/points", rr.Points3D(points, colors=_GREY, radii=_RADIUS_UI), static=True)
        stream.log("legend", rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN), static=True)
    return target


def _layout(names: tuple[str, ...]) -> Any:
    """A view for each way of colouring, side by side, and the legend under them."""
    import rerun.blueprint as rrb

    views = [rrb.Spatial3DView(origin="base", contents=[f"/base/{name}"], name=name) for name in names]
    legend = rrb.TextDocumentView(origin="legend", name="legend")
    return rrb.Blueprint(
        rrb.Vertical(rrb.Horizontal(*views), legend, row_shares=[4.0, 1.0]),
        rrb.TimePanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )


def _colours(values: NDArray[np.float32], low: float, high: float) -> NDArray[np.uint8]:
    """From blue to yellow, both of which people who see no red or no green tell apart."""
    share = np.nan_to_num(np.clip((values - low) / max(high - low, 1e-9), 0, 1))[:, None]
    return np.asarray((1 - share) * np.array([30.0, 60.0, 160.0]) + share * np.array([250.0, 220.0, 60.0]), dtype=np.uint8)
