"""External reference points: what a laser tracker saw of the arm, read from sessions (DESIGN.md 3)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibrate.robot_terms import RobotTerm, load_basis
from drivers.files.session import Session
from drivers.files.shots import Shot
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_SAME_STOP_RAD = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class ExternalShot:
    """One target on the flange, seen once from outside."""

    session: str
    """Digest of the session."""
    index: int
    reference: str
    """Name of the frame in which the point was measured."""
    target: str
    """Name of the point on the flange."""
    joints_rad: FloatArray
    """(n,)"""
    point_in_reference_mm: FloatArray
    """(3,)"""

    @property
    def key(self) -> tuple[str, int]:
        """Session and index: a name for the shot that no order changes."""
        return self.session, self.index


@dataclass(frozen=True, slots=True, eq=False)
class ExternalPoints:
    """The external points of a solve: E shots, H stops of the robot, n axes, K deflection terms."""

    shots: tuple[ExternalShot, ...]
    joints_rad: FloatArray
    """(E, n)."""
    load: FloatArray
    """(E, n, K) of the deflection terms."""
    stop: NDArray[np.int64]
    """(E,) index of the stop: targets seen at one stop share its pose noise."""
    reference: NDArray[np.int64]
    """(E,) index of the frame."""
    target: NDArray[np.int64]
    """(E,) index of the target."""
    points_in_reference_mm: FloatArray
    """(E, 3)."""
    weight: FloatArray
    """(E,) in [0, 1]: how far each shot is believed."""
    references: tuple[str, ...]
    """Names of the frames."""
    targets: tuple[str, ...]
    """Names of the targets."""
    first_base_from_reference: FloatArray | None = None
    """(F, 4, 4) the start's frames: a far and weak hold where the points leave them open."""
    first_target_in_flange_mm: FloatArray | None = None
    """(T, 3) the start's targets, held likewise."""

    @property
    def n_shots(self) -> int:
        """Number of shots E."""
        return len(self.stop)

    @property
    def n_stops(self) -> int:
        """Number of stops H."""
        return int(self.stop.max()) + 1 if self.n_shots else 0

    def held_at(self, base_from_reference: FloatArray, target_in_flange_mm: FloatArray) -> ExternalPoints:
        """The same points, frames (F, 4, 4) and targets (T, 3) held weakly where they are now."""
        return replace(self, first_base_from_reference=base_from_reference, first_target_in_flange_mm=target_in_flange_mm)

    def subset(self, keep: NDArray[np.int64]) -> ExternalPoints:
        """Some of the shots (indices), stops numbered anew; every frame and target stays."""
        _, stop = np.unique(self.stop[keep], return_inverse=True)
        return replace(
            self,
            shots=tuple(self.shots[i] for i in keep.tolist()),
            joints_rad=self.joints_rad[keep],
            load=self.load[keep],
            stop=stop.astype(np.int64),
            reference=self.reference[keep],
            target=self.target[keep],
            points_in_reference_mm=self.points_in_reference_mm[keep],
            weight=self.weight[keep],
        )


def external_shots(sessions: Sequence[Session]) -> tuple[ExternalShot, ...]:
    """All good external points of some sessions, in the order of their keys."""
    found = [_external_shot(session, shot) for session in sessions for shot in session.shots if shot.is_reference_point and shot.status == "ok"]
    return tuple(sorted((shot for shot in found if shot is not None), key=lambda s: s.key))


def _external_shot(session: Session, shot: Shot) -> ExternalShot | None:
    if shot.reference is None or shot.target is None or shot.point_in_reference_mm is None or shot.joints_rad is None:
        return None  # the reader lets no good shot through without them
    return ExternalShot(session.digest, shot.index, shot.reference, shot.target, shot.joints_rad, shot.point_in_reference_mm)


def external_points(shots: Sequence[ExternalShot], model: RobotModel, terms: tuple[RobotTerm, ...]) -> ExternalPoints:
    """Shots as arrays; frames and targets in the order of their names."""
    joints = np.array([shot.joints_rad for shot in shots], dtype=np.float64)
    references = tuple(sorted({shot.reference for shot in shots}))
    targets = tuple(sorted({shot.target for shot in shots}))
    return ExternalPoints(
        shots=tuple(shots),
        joints_rad=joints,
        load=load_basis(terms, model, joints),
        stop=_stops(shots),
        reference=np.array([references.index(shot.reference) for shot in shots], dtype=np.int64),
        target=np.array([targets.index(shot.target) for shot in shots], dtype=np.int64),
        points_in_reference_mm=np.array([shot.point_in_reference_mm for shot in shots], dtype=np.float64),
        weight=np.ones(len(shots)),
        references=references,
        targets=targets,
    )


def _stops(shots: Sequence[ExternalShot]) -> NDArray[np.int64]:
    """(E,) shots of one session that follow one another with the same axis angles belong to one stop."""
    result = np.zeros(len(shots), dtype=np.int64)
    order = sorted(range(len(shots)), key=lambda i: shots[i].key)
    for before, now in itertools.pairwise(order):
        first, second = shots[before], shots[now]
        same = first.session == second.session and bool(np.abs(first.joints_rad - second.joints_rad).max() <= _SAME_STOP_RAD)
        result[now] = result[before] + (not same)
    return result
