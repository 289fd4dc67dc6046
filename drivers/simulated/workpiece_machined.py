"""A machined part to inspect: two bores, one of them countersunk, a slot, a step and a boss, 160 x 100 x 70 mm.

Its dimensions can be changed, so that a part can be simulated that is not quite what its drawing says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.kinematics.se3 import FloatArray
from drivers.simulated.workpiece import Faces, at_height, block, circle, cylinder, joined, strip


@dataclass(frozen=True, slots=True)
class MachinedPart:
    """The dimensions; the part's origin is the middle of its bottom face, z up. Defaults are the drawing."""

    base_height_mm: float = 40.0
    bore_radius_mm: float = 10.0
    bore_centre_mm: tuple[float, float] = (-57.5, 0.0)
    sink_radius_mm: float = 15.0
    """Of the countersink, at the top; it ends on the bore."""
    sink_depth_mm: float = 5.0
    large_bore_radius_mm: float = 15.0
    large_bore_centre_mm: tuple[float, float] = (-12.5, 0.0)
    slot_width_mm: float = 12.0
    slot_length_mm: float = 40.0
    """Whole length, along y."""
    slot_centre_mm: tuple[float, float] = (27.5, 0.0)
    step_height_mm: float = 58.0
    boss_radius_mm: float = 11.0
    boss_height_mm: float = 12.0
    boss_centre_mm: tuple[float, float] = (62.5, 0.0)

    def mesh(self, segments: int = 360) -> tuple[FloatArray, Faces]:
        """Vertices (v, 3) and faces (f, 3), outward; closed solids that touch at shared faces.

        Args:
            segments: corners of each circle, a multiple of 8. A circle of radius r is flattened by r pi² / (2 segments²).
        """
        top = self.base_height_mm
        sunk = [(0.0, self.bore_radius_mm), (top - self.sink_depth_mm, self.bore_radius_mm), (top, self.sink_radius_mm)]
        straight = [(0.0, self.large_bore_radius_mm), (top, self.large_bore_radius_mm)]
        rings = [(z, circle(segments) * radius + self.bore_centre_mm) for z, radius in sunk]
        wide = [(z, circle(segments) * radius + self.large_bore_centre_mm) for z, radius in straight]
        slot = [(z, self._slot(segments)) for z in (0.0, top)]
        solids = [_hollow((-80, -35), rings), _hollow((-35, 10), wide), _hollow((10, 45), slot)]
        solids.append(block((45, -50, 0), (80, 50, self.step_height_mm)))
        foot = (*self.boss_centre_mm, self.step_height_mm)
        solids.append(cylinder(foot, self.boss_radius_mm, self.boss_height_mm, segments))
        return joined(solids)

    def _slot(self, segments: int) -> FloatArray:
        """Outline (n, 2): half circles whose ends are joined by straight sides."""
        unit = circle(segments)
        half = (self.slot_length_mm - self.slot_width_mm) / 2
        ends = np.where(unit[:, 1:] > 1e-9, half, np.where(unit[:, 1:] < -1e-9, -half, 0.0))
        return np.asarray(unit * self.slot_width_mm / 2 + np.column_stack([np.zeros(segments), ends[:, 0]]) + self.slot_centre_mm)


def _hollow(x_mm: tuple[float, float], rings: list[tuple[float, FloatArray]]) -> tuple[FloatArray, Faces]:
    """A block from y = -50 to 50 with an opening through it, whose outlines (n, 2) are given from bottom to top."""
    n = len(rings[0][1])
    unit = circle(n)
    # the circle pushed out to the unit square: multiples of 45 degrees become its corners
    outer = unit / np.abs(unit).max(axis=1, keepdims=True) * [(x_mm[1] - x_mm[0]) / 2, 50.0] + [(x_mm[0] + x_mm[1]) / 2, 0.0]
    bottom, top = rings[0][0], rings[-1][0]
    layers = [at_height(outer, bottom), at_height(outer, top), *(at_height(outline, z) for z, outline in reversed(rings))]
    bands = [strip(n, k * n, ((k + 1) % len(layers)) * n) for k in range(len(layers))]
    return np.concatenate(layers), np.concatenate(bands).astype(np.int32)
