"""From a calibration and the shots at hand to the `Scene` of a recording."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from acquire.cell import Cell
from calibrate.observations import SphereShot
from calibrate.result import Calibration
from drivers.files.session import Session, read_scan
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.placing import nominal_base_from_camera, pose_of
from measure.report_text import mm
from measure.scene import Scene, SphereCloud, SphereMark, Step
from measure.sphere_figures import Figures, SphereSize, ViewFigures, figures_of
from measure.stitch import scans_once
from measure.verify import calibrated_placing, views_of
from measure.verify_result import VerifyResult

_WORKPIECE_POINTS = 20_000
_DEFAULT_VIEW_DEG = (40.0, 30.0)
_DEFAULT_DEPTH_MM = 350.0
_NEAREST_MM = 50.0


@dataclass(frozen=True, slots=True, eq=False)
class _Shots:
    """Shots with the figures of both systems; `before` is None where there is no first guess."""

    shots: tuple[SphereShot, ...]
    guess: FloatArray | None
    after: Figures
    before: Figures | None

    def in_base_before_mm(self, shot: SphereShot, points: FloatArray) -> FloatArray:
        base_from_camera = nominal_base_from_camera(None, self.guess, None, shot.base_from_flange)
        return np.empty((0, 3)) if base_from_camera is None else se3.apply(base_from_camera, points)


def scene_of(
    calibration: Calibration,
    cell: Cell,
    shots: Sequence[SphereShot],
    *,
    verification: VerifyResult | None = None,
    workpiece: Session | None = None,
    stitched_in_base_mm: FloatArray | None = None,
) -> Scene:
    """The robot, camera and clouds of every shot before and after, the spheres, residual curves and texts.

    Args:
        calibration: what moves points to the base.
        cell: its first guess of the hand-eye is the "before"; field of view and spheres.
        shots: sphere shots to show, e.g. of the calibration (`gather_observations(...).shots`).
        verification: its shots follow, and its figures are told.
        workpiece: its scans follow.
        stitched_in_base_mm: (n, 3) the fused workpiece.

    Raises:
        DataError: a shot lacks the pose that the calibration needs, or points fix no sphere.
        FileError: a workpiece scan is broken.
    """
    groups = [_figures(calibration, cell, tuple(shots))] if shots else []
    if verification is not None:
        groups.append(_figures(calibration, cell, verification.observations.shots))
    steps = [step for group in groups for step in _sphere_steps(calibration, group)]
    if workpiece is not None:
        steps += _workpiece_steps(calibration, cell, workpiece)
    depths = [float(np.median(shot.points_in_camera_mm[:, 2])) for group in groups for shot in group.shots]
    is_area = cell.camera.kind == "area"
    return Scene(
        title=f"spherecal: {calibration.cell_name}",
        steps=tuple(steps),
        spheres=tuple(_marks_of_all(calibration, groups)),
        texts={"summary": _summary(calibration, verification), "how to read this": _HELP},
        shape=() if calibration.model is None else calibration.model.shape,
        field_of_view_deg=(cell.camera.field_of_view_deg or _DEFAULT_VIEW_DEG) if is_area else None,
        depth_mm=max(float(np.median(depths)), _NEAREST_MM) if depths else _DEFAULT_DEPTH_MM,
        stitched_in_base_mm=stitched_in_base_mm,
    )


def _figures(calibration: Calibration, cell: Cell, shots: tuple[SphereShot, ...]) -> _Shots:
    line_profile = cell.camera.kind == "line_profile"
    radii = {shot.sphere: shot.radius_mm for shot in shots}
    sizes = {name: SphereSize(radius, calibration.radius_offset_mm) for name, radius in radii.items()}
    after = figures_of(views_of(shots, calibrated_placing(calibration)), sizes, line_profile=line_profile)
    bare = _Shots(shots, cell.flange_from_camera, after, None)
    if cell.flange_from_camera is None:
        return bare
    before = figures_of(
        views_of(shots, bare.in_base_before_mm), {name: SphereSize(radius) for name, radius in radii.items()}, line_profile=line_profile
    )
    return _Shots(shots, cell.flange_from_camera, after, before)


def _sphere_steps(calibration: Calibration, seen: _Shots) -> Iterator[Step]:
    after = {(v.session, v.index, v.sphere): v for v in seen.after.views}
    before = {} if seen.before is None else {(v.session, v.index, v.sphere): v for v in seen.before.views}
    for shot in seen.shots:
        key = (shot.session, shot.index, shot.sphere)
        yield _step(
            calibration,
            f"session {shot.session[:8]}, shot {shot.index}, sphere {shot.sphere}",
            pose_of(calibration.model, shot),
            seen.in_base_before_mm(shot, shot.points_in_camera_mm),
            shot.points_in_camera_mm,
            {**_curve("before", before.get(key)), **_curve("after", after.get(key))},
        )


def _curve(side: str, view: ViewFigures | None) -> dict[str, float]:
    if view is None:
        return {}
    if view.deviation_mm is None:
        return {f"{side}: radial rms": view.radial_rms_mm}
    return {f"{side}: distance of the centre": view.deviation_mm}


def _workpiece_steps(calibration: Calibration, cell: Cell, session: Session) -> Iterator[Step]:
    for shot in scans_once(session):
        points = read_scan(session, shot).points_mm.astype(np.float64)
        points = points[np.isfinite(points).all(axis=1)]
        points = points[:: max(1, -(-len(points) // _WORKPIECE_POINTS))]
        pose = {"base_from_flange": shot.base_from_flange} if calibration.model is None else {"joints_rad": shot.joints_rad}
        nominal = nominal_base_from_camera(calibration.model, cell.flange_from_camera, shot.joints_rad, shot.base_from_flange)
        before = np.empty((0, 3)) if nominal is None else se3.apply(nominal, points)
        yield _step(calibration, f"workpiece, shot {shot.index}", {k: v for k, v in pose.items() if v is not None}, before, points, {})


def _step(
    calibration: Calibration,
    label: str,
    pose: dict[str, FloatArray],
    before_mm: FloatArray,
    points_in_camera_mm: FloatArray,
    curves: dict[str, float],
) -> Step:
    links = _link_frames(calibration, pose)
    after = calibration.points_in_base_mm(points_in_camera_mm, **pose)
    return Step(label, links, links[-1] @ calibration.flange_from_camera, before_mm, after, curves)


def _link_frames(calibration: Calibration, pose: dict[str, FloatArray]) -> FloatArray:
    if calibration.model is None:
        return np.asarray(calibration.datum.base_from_solver @ pose["base_from_flange"])[None]
    return calibration.base_from_links(pose["joints_rad"])


def _marks_of_all(calibration: Calibration, groups: Sequence[_Shots]) -> Iterator[SphereMark]:
    """Spheres of the calibration, then those of the verification: a name may stand for another place there."""
    taken: set[str] = set()
    for group in groups:
        for mark in _marks(calibration, group):
            yield replace(mark, name=f"{mark.name} (verification)") if mark.name in taken else mark
        taken |= set(group.after.spheres)


def _marks(calibration: Calibration, seen: _Shots) -> Iterator[SphereMark]:
    place = calibrated_placing(calibration)
    for name, sphere in seen.after.spheres.items():
        own = [shot for shot in seen.shots if shot.sphere == name]
        radius = own[0].radius_mm
        after = _cloud((place(s, s.points_in_camera_mm) for s in own), sphere.centre_in_base_mm, radius + calibration.radius_offset_mm)
        before = None
        if seen.before is not None:
            clouds = (seen.in_base_before_mm(s, s.points_in_camera_mm) for s in own)
            before = _cloud(clouds, seen.before.spheres[name].centre_in_base_mm, radius)
        yield SphereMark(name, sphere.centre_in_base_mm, radius, before, after)


def _cloud(clouds: Iterable[FloatArray], centre_mm: FloatArray, radius_mm: float) -> SphereCloud:
    points = np.concatenate(list(clouds))
    return SphereCloud(points, np.linalg.norm(points - centre_mm, axis=1) - radius_mm)


_HELP = """# How to read this

* **cell**: the robot at one shot; drag the time slider below (timeline `pose`). Blue frame: what the camera sees. Orange points: the shot through
  the uncalibrated system; blue points: calibrated.
* **sphere …**: all shots of one sphere at once, left before and right after, on one colour scale: red lies outside the
  true sphere, blue inside, grey on it.
* **residuals**: one value a shot. Before and after, in mm.

Lengths are drawn in metres and named in mm.
"""


def _summary(calibration: Calibration, verification: VerifyResult | None) -> str:
    lines = [f"# {calibration.cell_name}", "", f"calibration **{calibration.verdict}**, `{calibration.id[:12]}`", ""]
    if verification is None:
        held_out = mm(calibration.statistics.cross_validated_rms_mm)
        return "\n".join([*lines, f"Left-out shots: {held_out} rms. Not verified yet.", *(f"* {reason}" for reason in calibration.reasons)])
    after, before = verification.figures, verification.before
    worst_after = max((abs(x.error_mm) for x in verification.lengths), default=None)
    worst_before = max((abs(x) for x in verification.before_length_errors_mm.values()), default=None)
    lines += [
        f"verification **{verification.verdict.replace('_', ' ')}** on {verification.used} unseen shots",
        "",
        "| | before | after |",
        "|---|---|---|",
        f"| centre rms | {mm(None if before is None else before.centre_rms_mm)} | {mm(after.centre_rms_mm)} |",
        f"| radial rms | {mm(None if before is None else before.radial_rms_mm)} | {mm(after.radial_rms_mm)} |",
        f"| largest length error | {mm(worst_before)} | {mm(worst_after)} |",
        "",
        *(f"* {reason}" for reason in verification.reasons),
    ]
    return "\n".join(lines)
