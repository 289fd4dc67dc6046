"""Where accuracy matters: lengths between places of the work volume, each place measured from several views.

A common fit of all views of a sphere moves its centre by `inv(sum u u') sum u dr`, dr the residuals that an error of
the calibration causes, so the length between two places moves by the difference of two such means: what moves both
ends alike cancels, what changes from view to view averages out. This is how `verify` measures a length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from calibrate.design_shots import Scene, ideal_caps, layout_of, point_weight, pose_covariance_mm2
from drivers.errors import DataError
from drivers.kinematics.se3 import FloatArray

_SHORTEST_SHARE = 0.25
"""Lengths shorter than this part of the longest tell nothing about the volume."""


@dataclass(frozen=True, slots=True, eq=False)
class Aim:
    """Gradients of what will be measured; P unknowns and q disturbances as columns."""

    lengths: FloatArray
    """(l, P + q) of each length."""
    centres: FloatArray
    """(c, P + q) of every component of every view's own centre about its place's mean; empty for line profiles."""
    centre_noise_mm2: float
    """Mean square distance of one view's centre from the mean that points and pose noise cause by themselves."""


def aim_at(scene: Scene, places_in_base_mm: FloatArray, views_rad: Sequence[FloatArray]) -> Aim:
    """The aim of measuring spheres at places (k, 3), each from its own views (v, n).

    The sphere measured has the mean radius of the scene's.

    Raises:
        DataError: fewer than two places are seen.
    """
    seen = [i for i, views in enumerate(views_rad) if len(views)]
    if len(seen) < 2:
        raise DataError("the work volume has fewer than two places that the camera can see", remedy="Check work_volume_mm and the robot's reach.")
    places = places_in_base_mm[seen]
    looks = [_look(scene, place, views_rad[i]) for i, place in zip(seen, places, strict=True)]
    longest = max(float(np.linalg.norm(a - b)) for a, b in combinations(places, 2))
    gradients = []
    for i, j in combinations(range(len(places)), 2):
        way = places[j] - places[i]
        length = float(np.linalg.norm(way))
        if length >= _SHORTEST_SHARE * longest:
            gradients.append(way / length @ (looks[j].centre - looks[i].centre))
    views = np.concatenate([look.views for look in looks])
    noise = np.concatenate([look.noise_mm2 for look in looks])
    return Aim(np.array(gradients), views.reshape(-1, views.shape[-1]), float(noise.mean()) if len(noise) else float("nan"))


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """One place measured from v views."""

    centre: FloatArray
    """(3, P + q) of the common fit."""
    views: FloatArray
    """(v, 3, P + q) of every view's own fit, about their mean."""
    noise_mm2: FloatArray
    """(v,)."""


def _look(scene: Scene, place: FloatArray, views_rad: FloatArray) -> _Look:
    one = replace(scene, centres_in_base_mm=place[None], radius_mm=np.array([scene.radius_mm.mean()]), radius_sigma_mm=np.ones(1), lengths=())
    sphere = np.zeros(len(views_rad), dtype=np.int64)
    caps = ideal_caps(one, views_rad, sphere)
    rotation = caps.geometry.base_from_camera[:, :3, :3]
    unit = caps.unit @ np.swapaxes(rotation, -1, -2)
    unit_t = np.swapaxes(unit, -1, -2)
    normal, right = unit_t @ unit, unit_t @ _as_unknowns_of(scene, one, caps.moved)
    centre = np.linalg.solve(normal.sum(axis=0), right.sum(axis=0))
    if not scene.along_sight:
        return _Look(centre, np.zeros((0, 3, centre.shape[-1])), np.zeros(0))
    own = np.linalg.solve(normal, right)
    points = np.linalg.inv(normal) / point_weight(scene)
    shot = np.trace(points, axis1=1, axis2=2) + np.trace(pose_covariance_mm2(one, caps.geometry), axis1=1, axis2=2)
    # about the mean of many views, which these few only estimate
    unbiased = np.sqrt(len(views_rad) / max(len(views_rad) - 1, 1))
    return _Look(centre, unbiased * (own - own.mean(axis=0)), shot)


def _as_unknowns_of(scene: Scene, one: Scene, moved: FloatArray) -> FloatArray:
    """Columns of the one-sphere scene as those of the whole: a measured sphere is none of the calibration's."""
    whole, single = layout_of(scene), layout_of(one)
    shared = single.sphere_radius.start
    spheres = np.zeros((*moved.shape[:-1], whole.size - shared))
    return np.concatenate([moved[..., :shared], spheres, moved[..., single.size :]], axis=-1)
