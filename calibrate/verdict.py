"""pass, marginal or fail, and why: what a calibration engineer would hold against it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acquire.cell import Limits
from calibrate.arm_branches import UnseenBranch
from calibrate.camera_misfit import CameraMisfit
from calibrate.identifiability import Identifiability

_MANY_REJECTED, _TOO_MANY_REJECTED = 0.1, 0.4
_LARGE_OFFSET_MM = 0.3
"""Three times what is believed of an optical radius: it is rather a wrong diameter."""
_SPREAD = "spread the sphere in depth and across the view, and turn the camera about more axes"


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the verdict is built on."""

    limits: Limits | None
    cross_validated_rms_mm: float
    length_expanded_uncertainty_mm: float | None
    """k = 2, of the least certain length over the work volume; where none is stated, between the farthest sphere places or about the only one."""
    n_shots: int
    used: int
    has_joints: bool
    has_certified_length: bool
    line_profile: bool
    covariance_scale: float
    length_place: str = "between sphere places"
    """Where that length is, in words."""
    external_rms_mm: float | None = None
    """Rms of held-out external points; None without any."""
    shortcomings: tuple[str, ...] = ()
    """What the shots are too few or too alike in, with what to do."""
    alike: tuple[str, ...] = ()
    """In what all shots are alike, where an area camera and the robot are calibrated."""
    held: bool = False
    """Whether the solve came to rest only with its unknowns held back."""
    radius_offset_mm: float = 0.0
    """By how much the spheres read larger in radius than certified."""
    ignores_lengths: bool = False
    """Whether the method takes no certified length, even where one was seen."""
    point_noise_mm: float = 0.0
    """Of one point along its normal."""
    camera_misfit: CameraMisfit | None = None
    """What the camera error model that was asked for leaves and another explains."""
    unseen_branch: UnseenBranch | None = None
    """The best known of the arm's other branches where all shots are of one."""


def judge(evidence: Evidence, identifiability: Identifiability) -> tuple[str, tuple[str, ...]]:
    """Verdict and its reasons, the gravest first."""
    fail = _grave(evidence, identifiability)
    marginal = _doubts(evidence)
    if fail:
        return "fail", tuple(fail + marginal)
    return ("marginal" if marginal else "pass"), tuple(marginal)


def wants_more_poses(evidence: Evidence, identifiability: Identifiability) -> bool:
    """Whether further poses would cure what is held against a calibration."""
    return identifiability.rank < identifiability.expected_rank or bool(evidence.alike) or _one_branch(evidence) or _unsure_length(evidence)


def _one_branch(e: Evidence) -> bool:
    return e.limits is not None and e.unseen_branch is not None and e.unseen_branch.expanded_uncertainty_mm > e.limits.length_error_mm


def _unsure_length(e: Evidence) -> bool:
    length = e.length_expanded_uncertainty_mm
    return e.limits is not None and length is not None and length > e.limits.length_error_mm


def _missed_mm(e: Evidence) -> float:
    """What held-out shots miss by: centres of an area camera; of profiles what is not noise of points, no more than a centre is off."""
    if not e.line_profile:
        return e.cross_validated_rms_mm
    return float(np.sqrt(max(0.0, e.cross_validated_rms_mm**2 - e.point_noise_mm**2)))


def _open(identifiability: Identifiability) -> str:
    named = [group.text.partition(":")[0] for group in identifiability.directions if group.kind == "open" and group.is_known]
    return f", among them the {' and the '.join(named)}" if named else ""


def _grave(e: Evidence, identifiability: Identifiability) -> list[str]:
    found = []
    missing = identifiability.expected_rank - identifiability.rank
    if missing > 0:
        found.append(
            f"the shots leave {missing} of {identifiability.expected_rank} directions open (rank {identifiability.rank}){_open(identifiability)}: "
            + "; ".join(e.shortcomings or (_SPREAD,))
        )
    elif e.alike:
        # points of a cap tell a little of everything, so that no direction counts as open; which camera model is true they do not tell
        found.append(f"robot, hand-eye and camera are hardly told apart: {'; '.join(e.alike)}")
    if _one_branch(e) and e.unseen_branch is not None and e.limits is not None:
        found.append(
            f"the shots hold the arm in one branch: measured with the {e.unseen_branch.text}, which the robot can, a place would be off by up to "
            f"U = {e.unseen_branch.expanded_uncertainty_mm:.3f} mm, above the limit of {e.limits.length_error_mm:g} mm: take a third of the shots so"
        )
    if e.held:
        found.append("the shots determine so little that the solve came to rest only with its unknowns held near the first guess")
    rejected = 1 - e.used / max(e.n_shots, 1)
    if rejected > _TOO_MANY_REJECTED:
        found.append(f"{e.n_shots - e.used} of {e.n_shots} shots were rejected")
    if e.limits is not None and _missed_mm(e) > e.limits.centre_rms_mm:
        what = "held-out profiles lie off their sphere, the noise of points taken out, by" if e.line_profile else "held-out shots are missed by"
        found.append(f"{what} {_missed_mm(e):.3f} mm rms, the limit is {e.limits.centre_rms_mm:g} mm")
    if e.limits is not None and e.external_rms_mm is not None and e.external_rms_mm > e.limits.centre_rms_mm:
        found.append(f"held-out external points are missed by {e.external_rms_mm:.3f} mm rms, the limit is {e.limits.centre_rms_mm:g} mm")
    return found


def _doubts(e: Evidence) -> list[str]:
    found = []
    if not e.has_joints:
        found.append(
            "the robot is taken as it reports: flange poses without axis angles leave its uncalibrated geometry in every figure "
            f"(held-out rms {e.cross_validated_rms_mm:.3f} mm)"
        )
    if e.limits is None:
        found.append("no limits given in the cell file: there is nothing to pass against")
    elif _unsure_length(e):
        length, limit = e.length_expanded_uncertainty_mm, e.limits.length_error_mm
        found.append(f"a length {e.length_place} has U = {length:.3f} mm, above the limit of {limit:g} mm")
    if e.has_joints and not e.has_certified_length:
        lacking = "the method stepwise uses no certified length" if e.ignores_lengths else "no certified length was seen"
        length, said = e.length_expanded_uncertainty_mm, _unsure_length(e)
        how_far = "" if length is None or said else f"; a length {e.length_place} has U = {length:.3f} mm"
        found.append(f"{lacking}: the scale over the volume rests on sphere diameters and depth alone{how_far}")
    if abs(e.radius_offset_mm) > _LARGE_OFFSET_MM:
        more = "larger" if e.radius_offset_mm > 0 else "smaller"
        found.append(f"the spheres read {abs(e.radius_offset_mm):.2f} mm {more} in radius than certified: check diameter_mm in the cell file")
    if _MANY_REJECTED < 1 - e.used / max(e.n_shots, 1) <= _TOO_MANY_REJECTED:
        found.append(f"{e.n_shots - e.used} of {e.n_shots} shots were rejected")
    if e.camera_misfit is not None:
        found.append(
            f"the camera error model asked for misses shots left out by {e.camera_misfit.rms_mm:.3f} mm, the model {e.camera_misfit.better} by "
            f"{e.camera_misfit.better_rms_mm:.3f} mm: uncertainties are widened for it; --camera-error auto needs no such widening"
        )
    elif e.has_joints and e.covariance_scale > 4.0:
        found.append(f"held-out shots miss by {np.sqrt(e.covariance_scale):.1f} times what the noise explains: something is not in the model")
    return found
