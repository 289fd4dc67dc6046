"""Where every shot may show one of several spheres: the hand-eye transform on which most shots agree (RANSAC over shots).

Six shots of one sphere give the linear system of METHOD.md 4, *First guess*; whether the nine numbers that stand for the
rotation are one tells at once whether the six candidates belong together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.problem import IntArray
from calibrate.start_closure import linear_hand_eye, linear_matrix, refine_closure
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

GATE_MM = 20.0
"""Room for a nominal robot; equal spheres stand further apart than this."""
_PER_SAMPLE = 6
_SAMPLES = 6000
_LIKE_A_ROTATION = 300
_JUDGED = 60
_POLISHED = 8
_POLISH_ROUNDS = 4
_LEAST_SHARE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """K places where m shots may show their spheres; at least one for every shot."""

    shot: IntArray
    """(K,) row of the shot."""
    sphere: IntArray
    """(K,) number of the sphere that the shot names."""
    base_from_flange: FloatArray
    """(K, 4, 4)"""
    centre_in_camera_mm: FloatArray
    """(K, 3)"""

    @property
    def n_shots(self) -> int:
        """Number of shots m."""
        return int(self.shot.max()) + 1 if len(self.shot) else 0

    def in_base_mm(self, flange_from_camera: FloatArray) -> FloatArray:
        """(K, 3) with a hand-eye transform (4, 4)."""
        return se3.apply(self.base_from_flange @ flange_from_camera, self.centre_in_camera_mm)


def consensus_hand_eye(candidates: Candidates, rng: np.random.Generator) -> FloatArray | None:
    """The flange_from_camera (4, 4) on which most shots agree; None where no half of them does."""
    samples = _draw(candidates, rng)
    if not len(samples):
        return None
    poses, centres = candidates.base_from_flange[samples], candidates.centre_in_camera_mm[samples]
    one = np.ones((_PER_SAMPLE, 1))
    stretch = np.linalg.svd(linear_matrix(poses, centres, one), compute_uv=False)
    rigid = np.argsort(np.abs(np.log(np.maximum(stretch, 1e-6))).max(axis=1), kind="stable")[:_LIKE_A_ROTATION]
    closure = refine_closure(poses[rigid], centres[rigid], one, linear_hand_eye(poses[rigid], centres[rigid], one, rounds=1))
    close = np.argsort(np.linalg.norm(closure.miss_mm, axis=1), kind="stable")[:_JUDGED]
    judged = sorted(closure.flange_from_camera[close], key=lambda x: -support(candidates, x))[:_POLISHED]
    polished = [_polished(candidates, hand_eye) for hand_eye in judged]
    best = max(polished, key=lambda x: support(candidates, x))
    return best if support(candidates, best) >= _LEAST_SHARE * candidates.n_shots else None


def support(candidates: Candidates, flange_from_camera: FloatArray) -> int:
    """How many shots have a candidate at the place that most shots of the same sphere point to."""
    return sum(int(agreeing.sum()) for agreeing in (_agreeing(candidates, flange_from_camera, s)[1] for s in np.unique(candidates.sphere)))


def _agreeing(candidates: Candidates, flange_from_camera: FloatArray, sphere: int) -> tuple[FloatArray, IntArray]:
    """The best supported place (3,) of one sphere, and 1 for each shot (m,) with a candidate there."""
    own = np.flatnonzero(candidates.sphere == sphere)
    in_base = candidates.in_base_mm(flange_from_camera)[own]
    near = np.linalg.norm(in_base[:, None] - in_base[None], axis=2) < GATE_MM
    shots = near.astype(np.float64) @ np.eye(candidates.n_shots)[candidates.shot[own]] > 0
    best = int(shots.sum(axis=1).argmax())
    return np.asarray(in_base[near[best]].mean(axis=0)), shots[best].astype(np.int64)


def _polished(candidates: Candidates, flange_from_camera: FloatArray) -> FloatArray:
    """Fitted again to all candidates that agree."""
    for _ in range(_POLISH_ROUNDS):
        in_base, rows = candidates.in_base_mm(flange_from_camera), []
        for sphere in np.unique(candidates.sphere):
            place, _ = _agreeing(candidates, flange_from_camera, int(sphere))
            own = np.flatnonzero(candidates.sphere == sphere)
            rows.append(own[np.linalg.norm(in_base[own] - place, axis=1) < GATE_MM])
        chosen = np.concatenate(rows)
        member = np.eye(int(candidates.sphere.max()) + 1)[candidates.sphere[chosen]]
        poses, centres = candidates.base_from_flange[chosen], candidates.centre_in_camera_mm[chosen]
        flange_from_camera = refine_closure(poses[None], centres[None], member, flange_from_camera[None]).flange_from_camera[0]
    return flange_from_camera


def _draw(candidates: Candidates, rng: np.random.Generator) -> IntArray:
    """Samples (B, 6) of candidates of six shots of one sphere, shots with few candidates more often."""
    count = np.bincount(candidates.shot, minlength=candidates.n_shots)
    found = []
    spheres = [s for s in np.unique(candidates.sphere) if len(np.unique(candidates.shot[candidates.sphere == s])) >= _PER_SAMPLE]
    for sphere in spheres:
        own = np.flatnonzero(candidates.sphere == sphere)
        shots = np.unique(candidates.shot[own])
        # the six shots with the largest keys: a weighted draw without replacement (Efraimidis and Spirakis 2006)
        keys = rng.random((_SAMPLES // len(spheres), len(shots))) ** count[shots]
        rows = shots[np.argsort(-keys, axis=1)[:, :_PER_SAMPLE]]
        # which of the shot's candidates: they stand together in the order of their shots
        order = own[np.argsort(candidates.shot[own], kind="stable")]
        first = np.searchsorted(candidates.shot[order], rows)
        found.append(order[first + (rng.random(rows.shape) * count[rows]).astype(np.int64)])
    return np.concatenate(found) if found else np.zeros((0, _PER_SAMPLE), dtype=np.int64)
