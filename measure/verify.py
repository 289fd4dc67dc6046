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
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from acquire.cell import Cell, CertifiedLength, Limits, Sphere, cell_of_session, robot_model_of
from calibrate.normal import NoiseModel
from calibrate.observations import Observations, SphereShot
from calibrate.second_look import see_sessions
from calibrate.temperature import artefact_when_seen, temperature_changes
from drivers.errors import DataError
from drivers.files.session import Session
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.decision import overall
from measure.length_uncertainty import diameter_standard_uncertainty_mm
from measure.placing import JudgedSystem, check_fits, nominal_base_from_camera, pose_of
from measure.proof.conditions import conditions_of
from measure.proof.external import external_figures, judgeable, known_external
from measure.proof.external_lengths import external_gaps, external_lengths, nominal_length_errors_mm
from measure.proof.judging import gaps_of, judgements, sphere_uncertainties
from measure.proof.lengths import length_results
from measure.proof.poses import repeated_poses, training_shots
from measure.proof.probing import ProbingResult, probing_of
from measure.proof.reach import external_outside, shots_outside, warnings_of
from measure.proof.residual_maps import residual_maps
from measure.proof.volume import volume_figures
from measure.sphere_figures import NO_FIGURES, Figures, SphereSize, SphereView, figures_of, separation
from measure.verify_result import SessionName, VerifyResult

Placing = Callable[[SphereShot, FloatArray], FloatArray]
"""Moves points (n, 3) of a shot from the camera to the base."""


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
        allow_training_data: take shots that the calibration was made from, and its poses; the verdict then is
            `not_proven` at best.

    Raises:
        DataError: no shot shows a sphere or a known external target; shots or poses of the calibration itself; sessions whose cells contradict
            each other.
        FileError: a session is broken.
    """
    began = time.perf_counter()
    cells = [cell or cell_of_session(session) for session in sessions]
    marks = [mark for session, its_cell in zip(sessions, cells, strict=True) for mark in check_fits(calibration, session, its_cell)]
    flattery = _flattery(calibration, sessions, allowed=allow_training_data)
    observations = _gather(calibration, sessions, cells)
    artefact = artefact_when_seen(*_merged(cells), sessions)
    found = verify_observations(
        calibration,
        observations,
        cells[0].model_copy(update={"spheres": artefact.spheres, "lengths": artefact.lengths}),
        limits=limits or next((c.limits for c in cells if c.limits is not None), None) or calibration.limits,
        flattery=flattery,
        folders={session.digest: session.folder for session in sessions},
    )
    before = _figures_before(observations, sessions, cells, artefact.spheres, line_profile=cells[0].camera.kind == "line_profile")
    lengths_before = {} if before is None else _length_errors(before, artefact.lengths)
    if found.of_points_alone:
        lengths_before = nominal_length_errors_mm(calibration, observations.external)
    return replace(
        found,
        sessions=tuple(SessionName(session.folder.name, session.digest) for session in sessions),
        before=before,
        before_length_errors_mm=lengths_before,
        reasons=(*found.reasons, *dict.fromkeys(marks), *artefact.notes, *temperature_changes(calibration.temperatures_c, sessions)),
        conditions=conditions_of(sessions, artefact.spheres, artefact.lengths),
        seconds=time.perf_counter() - began,
    )


def verify_observations(
    calibration: JudgedSystem,
    observations: Observations,
    cell: Cell,
    *,
    limits: Limits | None,
    flattery: Sequence[str] = (),
    folders: Mapping[str, Path] = MappingProxyType({}),
) -> VerifyResult:
    """The same on shots that are in memory already, without the uncalibrated system beside it.

    Args:
        calibration: the calibration to judge.
        observations: with at least one shot or external point. Points judge where there is no sphere; beside spheres they are told.
        cell: spheres and lengths as large as they were when seen.
        limits: what to judge against; None for none.
        flattery: what training data are among the shots, in sentences; the verdict then is `not_proven` at best.
        folders: of the sessions by their digest, for messages.

    Raises:
        DataError: points that do not fix a sphere; a sphere that stands elsewhere in another session.
    """
    line_profile = cell.camera.kind == "line_profile"
    sizes = {name: SphereSize(s.radius_mm, calibration.radius_offset_mm) for name, s in cell.spheres.items()}
    views = views_of(observations.shots, calibrated_placing(calibration), calibration.noise)
    _require_still_spheres(views, cell.spheres, folders)
    figures = figures_of(views, sizes, line_profile=line_profile) if views else NO_FIGURES
    lengths = (
        length_results(calibration, cell.lengths, figures, observations.shots) if views else external_lengths(calibration, observations.external)
    )
    volume = volume_figures(lengths, cell.work_volume_box_mm)
    outside = (*shots_outside(calibration, observations.shots), *external_outside(calibration, observations.external))
    by_sphere = {name: [shot for shot in observations.shots if shot.sphere == name] for name in figures.spheres}
    of_diameters = {n: diameter_standard_uncertainty_mm(calibration, s.centre_in_base_mm, by_sphere[n]) for n, s in figures.spheres.items()}
    judged = () if limits is None else judgements(limits, figures, lengths, cell.spheres)
    external = external_figures(calibration, observations.external)
    more = [*(() if volume is None else volume.gaps()), *(() if views else external_gaps(calibration, observations.external))]
    verdict, reasons = overall(judged, [*gaps_of(limits, figures, lengths, line_profile=line_profile, flattery=flattery), *more])
    return VerifyResult(
        calibration_id=calibration.id,
        sessions=(),
        observations=observations,
        figures=figures,
        before=None,
        lengths=lengths,
        before_length_errors_mm={},
        limits=limits,
        judgements=judged,
        verdict=verdict,
        reasons=reasons,
        held_out=not flattery,
        seconds=0.0,
        probing=() if line_profile else probing_of_views(views, figures, sizes),
        volume=volume,
        outside=outside,
        warnings=(
            *warnings_of(outside, len(observations.shots) + len(observations.external)),
            *(() if volume is None else volume.warnings()),
            *(() if external is None else external.warnings()),
        ),
        external=external,
        sphere_uncertainties=sphere_uncertainties(figures.spheres, cell.spheres, of_diameters),
        maps=residual_maps(observations.shots, views, figures, sizes) if views else None,
    )


def calibrated_placing(calibration: JudgedSystem) -> Placing:
    """Points of a shot through a calibration."""

    def place(shot: SphereShot, points: FloatArray) -> FloatArray:
        return calibration.points_in_base_mm(points, **pose_of(calibration.model, shot))

    return place


def views_of(shots: Sequence[SphereShot], place: Placing, noise: NoiseModel | None = None) -> list[SphereView]:
    """Shots as views in the base; `noise` says by how much each may stand elsewhere."""
    found = []
    for shot in shots:
        start = place(shot, _behind_surface(shot)[None])[0]
        moves = None if noise is None else _pose_covariance_mm2(noise, start - shot.base_from_flange[:3, 3])
        found.append(SphereView(shot.session, shot.index, shot.sphere, place(shot, shot.points_in_camera_mm), start, moves))
    return found


def _pose_covariance_mm2(noise: NoiseModel, lever_mm: FloatArray) -> FloatArray:
    """(3, 3) motion of a point at a lever (3,) from the flange, base axes: `NoiseModel` is isotropic at the flange."""
    lever = se3.hat(lever_mm)
    return np.asarray(noise.pose_mm**2 * np.eye(3) + noise.pose_rad**2 * lever @ lever.T)


def probing_of_views(views: Sequence[SphereView], figures: Figures, sizes: Mapping[str, SphereSize]) -> tuple[ProbingResult, ...]:
    """Probing error of every view by itself, and of every sphere over all its views."""
    found = []
    for name, sphere in figures.spheres.items():
        members, radius = [view for view in views if view.sphere == name], sizes[name].radius_mm
        together = probing_of(np.concatenate([view.points_in_base_mm for view in members]), radius, sphere.centre_in_base_mm)
        found.append(ProbingResult(name, None, None, together))
        found += [
            ProbingResult(name, view.session, view.index, probing_of(view.points_in_base_mm, radius, view.start_in_base_mm)) for view in members
        ]
    return tuple(found)


def _behind_surface(shot: SphereShot) -> FloatArray:
    if shot.centre_in_camera_mm is not None:
        return shot.centre_in_camera_mm
    mean = shot.points_in_camera_mm.mean(axis=0)
    return np.asarray(mean + 0.7 * shot.radius_mm * mean / np.linalg.norm(mean))


def _flattery(calibration: JudgedSystem, sessions: Sequence[Session], *, allowed: bool) -> list[str]:
    """What of the calibration's own is among the shots; DataError where that is not allowed."""
    told = []
    external = known_external(calibration)
    points = () if external is None else external.shots
    scans, poses = training_shots(calibration.shots, sessions, points), repeated_poses(calibration.shots, sessions, points)
    if scans and not allowed:
        raise _refused(f"{len(scans)} shots are those that the calibration was made from, so they prove nothing", scans[0])
    if poses and not allowed:
        raise _refused(f"{len(poses)} shots repeat robot poses of the calibration, which fits its own poses best: they prove nothing", poses[0])
    if scans:
        told.append("shots of the calibration itself were used: the figures flatter")
    if len(poses) > len(scans):
        told.append(f"{len(poses)} shots repeat robot poses of the calibration: the figures flatter")
    return told


def _refused(message: str, where: tuple[Session, int]) -> DataError:
    session, index = where
    return DataError(
        message,
        file=session.folder,
        where=f"shot {index}",
        remedy="Verify on other shots from other poses (`spherecal plan --for verify`); --allow-training-data shows the figures with that remark.",
    )


def _gather(calibration: JudgedSystem, sessions: Sequence[Session], cells: Sequence[Cell]) -> Observations:
    parts = [see_sessions([s], cell=c, model=robot_model_of(c, s)) for s, c in zip(sessions, cells, strict=True)]
    shots = sorted((shot for part in parts for shot in part.shots), key=lambda shot: shot.key)
    external = [shot for part in parts for shot in part.external]
    judged, not_judged = judgeable(calibration, external)
    rejected = (*(shot for part in parts for shot in part.rejected), *not_judged)
    if not shots and not judged:
        why = f"; the first refusal was: {rejected[0].reason}" if rejected else ""
        raise DataError(
            f"none of {len(rejected)} shots shows a sphere or a known target{why}", file=sessions[0].folder, remedy="Capture shots of the spheres."
        )
    return Observations(tuple(shots), rejected, judged)


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


def _require_still_spheres(views: Sequence[SphereView], spheres: Mapping[str, Sphere], folders: Mapping[str, Path]) -> None:
    """Refuse a sphere that was moved between two sessions without a new name: no fit of all its views means anything."""
    first_place: dict[str, FloatArray] = {}
    for session in dict.fromkeys((*folders, *(view.session for view in views))):
        for name, sphere in spheres.items():
            starts = [view.start_in_base_mm for view in views if view.sphere == name and view.session == session]
            if not starts:
                continue
            place = np.median(starts, axis=0)
            moved_mm = float(np.linalg.norm(place - first_place.setdefault(name, place)))
            if moved_mm > sphere.radius_mm:
                raise DataError(
                    f"sphere {name} stands {moved_mm:.0f} mm from where an earlier session shows it",
                    file=folders.get(session),
                    remedy="Verify the sessions apart, or give a moved sphere a name of its own.",
                )


def _figures_before(
    observations: Observations, sessions: Sequence[Session], cells: Sequence[Cell], spheres: Mapping[str, Sphere], *, line_profile: bool
) -> Figures | None:
    """The same shots by the nominal robot and the first guess of the hand-eye."""
    guess = {session.digest: cell.flange_from_camera for session, cell in zip(sessions, cells, strict=True)}
    if not observations.shots or any(transform is None for transform in guess.values()):
        return None

    def place(shot: SphereShot, points: FloatArray) -> FloatArray:
        base_from_camera = nominal_base_from_camera(None, guess[shot.session], None, shot.base_from_flange)
        return points if base_from_camera is None else se3.apply(base_from_camera, points)

    sizes = {name: SphereSize(sphere.radius_mm) for name, sphere in spheres.items()}
    return figures_of(views_of(observations.shots, place), sizes, line_profile=line_profile)


def _length_errors(figures: Figures, lengths: Sequence[CertifiedLength]) -> dict[str, float]:
    known = [length for length in lengths if set(length.between) <= set(figures.spheres)]
    return {"-".join(x.between): separation(figures.spheres[x.between[0]], figures.spheres[x.between[1]])[0] - x.length_mm for x in known}
