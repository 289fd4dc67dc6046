"""What a recording shows, as plain arrays: one step per shot, the spheres, the texts. Knows no viewer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.kinematics.mdh import Capsule

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One shot on the timeline `pose`."""

    label: str
    """For people: "session calib, shot 12, sphere A"."""
    base_from_links: FloatArray
    """(k, 4, 4) link frames of the corrected robot from base to flange; (1, 4, 4), the flange, for pose-only data."""
    base_from_camera: FloatArray
    """(4, 4)."""
    before_in_base_mm: FloatArray
    """(n, 3) points by the nominal robot and the first guess of the hand-eye; (0, 3) where there is none."""
    after_in_base_mm: FloatArray
    """(m, 3) the same points calibrated."""
    curves: Mapping[str, float] = field(default_factory=dict)
    """Values to plot over the poses, mm, by the name of their curve."""


@dataclass(frozen=True, slots=True, eq=False)
class SphereCloud:
    """Points of all shots on one sphere, with what each is wrong by."""

    points_in_base_mm: FloatArray
    """(n, 3)."""
    radial_error_mm: FloatArray
    """(n,) distance from the best common centre minus the radius."""


@dataclass(frozen=True, slots=True, eq=False)
class SphereMark:
    """A sphere where the calibration puts it, and how the shots show it before and after."""

    name: str
    centre_in_base_mm: FloatArray
    radius_mm: float
    before: SphereCloud | None = None
    after: SphereCloud | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SolidMark:
    """Something that stands in the cell."""

    name: str
    vertices_in_base_mm: FloatArray
    """(n, 3)."""
    triangles: NDArray[np.int64]
    """(m, 3) rows of the vertices."""
    views: NDArray[np.int64] | None = None
    """(m,) how many poses see each triangle, to colour it by; None for one colour."""


@dataclass(frozen=True, slots=True, eq=False)
class PathMark:
    """The way of one point of the arm."""

    name: str
    points_in_base_mm: FloatArray
    """(n, 3)."""
    touches: NDArray[np.bool_]
    """(n,) where the arm touches something."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Everything of one recording."""

    title: str
    steps: tuple[Step, ...]
    spheres: tuple[SphereMark, ...] = ()
    texts: Mapping[str, str] = field(default_factory=dict)
    """Markdown documents by title."""
    shape: tuple[Capsule, ...] = ()
    """Bodies of the robot's links, in the frames of `Step.base_from_links`."""
    field_of_view_deg: tuple[float, float] | None = (40.0, 30.0)
    """Full angles across and down; None where the camera has no such view (a line profile)."""
    depth_mm: float = 350.0
    """Where the camera's image plane is drawn."""
    stitched_in_base_mm: FloatArray | None = None
    """(n, 3) the fused cloud of a workpiece."""
    solids: tuple[SolidMark, ...] = ()
    paths: tuple[PathMark, ...] = ()
