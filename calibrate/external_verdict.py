"""A robot calibrated on external points alone: what they determine, its verdict, and its result."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from acquire.cell import Cell, Limits
from calibrate.datum import References
from calibrate.datum_choice import DatumChoice, stated_datum
from calibrate.datum_poses import datum_joints
from calibrate.external_points import ExternalPoints
from calibrate.external_result import external_names, external_result
from calibrate.external_solve import SPARE_ROWS, ExternalSolved, predicted_rms_mm, rms_mm, rows_without_pose_noise
from calibrate.identifiability import ANGLE_SCALE_MM, parameter_names
from calibrate.normal import symmetric_inverse
from calibrate.observations import RejectedShot
from calibrate.provenance import identity_of, inputs_of
from calibrate.result import Calibration
from calibrate.result_file import calibration_data
from calibrate.result_parts import Statistics
from calibrate.temperature import temperature_ranges_c
from drivers.errors import DataError
from drivers.files.session import Session
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_RELATIVE_ZERO = 1e-8
_MANY_REJECTED, _TOO_MANY_REJECTED = 0.1, 0.4
_LEAST_SPREAD_RAD = 0.35
"""An axis that moved less tells next to nothing of itself: 20 degrees."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotRank:
    """What external points determine of the robot, frames and targets projected out."""

    rank: int
    n_parameters: int
    expected_rank: int
    """4 per axis, a line in space each, less 6: where the base stands in the tracker's frame is a convention."""
    condition: float


def robot_rank(solved: ExternalSolved) -> RobotRank:
    """Rank of the link twists in the data of a solve on external points alone."""
    solution = solved.solution
    layout = solution.problem.layout
    gain = solution.reduced.noise_inverse @ solution.linearised.cross
    flat = solution.linearised.cross.reshape(-1, gain.shape[-1])
    information = solution.linearised.data_hessian - flat.T @ gain.reshape(flat.shape)
    n, rest = layout.links.stop, np.arange(layout.references.start, layout.size)
    cross = information[:n, rest]
    projected = information[:n, :n] - cross @ symmetric_inverse(information[np.ix_(rest, rest)]) @ cross.T
    scale = np.array(([1.0] * 3 + [ANGLE_SCALE_MM] * 3) * layout.n_links)
    values = np.linalg.eigvalsh(projected / scale[:, None] / scale)[::-1]
    # where frames and targets explain all, nothing but rounding is left: it must not be its own measure
    largest = float(np.linalg.eigvalsh(information[:n, :n] / scale[:, None] / scale)[-1])
    rank = int((values > _RELATIVE_ZERO * largest).sum())
    condition = float(np.sqrt(values[0] / values[rank - 1])) if rank else float("inf")
    return RobotRank(rank, n, 4 * layout.n_links - 6, condition)


def robot_alone_result(
    solved: ExternalSolved,
    *,
    cell: Cell,
    sessions: Sequence[Session],
    n_shots: int,
    notes: tuple[str, ...],
    rejected: tuple[RejectedShot, ...],
    created_utc: str,
    software: str,
    began: float,
    like: DatumChoice | None = None,
) -> Calibration:
    """The calibration of a solve on external points alone, with everything that a file must hold.

    The base is stated as for spheres: best fit to the nominal robot. Hand-eye transform and camera
    are handed on as the cell file has them, and `hand_eye` says so; in the covariance they are as good as unknown.
    """
    problem, state = solved.solution.problem, solved.solution.state
    points, model = problem.external, problem.model
    if points is None or model is None:
        raise DataError("there are no external points", remedy="Give shots with reference, target and point_in_reference_mm.")
    over = References(datum_joints(model, cell.work_volume_box_mm, points.joints_rad))
    datum = stated_datum(like, problem, state, (), solved.solution.covariance, over)
    held_out, predicted = rms_mm(solved.held_out_mm), predicted_rms_mm(solved.solution)
    scale = max(1.0, (held_out / predicted) ** 2) if np.isfinite(held_out) else 1.0
    covariance, rank = solved.solution.covariance * scale, robot_rank(solved)
    verdict, reasons = judge_robot_alone(cell.limits, points, model, rank, n_shots=n_shots, held_out_rms_mm=held_out, scale=scale)
    result = Calibration(
        id="",
        method="clouds",
        model=model,
        link_twists=state.link_twists,
        terms=problem.terms,
        terms_rad=state.terms_rad,
        flange_from_camera=state.flange_from_camera,
        camera_error=problem.camera_error,
        camera_mm=state.camera_mm,
        camera_seen_volume_mm=np.zeros((2, 3)),
        radius_offset_mm=0.0,
        sphere_centres_in_base_mm={},
        sphere_radius_offsets_mm={},
        datum=datum,
        seen_joints_rad=np.array([points.joints_rad.min(axis=0), points.joints_rad.max(axis=0)]),
        noise=replace(solved.solution.noise, point_mm=0.0),
        parameter_names=parameter_names(problem.layout, problem.terms, ()) + external_names(points),
        covariance=covariance,
        statistics=Statistics(
            n_shots=n_shots,
            used=points.n_shots,
            rank=rank.rank,
            n_parameters=rank.n_parameters,
            condition=rank.condition,
            train_rms_mm=rms_mm(rows_without_pose_noise(problem, state).residual_mm),
            cross_validated_rms_mm=held_out,
            predicted_centre_rms_mm=predicted,
            covariance_scale=scale,
            passes=solved.solution.passes,
            seconds=time.perf_counter() - began,
        ),
        limits=cell.limits,
        verdict=verdict,
        reasons=reasons + notes,
        shots=(),
        rejected=rejected,
        cell_name=cell.name,
        inputs=inputs_of(cell, sessions),
        identity=identity_of(cell, sessions),
        created_utc=created_utc,
        software=software,
        temperatures_c=temperature_ranges_c(sessions),
        hand_eye="none" if cell.flange_from_camera is None else "cell",
        external=external_result(problem, state, datum, covariance, solved.held_out_mm, predicted, solved.compared),
    )
    return replace(result, id=str(calibration_data(result)["id"]))


def judge_robot_alone(
    limits: Limits | None, points: ExternalPoints, model: RobotModel, rank: RobotRank, *, n_shots: int, held_out_rms_mm: float, scale: float
) -> tuple[str, tuple[str, ...]]:
    """Verdict and its reasons, the gravest first; `centre_rms_mm` of the limits is what held-out points must keep."""
    fail = [*_too_little(points, rank), *_still_axes(points.joints_rad, model)]
    rejected = 1 - points.n_shots / max(n_shots, 1)
    if rejected > _TOO_MANY_REJECTED:
        fail.append(f"{n_shots - points.n_shots} of {n_shots} shots were rejected")
    if limits is not None and held_out_rms_mm > limits.centre_rms_mm:
        fail.append(f"held-out external points are missed by {held_out_rms_mm:.3f} mm rms, the limit is {limits.centre_rms_mm:g} mm")
    doubts = []
    if limits is None:
        doubts.append("no limits given in the cell file: there is nothing to pass against")
    if _MANY_REJECTED < rejected <= _TOO_MANY_REJECTED:
        doubts.append(f"{n_shots - points.n_shots} of {n_shots} shots were rejected")
    if scale > 4.0:
        doubts.append(f"held-out points miss by {np.sqrt(scale):.1f} times what the noise explains: something is not in the model")
    note = "external reference points alone: the robot is calibrated; hand-eye transform and camera are not"
    return ("fail" if fail else "marginal" if doubts else "pass"), (*fail, *doubts, note)


def _too_little(points: ExternalPoints, rank: RobotRank) -> list[str]:
    unknowns = rank.expected_rank + 6 * len(points.references) + 3 * len(points.targets)
    needed = int(np.ceil((unknowns + SPARE_ROWS) / 3))
    found = []
    if points.n_shots < needed:
        found.append(f"too few external points: {points.n_shots} of them for {unknowns} unknowns, at least {needed} are needed")
    if rank.rank < rank.expected_rank:
        missing = rank.expected_rank - rank.rank
        found.append(
            f"the points leave {missing} of {rank.expected_rank} directions of the robot open (rank {rank.rank}): "
            "move every axis over a wide range, turn the flange about all its axes, and keep the target off the last axis"
        )
    return found


def _still_axes(joints_rad: FloatArray, model: RobotModel) -> list[str]:
    spread = np.ptp(joints_rad, axis=0)
    still = [str(i + 1) for i in range(model.n_joints) if spread[i] < _LEAST_SPREAD_RAD]
    if not still:
        return []
    degrees = np.degrees(_LEAST_SPREAD_RAD)
    which = "axis" if len(still) == 1 else "axes"
    return [f"{which} {', '.join(still)} moved less than {degrees:.0f} degrees: nothing was learnt of the robot beyond"]
