"""A second look at shots that show several equal spheres: what the shots say together tells which sphere is which.

The first look at a scan knows nothing of the others. Without a hand-eye guess a scan with two equal spheres is refused
as ambiguous; with a guess that is far off the neighbour may be taken. Here all candidates of such shots are weighed
against one hand-eye transform: that of the shots that are clear, or, where too few are, the one on which most agree.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from acquire.cell import Cell
from acquire.sphere import SphereFinding, SphereNotFound, SphereSettings, find_spheres
from calibrate.observations import Observations, RejectedShot, SphereShot, flange_pose, gather_observations, observe, sphere_shot
from calibrate.plausibility_closure import CLOSES_MM, close, recorded, useful_shots
from calibrate.second_look_names import name_places, names_another
from calibrate.start_closure import LEAST_SHOTS
from calibrate.start_consensus import GATE_MM, Candidates, consensus_hand_eye
from drivers.errors import DataError
from drivers.files.session import Session, Shot, read_scan
from drivers.kinematics import se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_SEED = 20230830
_HOPELESS = ("no_points", "unit_metres", "mirror", "marked")
_SPOILED_SPREADS = 8.0

_Key = tuple[str, int]


@dataclass(frozen=True, slots=True, eq=False)
class _Sight:
    """One place where a shot may show its sphere."""

    key: _Key
    sphere: str
    base_from_flange: FloatArray
    centre_in_camera_mm: FloatArray
    finding: SphereFinding | None = None
    """None for what the first look found."""


@dataclass(frozen=True, slots=True, eq=False)
class _Looker:
    """What is needed to look at a shot again."""

    shots: Mapping[_Key, tuple[Session, Shot]]
    cell: Cell
    model: RobotModel | None
    settings: SphereSettings | None

    def candidates(self, key: _Key) -> list[_Sight]:
        """Every sphere of the right size in a shot's scan."""
        session, shot = self.shots[key]
        name = str(shot.sphere)
        try:
            found = find_spheres(read_scan(session, shot).xyz_mm, radius_mm=self.cell.spheres[name].radius_mm, settings=self.settings)
        except SphereNotFound:
            return []
        flange = flange_pose(shot, self.model)
        return [_Sight(key, name, flange, finding.centre_in_camera_mm, finding) for finding in found]

    def taken(self, sight: _Sight) -> SphereShot:
        """The shot with a candidate as its sphere."""
        session, shot = self.shots[sight.key]
        points = np.zeros((0, 3)) if sight.finding is None else sight.finding.points_in_camera_mm
        return sphere_shot(session, shot, cell=self.cell, model=self.model, points_in_camera_mm=points, centre_in_camera_mm=sight.centre_in_camera_mm)

    def near(self, key: _Key, flange_from_camera: FloatArray, places: Mapping[str, FloatArray]) -> SphereShot | None:
        """The shot with what stands at the place of its sphere; None where nothing is found there."""
        session, shot = self.shots[key]
        if shot.sphere is None or shot.sphere not in places:
            return None
        expected = se3.apply(se3.inverse(flange_pose(shot, self.model) @ flange_from_camera), places[shot.sphere])
        try:
            found = observe(session, shot, cell=self.cell, model=self.model, settings=self.settings, predict=lambda _: expected)
        except SphereNotFound:
            return None
        off_mm = np.inf if found.centre_in_camera_mm is None else float(np.linalg.norm(found.centre_in_camera_mm - expected))
        return found if off_mm < GATE_MM else None


def see_sessions(sessions: Sequence[Session], *, cell: Cell, model: RobotModel | None) -> Observations:
    """Both looks at all shots of some sessions, a scan that two sessions hold once; arguments and errors as of `gather_observations`."""
    seen = look_again(sessions, gather_observations(sessions, cell=cell, model=model), cell=cell, model=model)
    return _each_once(sessions, seen)


def _each_once(sessions: Sequence[Session], seen: Observations) -> Observations:
    """Without copies: counted twice, a scan would make the calibration surer of itself than it is.

    Raises:
        DataError: a session holds nothing but scans of another.
    """
    folders = {session.digest: session.folder.name for session in sessions}
    first: dict[tuple[str, str], SphereShot] = {}
    copies: list[RejectedShot] = []
    for shot in seen.shots:
        original = first.setdefault((shot.scan_sha256, shot.sphere), shot)
        if original.session != shot.session:
            where = f"shot {original.index} of {folders.get(original.session, original.session[:12])}"
            copies.append(RejectedShot(shot.session, shot.index, f"repeated: its scan is that of {where}, which counts once"))
    if not copies:
        return seen
    gone = {(copy.session, copy.index) for copy in copies}
    for whole in sorted({copy.session for copy in copies} - {shot.session for shot in seen.shots if shot.key not in gone}):
        message = f"the session {folders.get(whole, whole[:12])} holds nothing but scans of another one: they would count twice"
        raise DataError(message, remedy="Name one of the two.")
    return replace(seen, shots=tuple(shot for shot in seen.shots if shot.key not in gone), rejected=(*seen.rejected, *copies))


def look_again(
    sessions: Sequence[Session], first: Observations, *, cell: Cell, model: RobotModel | None, settings: SphereSettings | None = None
) -> Observations:
    """The observations, with shots taken back or corrected that the first look refused or mistook.

    Nothing changes where the first look refused none and all its shots agree. Where no agreement is found and a wrong
    expectation kept the first look from half of the shots, scans with one sphere of the size come back as they are, so that
    what is wrong with the poses can be found out.

    Raises:
        FileError: a scan is missing, cut off or changed.
    """
    if cell.camera.kind != "area":
        return first
    hand_eye, doubtful = _judged(first, cell, model)
    if not doubtful:
        return first
    looker = _Looker({(session.digest, shot.index): (session, shot) for session in sessions for shot in session.shots}, cell, model, settings)
    sights = [_Sight(s.key, s.sphere, s.base_from_flange, s.centre_in_camera_mm) for s in first.shots if s.centre_in_camera_mm is not None]
    sights = [sight for sight in sights if sight.key not in doubtful] + [sight for key in sorted(doubtful) for sight in looker.candidates(key)]
    if not sights:
        return first
    names, candidates = _as_candidates(sights)
    if hand_eye is None:
        hand_eye = consensus_hand_eye(candidates, np.random.default_rng(_SEED))
    if hand_eye is None:
        return _with_lone(looker, first, sights)
    places = name_places(candidates, names, hand_eye, cell)
    return _merged(first, _found(looker, sights, candidates.in_base_mm(hand_eye), doubtful, hand_eye, places))


def _judged(first: Observations, cell: Cell, model: RobotModel | None) -> tuple[FloatArray | None, set[_Key]]:
    """The hand-eye transform of the first look, None where its shots do not close, and the shots to be seen again."""
    refused = {(r.session, r.index) for r in first.rejected if not r.reason.startswith(_HOPELESS)}
    useful, data = useful_shots(first.shots), recorded(first.shots, model)
    # without a guess and without a doubt the first look saw all there is
    misled = cell.flange_from_camera is not None or any(r.reason.startswith("ambiguous") for r in first.rejected)
    everything = {shot.key for shot in first.shots} | refused if misled else set()
    if len(useful) < LEAST_SHOTS:
        return None, everything
    closure = close(data)
    spread_mm = float(closure.spread_mm[0])
    places = dict(zip(sorted({shot.sphere for shot in useful}), closure.places_in_base_mm[0], strict=True))
    if spread_mm > CLOSES_MM or names_another(places, cell):
        return None, everything
    far = closure.miss_mm[0] > max(_SPOILED_SPREADS * spread_mm, GATE_MM)
    return closure.flange_from_camera[0], refused | {shot.key for shot, is_far in zip(useful, far, strict=True) if is_far}


def _as_candidates(sights: Sequence[_Sight]) -> tuple[list[str], Candidates]:
    """Names of the spheres that the numbers mean, and the sights as arrays in their order."""
    names = sorted({sight.sphere for sight in sights})
    keys = {key: row for row, key in enumerate(dict.fromkeys(sight.key for sight in sights))}
    return names, Candidates(
        shot=np.array([keys[sight.key] for sight in sights], dtype=np.int64),
        sphere=np.array([names.index(sight.sphere) for sight in sights], dtype=np.int64),
        base_from_flange=np.array([sight.base_from_flange for sight in sights]),
        centre_in_camera_mm=np.array([sight.centre_in_camera_mm for sight in sights]),
    )


def _found(
    looker: _Looker,
    sights: Sequence[_Sight],
    in_base_mm: FloatArray,
    doubtful: set[_Key],
    flange_from_camera: FloatArray,
    places: Mapping[str, FloatArray],
) -> dict[_Key, SphereShot]:
    """Shots with the sphere that stands at the place of the one they name."""
    off = [float(np.linalg.norm(place - places[s.sphere])) if s.sphere in places else np.inf for s, place in zip(sights, in_base_mm, strict=True)]
    nearest: dict[_Key, int] = {}
    for row, sight in enumerate(sights):
        if off[row] < min(GATE_MM, off[nearest[sight.key]] if sight.key in nearest else np.inf):
            nearest[sight.key] = row
    found = {key: looker.taken(sights[row]) for key, row in nearest.items() if sights[row].finding is not None}
    unseen = (doubtful | {sight.key for sight in sights}) - set(nearest)
    again = {key: looker.near(key, flange_from_camera, places) for key in sorted(unseen)}
    return found | {key: shot for key, shot in again.items() if shot is not None}


def _with_lone(looker: _Looker, first: Observations, sights: Sequence[_Sight]) -> Observations:
    if 2 * len(first.shots) >= first.n_shots - len(first.external):
        return first
    refused, count = {(r.session, r.index) for r in first.rejected}, Counter(sight.key for sight in sights)
    lone = {sight.key: looker.taken(sight) for sight in sights if sight.key in refused and count[sight.key] == 1}
    return _merged(first, lone) if lone else first


def _merged(first: Observations, found: Mapping[_Key, SphereShot]) -> Observations:
    shots = {shot.key: shot for shot in first.shots} | dict(found)
    rejected = tuple(r for r in first.rejected if (r.session, r.index) not in found)
    return replace(first, shots=tuple(shots[key] for key in sorted(shots)), rejected=rejected)
