"""The capsules of an arm and the camera at it: how near they come to each other, and how far they get when the axes turn."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.kinematics import mdh
from drivers.kinematics.mdh import Capsule, RobotModel
from drivers.kinematics.se3 import FloatArray

# Neighbours touch by construction, and the rough capsules of links two apart overlap in ordinary poses.
_LINKS_APART = 3
# A camera that sticks out of the flange may meet the forearm, two links apart; one with less room than this in half of so
# many random poses sits so near to the wrist that the rough shapes cannot tell.
_POSES_TO_TELL = 64
_ROOM_MM = 40.0
_TINY = 1e-12


class ArmBody:
    """Capsules with the links that carry them, and the pairs of them that may meet."""

    def __init__(self, model: RobotModel, flange_from_camera: ArrayLike | None, camera_radius_mm: float) -> None:
        camera = _camera_capsules(model, flange_from_camera, camera_radius_mm)
        self.capsules = (*model.shape, *camera)
        self.links = np.array([capsule.link for capsule in self.capsules], dtype=np.intp)
        self._ends_in_link = np.array([(c.start_mm, c.end_mm) for c in self.capsules]).reshape(-1, 2, 3)
        self._radii_mm = np.array([c.radius_mm for c in self.capsules])
        self._pairs = np.array(
            [(i, j) for i in range(len(self.links)) for j in range(len(self.links)) if self.links[j] - self.links[i] >= _LINKS_APART], dtype=np.intp
        ).reshape(-1, 2)
        if camera:
            self._pairs = np.concatenate([self._pairs, self._camera_pairs(model)])

    def _camera_pairs(self, model: RobotModel) -> NDArray[np.intp]:
        """The camera (the last capsule) with what is two links apart, where the shapes can tell."""
        camera = len(self.links) - 1
        pairs = np.array([(i, camera) for i in np.flatnonzero(self.links == self.links[camera] - _LINKS_APART + 1)], dtype=np.intp).reshape(-1, 2)
        random = np.random.default_rng(0).uniform(-np.pi, np.pi, (_POSES_TO_TELL, model.n_joints))
        return pairs[np.median(self._gaps_mm(mdh.chain(model, random), pairs), axis=0) > _ROOM_MM]

    def gaps_mm(self, frames: FloatArray) -> FloatArray:
        """(k, p) room between the pairs of capsules that may meet, negative where they overlap, for link frames (k, n + 1, 4, 4)."""
        return self._gaps_mm(frames, self._pairs)

    def _gaps_mm(self, frames: FloatArray, pairs: NDArray[np.intp]) -> FloatArray:
        ends = self._ends_mm(frames)
        first, second = ends[:, pairs[:, 0]], ends[:, pairs[:, 1]]
        apart = segment_distance(first[..., 0, :], first[..., 1, :], second[..., 0, :], second[..., 1, :])
        return np.asarray(apart - self._radii_mm[pairs].sum(axis=1))

    def excursions_mm(self, frames: FloatArray, turns_rad: FloatArray, margin_mm: float) -> tuple[FloatArray, FloatArray]:
        """Bounds on how far points of the arm get when the axes turn by at most `turns_rad` (k, n) from link frames (k, n + 1, 4, 4).

        A point at a distance r from an axis moves by no more than r times the angle; what the axes beyond it have moved the
        point before adds to its distance. Capsules count with a margin around them.

        Returns:
            (k,) of any point in the base, and (k, p) of the second of each pair as the first sees it.
        """
        n = turns_rad.shape[1]
        ends, radii = self._ends_mm(frames), self._radii_mm + margin_mm
        arms = ends[:, :, None] - frames[:, None, 1:, None, :3, 3]
        directions = np.broadcast_to(frames[:, None, 1:, None, :3, 2], arms.shape)
        distance = np.linalg.norm(np.cross(arms, directions), axis=-1).max(axis=-1) + radii[:, None]
        by_axis = np.zeros((len(frames), len(self.links), n + 1))
        for axis in range(n, 0, -1):
            moved = by_axis[:, :, axis]
            turned = moved + turns_rad[:, None, axis - 1] * (distance[:, :, axis - 1] + moved)
            by_axis[:, :, axis - 1] = np.where(self.links >= axis, turned, 0.0)
        in_base = by_axis[:, :, 0].max(axis=1, initial=0.0)
        return in_base, by_axis[:, self._pairs[:, 1], self.links[self._pairs[:, 0]]]

    def _ends_mm(self, frames: FloatArray) -> FloatArray:
        """(k, c, 2, 3) ends of all capsules in the base."""
        placed = frames[:, self.links]
        return np.asarray(np.einsum("kcij,cej->kcei", placed[..., :3, :3], self._ends_in_link) + placed[..., None, :3, 3])


def segment_distance(first: FloatArray, first_end: FloatArray, second: FloatArray, second_end: FloatArray) -> FloatArray:
    """(...) distance between segments with ends (..., 3); a point is a segment of no length.

    The nearest points of the two lines, each cut to its segment in turn (C. Ericson, "Real-Time Collision Detection", 5.1.9).
    """
    along_1, along_2, apart = first_end - first, second_end - second, first - second
    a, e = (along_1**2).sum(-1), (along_2**2).sum(-1)
    b, c, f = (along_1 * along_2).sum(-1), (along_1 * apart).sum(-1), (along_2 * apart).sum(-1)
    safe_a, safe_e = np.maximum(a, _TINY), np.maximum(e, _TINY)
    across = a * e - b * b
    s = np.where(across > _TINY * a * e, np.clip((b * f - c * e) / np.maximum(across, _TINY), 0, 1), 0.0)
    t = np.clip((b * s + f) / safe_e, 0, 1)
    s = np.where(a > 0, np.clip((b * t - c) / safe_a, 0, 1), 0.0)
    return np.asarray(np.linalg.norm(apart + s[..., None] * along_1 - t[..., None] * along_2, axis=-1))


def _camera_capsules(model: RobotModel, flange_from_camera: ArrayLike | None, radius_mm: float) -> tuple[Capsule, ...]:
    """Bracket and camera, and the camera alone."""
    if flange_from_camera is None or radius_mm <= 0:
        return ()
    x, y, z = np.asarray(flange_from_camera, dtype=np.float64)[:3, 3].tolist()
    return tuple(Capsule(model.n_joints, start, (x, y, z), radius_mm) for start in ((0.0, 0.0, 0.0), (x, y, z)))
