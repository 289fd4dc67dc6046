"""Lengths between external reference points: the robot's length error where no sphere was seen.

A tracker's own frame drops out of a distance, so these lengths hold whether or not it stands where it stood for the
calibration. Points are paired from the longest distance downwards, each point once: no two lengths share the noise of a
stop, and the order of the points changes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibrate.external import external_sigma_mm
from calibrate.external_points import ExternalShot
from calibrate.external_result import ExternalResult
from calibrate.result import Calibration
from drivers.kinematics import mdh, se3
from drivers.kinematics.se3 import FloatArray
from measure.placing import MeasuringSystem
from measure.proof.external import PlacedTarget, known_external, noise_mm2, placed_target
from measure.proof.lengths import LengthResult

LEAST_POINTS = 10
"""Fewer points are told to prove nothing: their five lengths reach no part of a work volume."""
_SAME_STOP_RAD = 1e-3
_SAME_PLACE_MM = 20.0


def external_lengths(calibration: MeasuringSystem, shots: Sequence[ExternalShot]) -> tuple[LengthResult, ...]:
    """Lengths between points whose target the calibration knows, the longest first; measured by the robot, certified by the reference."""
    known = known_external(calibration)
    if known is None or not isinstance(calibration, Calibration):
        return ()
    found = [
        _length(calibration, known, (first, second), (placed_target(calibration, first), placed_target(calibration, second)), names)
        for names, first, second in _ends(known, shots)
    ]
    return tuple(sorted(found, key=lambda length: (-length.reference_mm, length.label)))


def nominal_length_errors_mm(calibration: MeasuringSystem, shots: Sequence[ExternalShot]) -> dict[str, float]:
    """The same lengths by the nominal robot, with the target where the calibration has it on the flange: error by label."""
    known, model = known_external(calibration), calibration.model
    if known is None or model is None:
        return {}

    def seen_mm(shot: ExternalShot) -> FloatArray:
        return se3.apply(mdh.base_from_flange(model, shot.joints_rad), known.targets[shot.target].point_in_flange_mm)

    return {
        "-".join(names): float(np.linalg.norm(seen_mm(second) - seen_mm(first)) - _reference_mm(first, second))
        for names, first, second in _ends(known, shots)
    }


def _ends(known: ExternalResult, shots: Sequence[ExternalShot]) -> list[tuple[tuple[str, str], ExternalShot, ExternalShot]]:
    """Names and points of every length; a tracker stands still within a session."""
    usable = sorted((shot for shot in shots if shot.target in known.targets), key=lambda shot: shot.key)
    names, found = _names(usable), []
    for group in dict.fromkeys((shot.session, shot.reference) for shot in usable):
        members = [i for i, shot in enumerate(usable) if (shot.session, shot.reference) == group]
        found += [((names[i], names[j]), usable[i], usable[j]) for i, j in _pairs(usable, members)]
    return found


def _reference_mm(first: ExternalShot, second: ExternalShot) -> float:
    return float(np.linalg.norm(second.point_in_reference_mm - first.point_in_reference_mm))


def external_gaps(calibration: MeasuringSystem, shots: Sequence[ExternalShot]) -> list[str]:
    """What points alone leave unproven, in sentences."""
    gaps = []
    if len(shots) < LEAST_POINTS:
        gaps.append(f"{len(shots)} external points are fewer than the {LEAST_POINTS} that lengths over a volume need")
    if isinstance(calibration, Calibration) and calibration.shots:
        gaps.append("no shot shows a sphere: camera and hand-eye are not tested, external points judge the robot alone")
    return gaps


def _pairs(shots: Sequence[ExternalShot], members: Sequence[int]) -> list[tuple[int, int]]:
    """Greedily the longest distance between points that no pair holds yet, at different stops of the robot."""
    points = np.array([shots[i].point_in_reference_mm for i in members])
    joints = np.array([shots[i].joints_rad for i in members])
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    same_stop = np.abs(joints[:, None] - joints[None]).max(axis=-1) < _SAME_STOP_RAD
    distance[same_stop | (np.tri(len(members)) > 0)] = 0.0
    order: NDArray[np.intp] = np.argsort(-distance, axis=None, kind="stable")
    free, found = np.ones(len(members), dtype=bool), []
    for flat in order.tolist():
        i, j = divmod(flat, len(members))
        if distance[i, j] <= _SAME_PLACE_MM:
            break
        if free[i] and free[j]:
            free[[i, j]] = False
            found.append((members[i], members[j]))
    return found


def _length(
    calibration: Calibration,
    known: ExternalResult,
    shots: tuple[ExternalShot, ExternalShot],
    placed: tuple[PlacedTarget, PlacedTarget],
    names: tuple[str, str],
) -> LengthResult:
    way = placed[1].seen_mm - placed[0].seen_mm
    direction = way / np.linalg.norm(way)
    gradient = direction @ (placed[1].motion - placed[0].motion)
    predicted = float(gradient @ calibration.covariance @ gradient)
    test = sum(float(direction @ noise_mm2(calibration, place.lever_mm) @ direction) for place in placed)
    reference = 2.0 * external_sigma_mm(calibration.noise) ** 2
    return LengthResult(
        between=names,
        measured_mm=float(np.linalg.norm(way)),
        reference_mm=_reference_mm(*shots),
        reference_standard_uncertainty_mm=float(np.sqrt(reference)),
        repeat_standard_uncertainty_mm=float(np.sqrt(max(test - reference, 0.0))),
        calibration_standard_uncertainty_mm=float(np.sqrt(max(predicted, 0.0))),
        unseen_places=all(_is_unseen(known, shot) for shot in shots),
    )


def _is_unseen(known: ExternalResult, shot: ExternalShot) -> bool:
    used = [point.point_in_reference_mm for point in known.shots if (point.reference, point.target) == (shot.reference, shot.target)]
    return all(float(np.linalg.norm(point - shot.point_in_reference_mm)) > _SAME_PLACE_MM for point in used)


def _names(shots: Sequence[ExternalShot]) -> list[str]:
    several = len({shot.session for shot in shots}) > 1
    return [f"{shot.target} {shot.index}{f' of {shot.session[:6]}' if several else ''}" for shot in shots]
