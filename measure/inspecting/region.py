"""Which part of the cloud an inspection looks at: a table of a million voxels beside the part need not be waited for."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.inspecting.features import box_of, shape_of
from measure.inspecting.nominal import Nominal
from measure.inspecting.spec import InspectionSpec, ProfileCheck

WIDER = 3.0
"""How much farther than `search_mm` datums are looked for in the first round."""
_MARGIN = 2.0
"""How far the datums may move the part, in widened searches."""


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """What features, and a profile, can take points from."""

    in_part_mm: FloatArray
    """(2, 3) lower and upper corner, without the margin."""
    in_base_mm: FloatArray
    """(2, 3) a box in the base that holds it wherever the datums may move it."""

    def holds(self, part_from_base: FloatArray) -> bool:
        """Whether the box in the base was large enough for the alignment that was found."""
        corners = se3.apply(se3.inverse(part_from_base), _corners(self.in_part_mm))
        return bool((corners >= self.in_base_mm[0]).all() and (corners <= self.in_base_mm[1]).all())


def region_of(spec: InspectionSpec, nominal: Nominal) -> Region | None:
    """The region; None where every point of the cloud may count: a best fit looks for the part everywhere."""
    if spec.alignment.method == "best_fit" or not spec.features:
        return None
    widened = {name: feature.model_copy(update={"search_mm": WIDER * feature.search_mm}) for name, feature in spec.features.items()}
    boxes = [np.stack(box_of(shape_of(feature))) for feature in widened.values()]
    if any(isinstance(check, ProfileCheck) for check in spec.checks):
        boxes.append(nominal.box_mm + spec.deviation_limit_mm * np.array([[-1.0], [1.0]]))
    low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
    base_from_part = np.eye(4) if spec.alignment.base_from_part is None else np.asarray(spec.alignment.base_from_part)
    corners = se3.apply(base_from_part, _corners(np.stack([low, high])))
    margin = 0.0 if spec.alignment.method == "none" else _MARGIN * max(feature.search_mm for feature in widened.values())
    return Region(np.stack([low, high]), np.stack([corners.min(axis=0) - margin - 1e-6, corners.max(axis=0) + margin + 1e-6]))


def _corners(box_mm: FloatArray) -> FloatArray:
    """(8, 3)."""
    return np.array([[box_mm[i, axis] for axis, i in enumerate(which)] for which in itertools.product((0, 1), repeat=3)])
