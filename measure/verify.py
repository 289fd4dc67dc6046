"""Verification: what a calibration is worth on shots it never saw.

Each shot's points are moved to the base by the calibration; from there on only plain figures count (see
`measure.sphere_figures`), judged by the three-state rule of `measure.decision`. The decision is charged with the
uncertainty of the test (certificate and scatter), never with that of the system under test.

`diameter_error_mm` compares with the certified diameter and nothing else: a sphere whose surface reads large shows it
there, as it would on a workpiece. What is left after the calibrated radius offset is
`diameter_error_less_offset_mm`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from acquire.cell import Cell, CertifiedLength, Limits, Sphere, cell_of_session, robot_model_of
from calibrate.normal import NoiseModel
from calibrate.observations import Observations, RejectedShot, SphereShot
from calibrate.second_look import see_sessions
from calibrate.temperature import artefact_when_seen, temperature_changes
from drivers.errors import DataError
from drivers.files.session import Session
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.decision import Judgement, judge, overall
from measure.length_uncertainty import End, distance_standard_uncertainty_mm
from measure.placing import JudgedSystem, check_fits, nominal_base_from_camera, pose_of
from measure.sphere_figures import Figures, SphereFigures, SphereSize, SphereView, figures_of, separation
from measure.verify_result import LengthResult, SessionName, VerifyResult

Placing = Callable[[SphereShot, FloatArray], FloatArray]
"""Moves points (n, 3) of a shot from the camera to the base."""

_SAME_POSE_MM, _SAME_POSE_RAD = 5.0, 0.02
"""Flange poses nearer than this are the same pose of the robot, taught twice or repeated."""

_LEAST_VIEWS = 2
_EXTERNAL = "external reference point: verification looks at spheres through the camera"


def verify(
    calibration: JudgedSystem,
    sessions: Sequence[Session],
    cell: Cell | None = None,
    *,
    limits: Limits | None = None,
    allow_training_data: bool = False,
) -> VerifyResult:
    """Figures and verdict of a calibration on other shots.

    Args:
        calibration: the calibration to judge.
        sessions: at least one, with shots of spheres.
        cell: spheres, lengths and limits; each session's own copy where None.
        limits: instead of the cell's.
        allow_training_data: take shots that the calibration was made from; the verdict then is `not_proven` at best.

    Raises:
        DataError: no shot shows a sphere; shots of the calibration itself; sessions whose cells contradict each other.
        FileError: a session is broken.
    """
    began = time.perf_counter()
    cells = [cell or cell_of_session(session) for session in sessions]
    for session, its_cell in zip(sessions, cells, strict=True):
        check_fits(calibration, session, its_cell)
    trained = _training_shots(calibration, sessions)
    if trained and not allow_training_data:
        raise _flattering(trained)
    observations = _gather(sessions, cells)
    artefact = artefact_when_seen(*_merged(cells), sessions)
    spheres, lengths = artefact.spheres, artefact.lengths
    limits = limits or next((c.limits for c in cells if c.limits is not None), None) or calibration.limits
    line_profile = cells[0].camera.kind == "line_profile"
    sizes = {name: SphereSize(s.radius_mm, calibration.radius_offset_mm) for name, s in spheres.items()}
    views = views_of(observations.shots, calibrated_placing(calibration))
    _require_still_spheres(views, sessions, spheres)
    figures = figures_of(views, sizes, line_profile=line_profile)
    before = _figures_before(observations, sessions, cells, spheres, line_profile=line_profile)
    results = tuple(_length(calibration, length, figures, observations) for length in lengths if set(length.between) <= set(figures.spheres))
    judgements = () if limits is None else _judgements(limits, figures, results, spheres)
    verdict, reasons = overall(judgements, _gaps(limits, figures, results, line_profile=line_profile, trained=bool(trained)))
    return VerifyResult(
        calibration_id=calibration.id,
        sessions=tuple(SessionName(session.folder.name, session.digest) for session in sessions),
        observations=observations,
        figures=figures,
        before=before,
        lengths=results,
        before_length_errors_mm={} if before is None else _length_errors(before, lengths),
        limits=limits,
        judgements=judgements,
        verdict=verdict,
        reasons=(*reasons, *artefact.notes, *temperature_changes(calibration.temperatures_c, sessions)),
        held_out=not trained,
        seconds=time.perf_counter() - began,
    )


def calibrated_placing(calibration: JudgedSystem) -> Placing:
    """Points of a shot through a calibration."""

    def place(shot: SphereShot, points: FloatArray) -> FloatArray:
        return calibration.points_in_base_mm(points, **pose_of(calibration.model, shot))

    return place


def views_of(shots: Sequence[SphereShot], place: Placing) -> list[SphereView]:
    """Shots as views in the base."""
    return [
        SphereView(shot.session, shot.index, shot.sphere, place(shot, shot.points_in_camera_mm), place(shot, _behind_surface(shot)[None])[0])
        for shot in shots
    ]


def _behind_surface(shot: SphereShot) -> FloatArray:
    if shot.centre_in_camera_mm is not None:
        return shot.centre_in_camera_mm
    mean = shot.points_in_camera_mm.mean(axis=0)
    return np.asarray(mean + 0.7 * shot.radius_mm * mean / np.linalg.norm(mean))


def _training_shots(calibration: JudgedSystem, sessions: Sequence[Session]) -> list[tuple[Session, int]]:
    """Shots (session, index) whose scans the calibration was made from, wherever they lie now."""
    known = {shot.scan_sha256 for shot in calibration.shots}
    return [(session, shot.index) for session in sessions for shot in session.shots if shot.sha256 in known]


def _gather(sessions: Sequence[Session], cells: Sequence[Cell]) -> Observations:
    parts = [see_sessions([s], cell=c, model=robot_model_of(c, s)) for s, c in zip(sessions, cells, strict=True)]
    shots = sorted((shot for part in parts for shot in part.shots), key=lambda shot: shot.key)
    external = tuple(RejectedShot(shot.session, shot.index, _EXTERNAL) for part in parts for shot in part.external)
    rejected = tuple(shot for part in parts for shot in part.rejected) + external
    if not shots and len(external) == len(rejected) > 0:
        remedy = "Name a session with shots of spheres; `spherecal calibrate` itself judges the robot on points left out."
        raise DataError("the session holds external reference points alone; verification looks at spheres", file=sessions[0].folder, remedy=remedy)
    if not shots:
        why = f"; the first refusal was: {rejected[0].reason}" if rejected else ""
        raise DataError(f"none of {len(rejected)} shots shows a sphere{why}", file=sessions[0].folder, remedy="Capture shots of the spheres.")
    return Observations(tuple(shots), rejected)


def _merged(cells: Sequence[Cell]) -> tuple[dict[str, Sphere], list[CertifiedLength]]:
    spheres: dict[str, Sphere] = {}
    lengths: dict[tuple[str, str], CertifiedLength] = {}
    for cell in cells:
        for name, sphere in cell.spheres.items():
            if spheres.setdefault(name, sphere).diameter_mm != sphere.diameter_mm:
                raise DataError(
                    f"sphere {name} has {spheres[name].diameter_mm:g} mm in one session's cell and {sphere.diameter_mm:g} mm in another's",
                    file=cell.path,
                    remedy="Verify them apart, or give the spheres different names.",
                )
        for length in cell.lengths:
            lengths.setdefault(length.between, length)
    return spheres, list(lengths.values())


def _require_still_spheres(views: Sequence[SphereView], sessions: Sequence[Session], spheres: Mapping[str, Sphere]) -> None:
    """Refuse a sphere that was moved between two sessions without a new name: no fit of all its views means anything."""
    first_place: dict[str, FloatArray] = {}
    for session in sessions:
        for name, sphere in spheres.items():
            starts = [view.start_in_base_mm for view in views if view.sphere == name and view.session == session.digest]
            if not starts:
                continue
            place = np.median(starts, axis=0)
            moved_mm = float(np.linalg.norm(place - first_place.setdefault(name, place)))
            if moved_mm > sphere.radius_mm:
                raise DataError(
                    f"sphere {name} stands {moved_mm:.0f} mm from where an earlier session shows it",
                    file=session.folder,
                    remedy="Verify the sessions apart, or give a moved sphere a name of its own.",
                )


def _figures_before(
    observations: Observations, sessions: Sequence[Session], cells: Sequence[Cell], spheres: Mapping[str, Sphere], *, line_profile: bool
) -> Figures | None:
    """The same shots by the nominal robot and the first guess of the hand-eye."""
    guess = {session.digest: cell.flange_from_camera for session, cell in zip(sessions, cells, strict=True)}
    if any(transform is None for transform in guess.values()):
        return None

    def place(shot: SphereShot, points: FloatArray) -> FloatArray:
        base_from_camera = nominal_base_from_camera(None, guess[shot.session], None, shot.base_from_flange)
        return points if base_from_camera is None else se3.apply(base_from_camera, points)

    sizes = {name: SphereSize(sphere.radius_mm) for name, sphere in spheres.items()}
    return figures_of(views_of(observations.shots, place), sizes, line_profile=line_profile)


def _length(calibration: JudgedSystem, length: CertifiedLength, figures: Figures, observations: Observations) -> LengthResult:
    ends = [figures.spheres[name] for name in length.between]
    measured, scatter = separation(ends[0], ends[1])
    shots = [[shot for shot in observations.shots if shot.sphere == name] for name in length.between]
    # few views show little of their scatter by chance, and one shows none
    scatter = max(scatter, _repeatability_mm(calibration.noise, ends, shots))
    test = float(np.hypot(scatter, length.standard_uncertainty_mm))
    predicted = distance_standard_uncertainty_mm(calibration, End(ends[0].centre_in_base_mm, shots[0]), End(ends[1].centre_in_base_mm, shots[1]))
    total = float(np.hypot(test, predicted))
    return LengthResult(length.between, measured, length.length_mm, 2.0 * total, test, _why_not_judged(ends, shots))


def _repeatability_mm(noise: NoiseModel, ends: Sequence[SphereFigures], shots: Sequence[Sequence[SphereShot]]) -> float:
    """Standard uncertainty of a length from the pose noise that the calibration found, each view's share averaged."""
    variance = 0.0
    for end, members in zip(ends, shots, strict=True):
        levers = [np.linalg.norm(end.centre_in_base_mm - shot.base_from_flange[:3, 3]) for shot in members]
        variance += float(noise.pose_mm**2 + noise.pose_rad**2 * np.mean(np.square(levers))) / len(members)
    return float(np.sqrt(variance))


def _why_not_judged(ends: Sequence[SphereFigures], shots: Sequence[Sequence[SphereShot]]) -> str | None:
    if any(end.n_views < _LEAST_VIEWS for end in ends):
        return f"an end with fewer than {_LEAST_VIEWS} views shows no scatter"
    if _same_poses(shots[0], shots[1]) or _same_poses(shots[1], shots[0]):
        return "both ends were seen from the same robot poses, which cannot show an error of robot or hand-eye"
    return None


def _same_poses(first: Sequence[SphereShot], second: Sequence[SphereShot]) -> bool:
    """Whether most shots of one end repeat a flange pose of the other."""
    poses = np.stack([shot.base_from_flange for shot in second])
    repeated = [bool(_near(shot.base_from_flange, poses).any()) for shot in first]
    return float(np.mean(repeated)) > 0.5


def _near(pose: FloatArray, others: FloatArray) -> FloatArray:
    step = np.linalg.norm(others[:, :3, 3] - pose[:3, 3], axis=1)
    turn = np.linalg.norm(se3.log_so3(np.swapaxes(others[:, :3, :3], -1, -2) @ pose[:3, :3]), axis=1)
    return np.asarray((step < _SAME_POSE_MM) & (turn < _SAME_POSE_RAD))


def _length_errors(figures: Figures, lengths: Sequence[CertifiedLength]) -> dict[str, float]:
    known = [length for length in lengths if set(length.between) <= set(figures.spheres)]
    return {"-".join(x.between): separation(figures.spheres[x.between[0]], figures.spheres[x.between[1]])[0] - x.length_mm for x in known}


def _judgements(limits: Limits, figures: Figures, lengths: Sequence[LengthResult], spheres: Mapping[str, Sphere]) -> tuple[Judgement, ...]:
    found: list[Judgement] = []
    if figures.centre_rms_mm is not None:
        freedom = 3 * sum(s.n_views - 1 for s in figures.spheres.values())
        found.append(judge("centre rms", figures.centre_rms_mm, limits.centre_rms_mm, figures.centre_rms_mm / np.sqrt(2 * freedom)))
    for length in lengths:
        if length.not_judged is None:
            found.append(judge(f"length {length.label}", length.error_mm, limits.length_error_mm, length.test_standard_uncertainty_mm))
    for name, sphere in figures.spheres.items():
        certificate = spheres[name].expanded_uncertainty_mm / 2
        u = float(np.hypot(sphere.diameter_standard_uncertainty_mm, certificate))
        found.append(judge(f"diameter of sphere {name}", sphere.diameter_error_mm, limits.diameter_error_mm, u))
        found.append(judge(f"form of sphere {name}", sphere.form_mm, limits.form_mm, (spheres[name].form_mm or 0.0) / 2))
    return tuple(found)


def _gaps(limits: Limits | None, figures: Figures, lengths: Sequence[LengthResult], *, line_profile: bool, trained: bool) -> list[str]:
    """What keeps a verdict from being `conform` whatever the figures say."""
    gaps = ["shots of the calibration itself were used: the figures flatter"] if trained else []
    if limits is None:
        gaps.append("no limits given")
    if figures.centre_rms_mm is None and not line_profile:
        gaps.append("no sphere was seen twice: the scatter of centres is unknown")
    gaps += [f"length {length.label} not judged: {length.not_judged}" for length in lengths if length.not_judged]
    if not lengths:
        gaps.append("no certified length was measured: scale and shape of the base are not tested")
    return gaps


def _flattering(trained: Sequence[tuple[Session, int]]) -> DataError:
    session, index = trained[0]
    return DataError(
        f"{len(trained)} shots are those that the calibration was made from, so they prove nothing",
        file=session.folder,
        where=f"shot {index}",
        remedy="Verify on other shots; --allow-training-data shows the figures with that remark.",
    )
