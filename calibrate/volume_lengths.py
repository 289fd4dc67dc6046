"""What lengths over the work volume are good for: the figure that a verdict on length must rest on.

Spheres stand where they stand; work is measured over the whole volume, and a length between far places of it is the
least certain one. The poses that `datum_poses` finds point into the volume from all sides, so that they serve
as views: a place is what some neighbouring views see at the middle of the camera's volume, and what they get wrong
together is the place's error.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from calibrate.result import Calibration
from drivers.kinematics.se3 import FloatArray

_N_PLACES, _VIEWS = 14, 6
_SHORTEST_SHARE = 0.25
"""Lengths shorter than this part of the longest tell nothing about the volume."""
_ONE_PLACE_MM = 1.0


def volume_length_uncertainty_mm(calibration: Calibration, work_volume_mm: FloatArray, joints_rad: FloatArray) -> float | None:
    """Expanded uncertainty (k = 2) of the least certain length over a work volume (2, 3), noise of the shots averaged out.

    None where the poses (k, n_axes) all point to one place: there is no length then.
    """
    middle = np.broadcast_to(calibration.camera_seen_volume_mm.mean(axis=0), (len(joints_rad), 3))
    seen = calibration.points_in_base_mm(middle, joints_rad=joints_rad)
    jacobian = calibration.point_jacobian(middle, joints_rad=joints_rad)
    places = _spread(seen, work_volume_mm)
    moved = [jacobian[np.argsort(np.linalg.norm(seen - seen[place], axis=1), kind="stable")[:_VIEWS]].mean(axis=0) for place in places]
    covariance = calibration.covariance[: jacobian.shape[-1], : jacobian.shape[-1]]
    ways = {(a, b): seen[places[b]] - seen[places[a]] for a, b in combinations(range(len(places)), 2)}
    longest = max((float(np.linalg.norm(way)) for way in ways.values()), default=0.0)
    if longest < _ONE_PLACE_MM:
        return None
    variances = []
    for (a, b), way in ways.items():
        length = float(np.linalg.norm(way))
        if length >= _SHORTEST_SHARE * longest:
            row = way / length @ (moved[b] - moved[a])
            variances.append(float(row @ covariance @ row))
    return 2.0 * float(np.sqrt(max(variances)))


def _spread(points_mm: FloatArray, box_mm: FloatArray) -> list[int]:
    """Indices of points (k, 3) far from each other, those in the box first: each next one is the farthest from all before."""
    inside = np.flatnonzero(((points_mm >= box_mm[0]) & (points_mm <= box_mm[1])).all(axis=1))
    candidates = inside if len(inside) >= _N_PLACES else np.arange(len(points_mm))
    chosen = [int(candidates[np.argmax(np.linalg.norm(points_mm[candidates] - box_mm.mean(axis=0), axis=1))])]
    while len(chosen) < min(_N_PLACES, len(candidates)):
        distance = np.linalg.norm(points_mm[candidates, None] - points_mm[chosen], axis=2).min(axis=1)
        chosen.append(int(candidates[distance.argmax()]))
    return chosen
