"""Which pose does a scan belong to? Shots that fit no better than by another shot's pose, and lists that slipped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrate.plausibility_causes import Recorded, with_poses_of
from calibrate.problem import IntArray
from calibrate.start_closure import Closure, fit_closure
from calibrate.start_consensus import Candidates, consensus_hand_eye
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

_FAR_SPREADS, _FAR_AT_LEAST_MM = 8.0, 3.0
_FITS_SPREADS, _FITS_AT_LEAST_MM = 4.0, 1.5
_SLIPPED_SHOTS, _SLIPPED_SHARE = 5, 0.1
_SEED = 20230830


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The pose that each of m scans fits."""

    data: Recorded
    pose_of: IntArray
    """(m,) row of the pose: the shot's own where that fits, -1 where none does."""
    sphere_of: IntArray
    """(m,) the sphere that the scan shows: the one named, or another at its place."""
    spread_mm: float

    @property
    def n_misfits(self) -> int:
        """How many scans do not fit the pose of their own shot."""
        return int((self.pose_of != np.arange(len(self.pose_of))).sum())

    def slipped(self) -> str | None:
        """What to tell of a list of which a part is shifted; None where it is not."""
        by = np.where(self.pose_of >= 0, self.data.index[self.pose_of] - self.data.index, 0)
        moved = Counter(by[(by != 0) & (self.data.session == self.data.session[self.pose_of])].tolist())
        if not moved:
            return None
        shift, n_shots = moved.most_common(1)[0]
        if n_shots < max(_SLIPPED_SHOTS, _SLIPPED_SHARE * len(by)):
            return None
        shots = self.data.index[by == shift]
        which = f"shots {shots.min()} to {shots.max()}" if len(set(self.data.session[by == shift])) == 1 else f"{n_shots} shots"
        return f"a part of the list is shifted: the scans of {which} belong to the poses of shots i{shift:+d}, the others to their own"

    def told(self, spheres: Sequence[str]) -> dict[int, str]:
        """What to tell of single shots, by row; names of the spheres by number."""
        index = self.data.index
        found = {int(row): f"its scan shows sphere {spheres[self.sphere_of[row]]}" for row in np.flatnonzero(self.sphere_of != self.data.sphere)}
        for row in np.flatnonzero((self.pose_of >= 0) & (self.pose_of != np.arange(len(index)))):
            other = int(self.pose_of[row])
            if self.pose_of[other] == row:
                found[int(row)] = f"its scan fits the pose of shot {index[other]} and the other way round: the two look exchanged"
            else:
                found[int(row)] = f"its scan fits the pose of shot {index[other]}"
        return found


def pairs_of(data: Recorded, closure: Closure) -> Pairs:
    """Pairs of shots of which most fit their own pose, by their common hand-eye transform."""
    spread_mm, m = float(closure.spread_mm[0]), len(data.sphere)
    places, hand_eye = closure.places_in_base_mm[0], closure.flange_from_camera[0]
    far = closure.miss_mm[0] > max(_FAR_SPREADS * spread_mm, _FAR_AT_LEAST_MM)
    fits_mm = max(_FITS_SPREADS * spread_mm, _FITS_AT_LEAST_MM)
    pose_of, sphere_of = np.arange(m), data.sphere.copy()
    for row in np.flatnonzero(far):
        pose_of[row] = -1
        own = se3.apply(data.base_from_flange[row] @ hand_eye, data.centres_in_camera_mm[row])
        to_places = np.linalg.norm(places - own, axis=1)
        if to_places.min() < fits_mm:
            pose_of[row], sphere_of[row] = row, int(to_places.argmin())
            continue
        by_others = se3.apply(data.base_from_flange @ hand_eye, data.centres_in_camera_mm[row])
        off = np.where(data.session == data.session[row], np.linalg.norm(by_others - places[data.sphere[row]], axis=1), np.inf)
        if off.min() < fits_mm:
            pose_of[row] = int(off.argmin())
    return Pairs(data, pose_of, sphere_of, spread_mm)


def slipped_pairs(data: Recorded) -> Pairs | None:
    """Pairs of a list where each scan belongs to the pose of its own shot, of the one before or of the one after.

    None where no half of the shots agrees on any such choice.
    """
    row_of = {(int(s), int(i)): k for k, (s, i) in enumerate(zip(data.session, data.index, strict=True))}
    tried = [(k, row_of[s, i + by]) for (s, i), k in row_of.items() for by in (0, -1, 1) if (s, i + by) in row_of]
    scan, pose = (np.array(rows, dtype=np.int64) for rows in zip(*tried, strict=True))
    candidates = Candidates(scan, data.sphere[scan], data.base_from_flange[pose], data.centres_in_camera_mm[scan])
    hand_eye = consensus_hand_eye(candidates, np.random.default_rng(_SEED))
    if hand_eye is None:
        return None
    pose_of = _best_poses(candidates.in_base_mm(hand_eye), scan, pose, data)
    changed = with_poses_of(data, np.arange(len(data.sphere)), pose_of)
    closure = fit_closure(changed.base_from_flange[None], changed.centres_in_camera_mm[None], changed.sphere)
    return Pairs(data, pose_of, data.sphere, float(closure.spread_mm[0]))


def _best_poses(in_base_mm: FloatArray, scan: IntArray, pose: IntArray, data: Recorded) -> IntArray:
    """(m,) for each scan the pose that brings it nearest to where most shots see its sphere."""
    pose_of = np.zeros(len(data.sphere), dtype=np.int64)
    for sphere in np.unique(data.sphere):
        rows = np.flatnonzero(data.sphere[scan] == sphere)
        apart = np.linalg.norm(in_base_mm[rows][:, None] - in_base_mm[rows][None], axis=2)
        # the place that half as many candidates as shots are nearest to: a third of them is right
        dense = np.partition(apart, len(np.unique(scan[rows])) // 2, axis=1)[:, len(np.unique(scan[rows])) // 2].argmin()
        for shot in np.unique(scan[rows]):
            own = rows[scan[rows] == shot]
            pose_of[shot] = pose[own[np.linalg.norm(in_base_mm[own] - in_base_mm[rows[dense]], axis=1).argmin()]]
    return pose_of
