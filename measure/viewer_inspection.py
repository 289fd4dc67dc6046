"""Writes an inspection as a Rerun recording: coloured points, nominal places of features, the tolerances as a text."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from measure.inspecting.picture import colour_scale_mm, colours_of
from measure.inspecting.result import Inspection
from measure.viewer_file import recording_file

if TYPE_CHECKING:
    import rerun as rr

_MM = 1e-3
_MOST_POINTS = 600_000
_UI_POINT = -1.5  # negative radii are pixels
_FEATURE_COLOUR = (40, 40, 40)


def write_inspection(path: Path, inspection: Inspection) -> Path:
    """Write the recording beside `path` and rename it into place; lengths in it are metres, frame of the nominal.

    Raises:
        FileError: it cannot be written.
    """
    with recording_file(path, name="spherecal_inspection", layout=_layout()) as stream:
        _log(stream, inspection)
    return path


def _log(stream: rr.RecordingStream, inspection: Inspection) -> None:
    import rerun as rr

    stream.log("part", rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.TransformAxes3D(0.03), static=True)
    stream.log("texts/verdict", rr.TextDocument(_text(inspection), media_type=rr.MediaType.MARKDOWN), static=True)
    deviations = inspection.deviations
    if deviations is not None:
        stride = max(1, len(deviations.signed_mm) // _MOST_POINTS)
        points = (deviations.points_in_part_mm[::stride] * _MM).astype(np.float32)
        colours = colours_of(deviations.signed_mm[::stride], colour_scale_mm(deviations))
        stream.log("part/deviations", rr.Points3D(points, colors=colours, radii=_UI_POINT), static=True)
    for name, places in inspection.feature_points_in_part_mm.items():
        if len(places):
            entity = "".join(c if c.isalnum() else "_" for c in name) or "_"
            middle = places.mean(axis=0) * _MM
            stream.log(f"part/features/{entity}", rr.Points3D([middle], labels=[name], colors=_FEATURE_COLOUR, radii=-3.0), static=True)


def _text(inspection: Inspection) -> str:
    lines = [f"# {inspection.name}: {inspection.verdict.replace('_', ' ')}", "", *(f"* {reason}" for reason in inspection.reasons), ""]
    if inspection.checks:
        lines += ["| what | measured | U | allowed | |", "|---|---|---|---|---|"]
        for c in inspection.checks:
            measured = "-" if c.measured is None else f"{c.measured:.3f} {c.unit}"
            lines.append(f"| {c.name} | {measured} | {c.expanded_uncertainty:.3f} | {c.lower:.3f} to {c.upper:.3f} | {c.verdict} |")
    return "\n".join(lines)


def _layout() -> Any:
    import rerun.blueprint as rrb

    part = rrb.Spatial3DView(origin="part", name="deviations from the nominal")
    text = rrb.TextDocumentView(origin="texts/verdict", name="tolerances")
    return rrb.Blueprint(
        rrb.Horizontal(part, text, column_shares=[2.0, 1.0]),
        rrb.TimePanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )
