"""Draws how far two calibrations differ over the work volume: an arrow for each place, as a Rerun recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from measure.viewer_file import recording_file

if TYPE_CHECKING:
    from measure.history.displacement import DisplacementField

_MM = 1e-3
_LONGEST_OF_BOX = 0.08
"""Length of the longest arrow against the box, whatever the field's size: arrows of 0.05 mm would not be seen."""
_SURE, _UNSURE = (226, 114, 43), (150, 158, 172)


def write_difference(path: Path, field: DisplacementField) -> float:
    """Write a recording; returns by how much the arrows are lengthened.

    Raises:
        FileError: the folder is missing or not writable.
    """
    import rerun as rr

    longest = max(float(field.size_mm.max()), 1e-6)
    factor = _LONGEST_OF_BOX * float(np.ptp(field.box_in_base_mm, axis=0).max()) / longest
    sure = field.size_mm > field.expanded_uncertainty_mm
    with recording_file(path) as stream:
        stream.log("base", rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.TransformAxes3D(0.15), static=True)
        middle, half = field.box_in_base_mm.mean(axis=0), np.ptp(field.box_in_base_mm, axis=0) / 2
        stream.log("base/region", rr.Boxes3D(centers=[middle * _MM], half_sizes=[half * _MM], labels=[field.region]), static=True)
        for name, vectors in (("displacement", field.displacement_mm), ("without the rigid part", field.rest_mm)):
            arrows = rr.Arrows3D(
                origins=(field.points_in_base_mm * _MM).astype(np.float32),
                vectors=(vectors * factor * _MM).astype(np.float32),
                colors=np.where(sure[:, None], _SURE, _UNSURE).astype(np.uint8),
                labels=[f"{size:.3f} mm" for size in np.linalg.norm(vectors, axis=1)],
                show_labels=False,
            )
            stream.log(f"base/{name.replace(' ', '_')}", arrows, static=True)
        text = f"Arrows are {factor:.0f} times as long as the displacement; orange ones are larger than their U (k = 2), grey ones are not."
        stream.log("text", rr.TextDocument(f"{field.first[:12]} to {field.second[:12]}\n\n{text}"), static=True)
    return factor
