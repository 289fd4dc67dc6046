"""How much of its circumference a round feature was seen over, and which points only stray there.

Radius and centre of a short arc move together: an error of the cloud of e across an arc of 90 degrees is some 10 e in the
radius. How far round the points reach therefore belongs to every round figure. A few points round the back, which noise at
an edge or a neighbouring surface put there, look like a whole circle and hold the radius with all their leverage; a sector
counts as seen only where its points are not much fewer than those of the sectors that are seen well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.kinematics.se3 import FloatArray
from measure.inspecting.shapes import ConeShape, Shape, SphereShape, StadiumShape

BoolArray = NDArray[np.bool_]

_POINTS_PER_SECTOR = 10
_FEWEST_SECTORS, _MOST_SECTORS = 12, 36
_LEAST_SHARE = 0.2
"""Of the points in a sector that is seen well: with fewer it is not seen."""
_SEEN_WELL = 0.9
"""Quantile of the sectors' points."""
_CAP = 0.98
"""Share of a sphere's points that its cap holds."""


@dataclass(frozen=True, slots=True)
class Coverage:
    """What was seen of a circumference; of a slot its outline counts as 360 degrees, of a sphere a great circle."""

    seen_deg: float
    """All seen sectors together."""
    largest_gap_deg: float
    """The widest piece without points of seen sectors; 0 where all sectors were seen."""

    @property
    def arc_deg(self) -> float:
        """The arc that holds all that was seen: two facing quarters hold a diameter as well as three quarters in a row."""
        return 360.0 - self.largest_gap_deg


def coverage_of(shape: Shape, local_mm: FloatArray, params: FloatArray) -> Coverage | None:
    """Of points (n, 3) in the frame of a fitted shape; None where it is not round."""
    if isinstance(shape, SphereShape):
        return _cap(local_mm - params[:3])
    place = _place(shape, local_mm, params)
    if place is None:
        return None
    sector, seen = _sectors(place)
    # sectors at the ends of an arc are filled in part: there the points themselves tell
    gap = 0.0 if seen.all() else 360.0 * _widest_gap(place[seen[sector]])
    return Coverage(min(360.0 * float(seen.mean()), 360.0 - gap), gap)


def on_seen_sectors(shape: Shape, local_mm: FloatArray, params: FloatArray) -> BoolArray:
    """(n,) which points do not stray alone on a side that was not seen."""
    place = _place(shape, local_mm, params)
    if place is None:
        return np.ones(len(local_mm), dtype=np.bool_)
    sector, seen = _sectors(place)
    return np.asarray(seen[sector])


def along_outline(shape: StadiumShape, local_mm: FloatArray) -> FloatArray:
    """(n,) way along the nominal outline, mm, from the end of its right half circle, half of it each way round."""
    half = shape.half_straight_mm
    u = np.clip(local_mm[:, 0], -half, half)
    angle = np.arctan2(local_mm[:, 1], local_mm[:, 0] - u)
    return np.asarray(angle * shape.half_width_mm + np.where(angle > 0, half - u, u - half))


def _place(shape: Shape, local_mm: FloatArray, params: FloatArray) -> FloatArray | None:
    """(n,) 0 to 1 round the circumference; None where there is none, or where a cap tells it."""
    if isinstance(shape, ConeShape):
        return np.asarray(np.arctan2(local_mm[:, 1] - params[1], local_mm[:, 0] - params[0]) / (2 * np.pi) + 0.5)
    if isinstance(shape, StadiumShape):
        length = 2 * np.pi * shape.half_width_mm + 4 * shape.half_straight_mm
        return along_outline(shape, local_mm - np.array([params[0], params[1], 0.0])) / length + 0.5
    return None


def _sectors(place: FloatArray) -> tuple[NDArray[np.int64], BoolArray]:
    """Sector of each point, and which sectors were seen."""
    n = int(np.clip(len(place) // _POINTS_PER_SECTOR, _FEWEST_SECTORS, _MOST_SECTORS))
    sector = np.clip(np.floor(place * n), 0, n - 1).astype(np.int64)
    count = np.bincount(sector, minlength=n)
    return sector, np.asarray(count >= max(1.0, _LEAST_SHARE * float(np.quantile(count, _SEEN_WELL))))


def _widest_gap(place: FloatArray) -> float:
    """Between neighbours on a ring of length 1."""
    ordered = np.sort(place)
    return float(np.diff([*ordered, ordered[0] + 1.0]).max())


def _cap(way_mm: FloatArray) -> Coverage:
    """Across the middle of what was seen of a sphere."""
    unit = way_mm / np.maximum(np.linalg.norm(way_mm, axis=1), 1e-9)[:, None]
    middle = unit.mean(axis=0)
    cosine = unit @ middle / max(float(np.linalg.norm(middle)), 1e-9)
    seen = 2 * float(np.degrees(np.arccos(np.clip(np.quantile(cosine, 1 - _CAP), -1.0, 1.0))))
    return Coverage(seen, 360.0 - seen)
