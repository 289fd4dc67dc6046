"""From a solve to its result: datum, covariance, statistics, verdict."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from acquire.cell import Cell
from acquire.plan import PlannedPose
from calibrate.arm_branches import unseen_branch
from calibrate.assemble import Assembled
from calibrate.budget import ErrorBudget, error_budget
from calibrate.camera_field import seen_cells
from calibrate.clouds import Solution
from calibrate.datum import controller_datum
from calibrate.datum_choice import DatumChoice, stated_datum, without_axes
from calibrate.datum_poses import datum_joints, datum_references
from calibrate.design_cell import work_box_mm
from calibrate.design_shots import Expectation
from calibrate.external_result import external_names, external_result
from calibrate.external_solve import predicted_rms_mm, rms_mm
from calibrate.identifiability import identifiability_of, parameter_names
from calibrate.next_poses import Taken, alike, next_best_poses, pose_text, shortcomings
from calibrate.observations import RejectedShot
from calibrate.problem import Problem
from calibrate.provenance import identity_of, inputs_of
from calibrate.rejection import unexplained
from calibrate.result import Calibration
from calibrate.result_file import calibration_data
from calibrate.result_parts import ShotResult, Statistics
from calibrate.sources import artefact_covariance
from calibrate.temperature import temperature_ranges_c
from calibrate.validation import Prediction, predict, shot_centre_covariance_mm2
from calibrate.verdict import Evidence, judge, wants_more_poses
from calibrate.volume_lengths import volume_length_uncertainty_mm
from drivers.files.session import Session
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from calibrate.solve import Solved


def make_result(
    solved: Solved,
    *,
    method: str,
    cell: Cell,
    sessions: Sequence[Session],
    n_shots: int,
    notes: tuple[str, ...],
    compared: Mapping[str, float],
    rejected: tuple[RejectedShot, ...],
    created_utc: str,
    software: str,
    began: float,
    like: DatumChoice | None = None,
) -> Calibration:
    """The calibration of a solve, with everything that a file must hold; in the base of an earlier one where `like` names it."""
    assembled, solution, problem = solved.assembled, solved.solution, solved.assembled.problem
    state = solution.state
    has_joints = problem.model is not None and problem.joints_rad is not None
    joints, used = _all_joints(problem), problem.n_shots + (0 if problem.external is None else problem.external.n_shots)
    trained = predict(problem, state)
    line_profile = not problem.along_sight
    held_out_rms = solved.held_out.radial_rms_mm if line_profile else solved.held_out.centre_rms_mm
    predicted_rms = None if line_profile else _predicted_centre_rms(assembled, solution)
    scale = _arcs_scale(problem, solution) if predicted_rms is None else max(1.0, (held_out_rms / predicted_rms) ** 2)
    external_rms, external_predicted = rms_mm(solved.external_held_out_mm), predicted_rms_mm(solution)
    if np.isfinite(external_rms):
        scale = max(scale, (external_rms / external_predicted) ** 2)
    if solved.misfit is not None:
        scale *= solved.misfit.covariance_factor(_spread_mm2(problem, solution))
    identifiability = identifiability_of(problem, solution)
    names = assembled.sphere_names
    covariance = solution.covariance * scale
    datum = controller_datum()
    if problem.model is not None and joints is not None:
        over = datum_references(cell, problem.model, state.flange_from_camera, state.centres_in_base_mm, joints)
        datum = stated_datum(like, problem, state, names, covariance, over)
    elif like is not None:
        raise without_axes()
    result = Calibration(
        id="",
        method=method,
        model=problem.model if has_joints else None,
        link_twists=state.link_twists,
        terms=problem.terms,
        terms_rad=state.terms_rad,
        flange_from_camera=state.flange_from_camera,
        camera_error=problem.camera_error,
        camera_mm=state.camera_mm,
        camera_seen_volume_mm=np.array([problem.points_in_camera_mm.min(axis=0), problem.points_in_camera_mm.max(axis=0)]),
        radius_offset_mm=state.radius_offset_mm,
        sphere_centres_in_base_mm={name: se3.apply(datum.base_from_solver, c) for name, c in zip(names, state.centres_in_base_mm, strict=True)},
        sphere_radius_offsets_mm={name: state.radius_offset_mm + float(d) for name, d in zip(names, state.sphere_radius_deviation_mm, strict=True)},
        datum=datum,
        seen_joints_rad=None if joints is None else np.array([joints.min(axis=0), joints.max(axis=0)]),
        noise=solution.noise,
        parameter_names=parameter_names(problem.layout, problem.terms, names) + external_names(problem.external),
        covariance=covariance,
        statistics=Statistics(
            n_shots=n_shots,
            used=used,
            rank=identifiability.rank,
            n_parameters=identifiability.n_parameters,
            condition=identifiability.condition,
            train_rms_mm=trained.radial_rms_mm,
            cross_validated_rms_mm=held_out_rms,
            predicted_centre_rms_mm=predicted_rms,
            covariance_scale=scale,
            passes=solution.passes,
            seconds=time.perf_counter() - began,
            compared=compared,
        ),
        limits=cell.limits,
        verdict="",
        reasons=(),
        shots=_shot_results(assembled, solution, trained, solved.held_out, datum.base_from_solver),
        rejected=rejected,
        cell_name=cell.name,
        inputs=inputs_of(cell, sessions),
        identity=identity_of(cell, sessions),
        created_utc=created_utc,
        software=software,
        temperatures_c=temperature_ranges_c(sessions),
        external=external_result(problem, state, datum, covariance, solved.external_held_out_mm, external_predicted),
        identifiability=identifiability,
        seen_cells=seen_cells(problem.points_in_camera_mm) if len(problem.points_in_camera_mm) else None,
    )
    evidence = Evidence(
        limits=cell.limits,
        cross_validated_rms_mm=held_out_rms,
        length_expanded_uncertainty_mm=_length_uncertainty(result, cell, assembled, solution),
        length_place=_length_place(assembled, cell, result),
        n_shots=n_shots,
        used=used,
        has_joints=has_joints,
        # a laser tracker's points are lengths in themselves
        has_certified_length=bool(problem.lengths) or bool(np.isfinite(external_rms)),
        held=solution.held,
        radius_offset_mm=solution.state.radius_offset_mm,
        ignores_lengths=method == "stepwise",
        line_profile=line_profile,
        point_noise_mm=solution.noise.point_mm,
        covariance_scale=scale,
        external_rms_mm=external_rms if np.isfinite(external_rms) else None,
        shortcomings=shortcomings(problem, solution, identifiability.expected_rank),
        alike=alike(problem, solution) if has_joints and not line_profile and problem.n_shots else (),
        unseen_branch=unseen_branch(problem, solution, covariance),
        camera_misfit=solved.misfit,
    )
    verdict, reasons = judge(evidence, identifiability)
    next_poses = _next_poses(cell, assembled, solution) if wants_more_poses(evidence, identifiability) else ()
    if next_poses:
        reasons += (f"next best poses: {'; '.join(map(pose_text, next_poses))}",)
    budget = _budget(result, cell, assembled, solution, scale)
    result = replace(result, verdict=verdict, reasons=reasons + notes, next_best_poses=next_poses, error_budget=budget)
    return replace(result, id=str(calibration_data(result)["id"]))


def _arcs_scale(problem: Problem, solution: Solution) -> float:
    """By how much the misses of profiles, each judged by the others, have more variance than what is known of explains."""
    found = unexplained(problem, solution)
    return max(1.0, float(found.chi2.sum() / found.directions.sum()))


def _all_joints(problem: Problem) -> FloatArray | None:
    """(k, n) axis angles of spheres and external points; None for pose-only data."""
    if problem.joints_rad is None:
        return None
    return problem.joints_rad if problem.external is None else np.concatenate([problem.joints_rad, problem.external.joints_rad])


def _budget(result: Calibration, cell: Cell, assembled: Assembled, solution: Solution, scale: float) -> ErrorBudget | None:
    if not result.shots:
        return None
    centres = np.array([result.sphere_centres_in_base_mm[name] for name in assembled.sphere_names])
    region = "around the spheres" if cell.work_volume_mm is None else "work volume"
    artefact, joints = scale * artefact_covariance(solution), assembled.problem.joints_rad
    return error_budget(result, work_box_mm(cell, centres), region, artefact=artefact, joints_rad=joints)


def _next_poses(cell: Cell, assembled: Assembled, solution: Solution) -> tuple[PlannedPose, ...]:
    problem, state = assembled.problem, solution.state
    if problem.model is None or problem.joints_rad is None or not problem.n_shots:
        return ()
    if solution.held and cell.flange_from_camera is None:
        return ()  # nobody knows where the camera looks
    taken = Taken(
        joints_rad=problem.joints_rad,
        sphere=problem.sphere,
        names=assembled.sphere_names,
        centres_in_base_mm=state.centres_in_base_mm,
        flange_from_camera=state.flange_from_camera,
        expectation=Expectation(noise=solution.noise, n_points=int(np.median(np.diff(problem.starts))), priors=problem.priors),
    )
    return next_best_poses(cell, problem.model, taken)


def _predicted_centre_rms(assembled: Assembled, solution: Solution) -> float:
    """First-order rms of the distance between a shot's own centre and its sphere's: parameters, pose noise and points."""
    problem = assembled.problem
    covariance, sensitivity = shot_centre_covariance_mm2(problem, solution)
    spread = sensitivity @ solution.covariance @ np.swapaxes(sensitivity, -1, -2)
    return float(np.sqrt(np.trace(covariance + spread, axis1=1, axis2=2).mean()))


def _spread_mm2(problem: Problem, solution: Solution) -> float:
    """Variance of a shot's centre, all axes together, that the unknowns' own brings about; mean over the shots."""
    _, sensitivity = shot_centre_covariance_mm2(problem, solution)
    return float(np.einsum("mip,pq,miq->m", sensitivity, solution.covariance, sensitivity, optimize=True).mean())


def _length_place(assembled: Assembled, cell: Cell, result: Calibration) -> str:
    """Where the length is that `_length_uncertainty` tells of."""
    if result.model is not None and cell.work_volume_mm is not None:
        return "over the work volume"
    return "between sphere places" if len(assembled.sphere_names) > 1 else "about the only sphere place"


def _length_uncertainty(result: Calibration, cell: Cell, assembled: Assembled, solution: Solution) -> float | None:
    """Expanded uncertainty (k = 2) of the least certain length over the work volume; without one, between sphere places or about the only one."""
    n_spheres, used_rad = len(assembled.sphere_names), _all_joints(assembled.problem)
    if result.model is None or used_rad is None or not n_spheres or (cell.work_volume_mm is None and n_spheres > 1):
        return _longest_length_uncertainty(assembled, solution, result.covariance)
    joints = datum_joints(result.model, cell.work_volume_box_mm, used_rad)
    return volume_length_uncertainty_mm(result, work_box_mm(cell, solution.state.centres_in_base_mm), joints)


def _longest_length_uncertainty(assembled: Assembled, solution: Solution, covariance: FloatArray) -> float | None:
    """Expanded uncertainty (k = 2) of the distance between the two farthest sphere places, seen from new poses."""
    problem, centres = assembled.problem, solution.state.centres_in_base_mm
    pairs = list(combinations(range(len(centres)), 2))
    if not pairs:
        return None
    first, second = max(pairs, key=lambda pair: float(np.linalg.norm(centres[pair[0]] - centres[pair[1]])))
    _, sensitivity = shot_centre_covariance_mm2(problem, solution)
    sensitivity = sensitivity.copy()
    sensitivity[:, :, problem.layout.centres] = 0.0
    mean = [sensitivity[problem.sphere == s].mean(axis=0) for s in (first, second)]
    direction = (centres[second] - centres[first]) / np.linalg.norm(centres[second] - centres[first])
    row = direction @ (mean[1] - mean[0])
    return float(2.0 * np.sqrt(row @ covariance @ row))


def _shot_results(
    assembled: Assembled, solution: Solution, trained: Prediction, held_out: Prediction, base_from_solver: FloatArray
) -> tuple[ShotResult, ...]:
    problem = assembled.problem
    line_profile = not problem.along_sight
    in_base = se3.apply(base_from_solver, trained.centres_in_base_mm)
    radial = np.sqrt(trained.sum_of_squares_mm2 / trained.n_points)
    errors = np.full(problem.n_shots, np.nan)
    if len(held_out.n_points) == problem.n_shots:
        errors = np.sqrt(held_out.sum_of_squares_mm2 / held_out.n_points) if line_profile else np.linalg.norm(held_out.centre_error_mm, axis=1)
    return tuple(
        ShotResult(
            session=shot.session,
            index=shot.index,
            sphere=shot.sphere,
            scan_sha256=shot.scan_sha256,
            n_points=len(shot.points_in_camera_mm),
            point_rms_mm=float(solution.point_rms_mm[i]),
            radial_rms_mm=float(radial[i]),
            centre_in_camera_mm=solution.geometry.centre_in_camera_mm[i],
            centre_in_base_mm=None if line_profile else in_base[i],
            predicted_error_mm=None if np.isnan(errors[i]) else float(errors[i]),
            joints_rad=shot.joints_rad,
            base_from_flange=shot.base_from_flange if shot.joints_rad is None else None,
        )
        for i, shot in enumerate(assembled.shots)
    )
