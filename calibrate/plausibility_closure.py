"""Do scans and poses belong together? Where they do not, the likely mistakes are tried, and the one that explains it is named."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibrate.observations import Observations, RejectedShot, SphereShot
from calibrate.plausibility_causes import Cause, Recorded, causes, shifts
from calibrate.plausibility_pairs import Pairs, pairs_of, slipped_pairs
from calibrate.start_closure import LEAST_SHOTS, Closure, fit_closure
from drivers.errors import DataError
from drivers.files.session import Session
from drivers.kinematics.mdh import RobotModel

TRIED_FROM_MM = 1.0
"""Sigma of one component that good robots stay below; beyond it mistakes are tried, at no risk for a bad robot."""
CLOSES_MM = 3.0
"""What bad robots may leave; beyond it the shots do not belong together."""
_EXPLAINS = 5.0
_PLAUSIBLE_MM = 15.0
_HOPELESS_MM = 30.0
_AS_GOOD = 1.2
_MOST_TRIED_SHOTS = 24
_LEAST_PER_SPHERE = 3


@dataclass(frozen=True, slots=True)
class Trial:
    """A mistake and what is left when it is undone."""

    cause: Cause
    spread_mm: float


def check_closure(sessions: Sequence[Session], observations: Observations, model: RobotModel | None) -> Mapping[tuple[str, int], str]:
    """Check that one hand-eye transform brings the shots of every sphere to one place.

    Returns:
        What is to be told of single shots that do not fit, by session and index: whose pose they fit, or which sphere.

    Raises:
        DataError: it does not, and a mistake explains why: undone, the spread is five times smaller. Or nothing brings
            the shots within some centimetres; the error then says what was tried.
    """
    useful, data = useful_shots(observations.shots), recorded(observations.shots, model)
    if len(useful) < LEAST_SHOTS:
        return {}
    file = sessions[0].folder / "shots.jsonl" if sessions else None
    closure = close(data)
    spread_mm = float(closure.spread_mm[0])
    enough_mm = min(spread_mm / _EXPLAINS, _PLAUSIBLE_MM)
    tried = try_causes(data) if spread_mm > TRIED_FROM_MM else []
    best_mm = min((trial.spread_mm for trial in tried), default=np.inf)
    if best_mm <= enough_mm:
        equal = [trial for trial in tried if trial.spread_mm <= _AS_GOOD * best_mm]
        raise DataError(_explained(spread_mm, equal), file=file, remedy=equal[0].cause.remedy)
    if spread_mm <= CLOSES_MM:
        pairs = pairs_of(data, closure)
        _refuse_slipped(pairs, file)
        names = sorted({shot.sphere for shot in useful})
        return {useful[row].key: text for row, text in pairs.told(names).items()}
    slipped = slipped_pairs(data)
    if slipped is not None and slipped.spread_mm <= enough_mm:
        _refuse_slipped(slipped, file)
    if spread_mm > _HOPELESS_MM:
        raise DataError(
            f"no hand-eye transform brings the shots of a sphere to one place (they stay {spread_mm:.0f} mm apart), and no single "
            f"mistake explains it: {len(tried)} were tried ({_kinds(data)}), the best leaves {best_mm:.0f} mm",
            file=file,
            remedy="Check that every scan has the pose at which it was taken, the robot model, and that the spheres stood still.",
        )
    return {}


def with_hints(rejected: Sequence[RejectedShot], hints: Mapping[tuple[str, int], str]) -> tuple[RejectedShot, ...]:
    """Rejected shots with what is known of why they do not fit."""
    return tuple(replace(r, reason=f"{r.reason}; {hints[r.session, r.index]}") if (r.session, r.index) in hints else r for r in rejected)


def _refuse_slipped(pairs: Pairs, file: Path | None) -> None:
    slipped = pairs.slipped()
    if slipped is not None:
        raise DataError(
            f"scans and poses do not belong together: {slipped}; so paired they agree to {pairs.spread_mm:.2f} mm, "
            f"as recorded {pairs.n_misfits} of {len(pairs.pose_of)} shots do not fit",
            file=file,
            remedy="Pair every scan with the pose at which it was taken; a scan that was lost or taken twice moves all later ones.",
        )


def recorded(shots: Sequence[SphereShot], model: RobotModel | None) -> Recorded:
    """The useful ones of some shots as arrays, in their order."""
    useful = useful_shots(shots)
    spheres, sessions = sorted({s.sphere for s in useful}), sorted({s.session for s in useful})
    with_joints = bool(useful) and model is not None and all(shot.joints_rad is not None for shot in useful)
    return Recorded(
        model=model if with_joints else None,
        joints_rad=np.array([s.joints_rad for s in useful], dtype=np.float64) if with_joints else None,
        base_from_flange=np.array([s.base_from_flange for s in useful]).reshape(-1, 4, 4),
        centres_in_camera_mm=np.array([s.centre_in_camera_mm for s in useful], dtype=np.float64).reshape(-1, 3),
        sphere=np.array([spheres.index(s.sphere) for s in useful], dtype=np.int64),
        session=np.array([sessions.index(s.session) for s in useful], dtype=np.int64),
        index=np.array([s.index for s in useful], dtype=np.int64),
    )


def useful_shots(shots: Sequence[SphereShot]) -> list[SphereShot]:
    """The shots with a centre, of spheres seen often enough to contradict a wrong pose."""
    seen = [shot for shot in shots if shot.centre_in_camera_mm is not None]
    count = Counter(shot.sphere for shot in seen)
    return [shot for shot in seen if count[shot.sphere] >= _LEAST_PER_SPHERE]


def close(data: Recorded) -> Closure:
    """The common hand-eye transform of some shots as they are."""
    return fit_closure(data.base_from_flange[None], data.centres_in_camera_mm[None], data.sphere)


def try_causes(data: Recorded) -> list[Trial]:
    """Every likely mistake and the spread that is left when it is undone, plain mistakes first."""
    moved = [(cause, cause.undo(data)) for cause in shifts()]
    enough = max(LEAST_SHOTS, len(data.sphere) // 2)
    moved = [(cause, changed) for cause, changed in moved if len(changed.sphere) >= enough]
    thin = thinned(data, _MOST_TRIED_SHOTS)
    return _trials(moved) + _trials([(cause, cause.undo(thin)) for cause in causes(data)])


def _trials(changes: Sequence[tuple[Cause, Recorded]]) -> list[Trial]:
    if not changes:
        return []
    n_shots = min(_MOST_TRIED_SHOTS, *(len(changed.sphere) for _, changed in changes))
    parts = [thinned(changed, n_shots) for _, changed in changes]
    closure = fit_closure(
        np.array([part.base_from_flange for part in parts]),
        np.array([part.centres_in_camera_mm for part in parts]),
        np.array([part.sphere for part in parts]),
    )
    return [Trial(cause, float(spread)) for (cause, _), spread in zip(changes, closure.spread_mm, strict=True)]


def thinned(data: Recorded, n_shots: int) -> Recorded:
    """So many shots, evenly from all."""
    chosen = np.linspace(0, len(data.sphere) - 1, min(len(data.sphere), n_shots)).astype(np.int64)
    return data.part(chosen)


def _explained(spread_mm: float, equal: Sequence[Trial]) -> str:
    others = [trial.cause.name for trial in equal[1:3]]
    same = f" (or, which comes to the same: {'; '.join(others)})" if others else ""
    return (
        f"scans and poses do not belong together: the shots of a sphere stay {spread_mm:.1f} mm apart; "
        f"most likely {equal[0].cause.name}{same}: with that undone they agree to {equal[0].spread_mm:.2f} mm"
    )


def _kinds(data: Recorded) -> str:
    if data.joints_rad is None:
        return "units, inverse and transposed poses, conventions of angles and quaternions, mirrored scans, shifted or reversed lists"
    return "degrees, order, signs and zeros of the axes, coupling, other robot models, units and mirrored scans, shifted or reversed lists"
