"""How many views shots really are: a pose taken again shows the same view of a sphere, and tells only what the first told.

Each view of a sphere tells where its centre is, three numbers. Too few of them leave directions open whatever the noise
looks like; the rank of a Jacobian alone would not say so, since repeats that differ by noise are not quite alike.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibrate.problem import Priors, Problem
from drivers.kinematics.se3 import FloatArray

_ALIKE_MM, _LEVER_MM = 2.0, 500.0
"""Poses whose flanges differ by less, turns counted at half a metre: an error of physical size looks the same from both."""
_HELD_HAND_EYE_MM, _HELD_HAND_EYE_RAD = 3.0, 0.01


def count_distinct_views(problem: Problem) -> int:
    """Number of pairs of a pose and a sphere that differ by more than the repetition of one."""
    pose = problem.base_from_flange
    features = np.concatenate([pose[:, :3, 3], _LEVER_MM * pose[:, :3, :3].reshape(-1, 9)], axis=1)
    if problem.joints_rad is not None:
        # another branch of the arm at the same flange pose is another view
        features = np.concatenate([features, _LEVER_MM * problem.joints_rad], axis=1)
    return sum(_count_distinct(features[problem.sphere == s]) for s in np.unique(problem.sphere))


def most_rank(problem: Problem) -> int:
    """What so many views could determine of robot, hand-eye and camera at most, all sphere places being unknown."""
    n_spheres = len(np.unique(problem.sphere))
    told = 3 * (count_distinct_views(problem) - n_spheres) + len(problem.lengths)
    return max(told, 0) + problem.layout.n_camera


def is_starved(problem: Problem) -> bool:
    """Whether shots of an area camera are of so few views that their number alone leaves robot or hand-eye open."""
    layout = problem.layout
    if not problem.along_sight or problem.external is not None:
        return False
    return most_rank(problem) - layout.n_camera < (4 * layout.n_links if layout.n_links else 6)


def held_by_priors(priors: Priors) -> Priors:
    """Priors for starved shots: what these leave open of the hand-eye transform stays near its first guess."""
    return replace(priors, hand_eye_mm=min(priors.hand_eye_mm, _HELD_HAND_EYE_MM), hand_eye_rad=min(priors.hand_eye_rad, _HELD_HAND_EYE_RAD))


def _count_distinct(features: FloatArray) -> int:
    """Greedily, in an order of the values: the order of the shots must not change a result."""
    rest, found = features[np.lexsort(features.T[::-1])], 0
    while len(rest):
        found += 1
        rest = rest[np.linalg.norm(rest - rest[0], axis=1) > _ALIKE_MM]
    return found
