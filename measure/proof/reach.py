"""Shots beyond what a calibration saw: outside its part of the camera's volume, or its ranges of the axes.

There a calibration continues what it found elsewhere, and its uncertainty says little. Such shots are used and told.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calibrate.external_points import ExternalShot
from calibrate.observations import SphereShot
from drivers.kinematics.se3 import FloatArray

_MARGIN_MM, _MARGIN_RAD = 5.0, 0.02
_LEAST_SHARE = 0.05
"""Of a shot's points beyond the seen volume: fewer are the rim of a sphere."""
_SAME_PLACE_MM = 20.0


class KnowsItsReach(Protocol):
    """What this module needs of a calibration."""

    @property
    def camera_seen_volume_mm(self) -> FloatArray:
        """(2, 3) corners in the camera frame."""
        ...

    @property
    def seen_joints_rad(self) -> FloatArray | None:
        """(2, n) least and greatest axis angles."""
        ...

    @property
    def sphere_centres_in_base_mm(self) -> Mapping[str, FloatArray]:
        """{name: (3,)} where its spheres stood."""
        ...


@dataclass(frozen=True, slots=True)
class OutsideShot:
    """A shot that the calibration can only extrapolate to."""

    session: str
    index: int
    sphere: str
    """Or target on the flange."""
    what: tuple[str, ...]
    """In words, one for each way it is outside."""


def shots_outside(calibration: KnowsItsReach, shots: Sequence[SphereShot]) -> tuple[OutsideShot, ...]:
    """The shots of some that lie beyond the calibrated camera volume or axis ranges."""
    found = []
    for shot in shots:
        what = (*_beyond_camera(calibration.camera_seen_volume_mm, shot), *_beyond_axes(calibration.seen_joints_rad, shot))
        if what:
            found.append(OutsideShot(shot.session, shot.index, shot.sphere, what))
    return tuple(found)


def external_outside(calibration: KnowsItsReach, points: Sequence[ExternalShot]) -> tuple[OutsideShot, ...]:
    """The external points of some whose stops lie beyond the calibrated axis ranges."""
    found = [(point, tuple(_beyond_axes(calibration.seen_joints_rad, point))) for point in points]
    return tuple(OutsideShot(point.session, point.index, point.target, what) for point, what in found if what)


def warnings_of(outside: Sequence[OutsideShot], n_shots: int) -> tuple[str, ...]:
    """A sentence for people where there are any."""
    if not outside:
        return ()
    first = outside[0]
    return (f"{len(outside)} of {n_shots} shots lie beyond what the calibration saw (shot {first.index}: {first.what[0]}); there it extrapolates",)


def is_unseen_place(calibration: KnowsItsReach, centre_in_base_mm: FloatArray) -> bool:
    """Whether no sphere of the calibration stood at a place (3,)."""
    return all(float(np.linalg.norm(place - centre_in_base_mm)) > _SAME_PLACE_MM for place in calibration.sphere_centres_in_base_mm.values())


def _beyond_camera(box_mm: FloatArray, shot: SphereShot) -> list[str]:
    points, found = shot.points_in_camera_mm, []
    for axis, name in enumerate("xyz"):
        low, high = box_mm[:, axis]
        outside = (points[:, axis] < low - _MARGIN_MM) | (points[:, axis] > high + _MARGIN_MM)
        if outside.mean() > _LEAST_SHARE:
            worst = points[outside, axis]
            reach = worst[np.argmax(np.abs(worst - (low + high) / 2))]
            found.append(f"camera {name} to {reach:.0f} mm, calibrated from {low:.0f} to {high:.0f} mm")
    return found


def _beyond_axes(ranges_rad: FloatArray | None, shot: SphereShot | ExternalShot) -> list[str]:
    if ranges_rad is None or shot.joints_rad is None:
        return []
    low, high = np.degrees(ranges_rad)
    angle = np.degrees(shot.joints_rad)
    margin = np.degrees(_MARGIN_RAD)
    axes = np.flatnonzero((angle < low - margin) | (angle > high + margin))
    return [f"axis {i + 1} at {angle[i]:.0f} degrees, calibrated from {low[i]:.0f} to {high[i]:.0f}" for i in axes]
