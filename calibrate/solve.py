"""From sessions to a calibration: the whole way, in the order a person would tell it."""

from __future__ import annotations

import datetime
import importlib.metadata
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from acquire.cell import Cell, cell_of_session, robot_model_of
from acquire.check import check_session
from acquire.identity import check_one_system
from calibrate.assemble import Assembled, assemble, without_pose_noise
from calibrate.camera_error import CameraError, NoCameraError, camera_error_models
from calibrate.camera_misfit import CameraMisfit, misfit_of
from calibrate.centres import cross_validate_centres, require_centres, solve_centres
from calibrate.clouds import Solution, solve_clouds, thinned
from calibrate.datum_choice import DatumChoice
from calibrate.distinct_views import held_by_priors, is_starved
from calibrate.external_points import ExternalShot
from calibrate.external_solve import held_out_errors, joined_by_external, solve_robot_alone, without_spoiled
from calibrate.external_verdict import robot_alone_result
from calibrate.model_choice import choose_model, is_open
from calibrate.normal import NoiseModel
from calibrate.observations import Observations, RejectedShot, SphereShot
from calibrate.plausibility import check_reported_poses
from calibrate.plausibility_arcs import check_arcs
from calibrate.plausibility_closure import check_closure, with_hints
from calibrate.plausibility_scans import check_units
from calibrate.problem import Priors, Problem, State
from calibrate.rejection import unexplained
from calibrate.report_figures import make_result
from calibrate.result import Calibration
from calibrate.second_look import see_sessions
from calibrate.start import start_from_centres
from calibrate.start_arcs import start_from_arcs
from calibrate.temperature import cell_when_seen
from calibrate.term_choice import NO_CHOICE, choose_terms, with_terms
from calibrate.validation import Prediction, cross_validate
from drivers.errors import DataError, SettingsError
from drivers.files.session import Session
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_LOG = logging.getLogger(__name__)
_DEFAULT_SIGHT_CROSSING_MM = (60.0, 0.0, 500.0)
_AUTO = ("none", "affine", "pillow", "field")
_LEAST_PROFILES = 30
"""Fewer do not tell an error of the camera from the arm's."""
_THIN_POINTS = 250
_REJECT_ROUNDS = 4
_FIRST_NOISE = NoiseModel(point_mm=0.05, pose_mm=0.3, pose_rad=5e-4)


@dataclass(frozen=True, slots=True)
class CalibrationSettings:
    """How to calibrate."""

    camera_error: str = "auto"
    """auto, none, affine, pillow, pillow-free, pillow-full, pillow-full-free or field."""
    method: str = "clouds"
    """clouds, centres for one fitted centre a shot, or stepwise for the paper's solver."""
    robot_terms: str = "auto"
    """Terms of the arm beyond link twists: auto estimates those that held-out shots want, none leaves them all considered."""
    priors: Priors = field(default_factory=Priors)
    datum: DatumChoice | None = None
    """Whose base results are stated in; the nominal robot's if None."""


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A solve with its held-out shots."""

    assembled: Assembled
    solution: Solution
    held_out: Prediction
    rejected: tuple[RejectedShot, ...]
    external_held_out_mm: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(E, 3) error of every external point against a solve without it; see `held_out_errors`."""
    misfit: CameraMisfit | None = None
    """Of a camera error model that was asked for against the data."""


@dataclass(frozen=True, slots=True)
class _Solver:
    """What the methods differ in; starts, choice of the camera model and rejection are the same."""

    solve: Callable[[Problem, State, NoiseModel], Solution]
    held_out: Callable[[Solution], Prediction]


_SOLVERS = {"clouds": _Solver(solve_clouds, cross_validate), "centres": _Solver(solve_centres, cross_validate_centres)}


def calibrate(sessions: Sequence[Session], settings: CalibrationSettings | None = None) -> Calibration:
    """Calibrate robot, hand-eye and camera on one or more sessions of one cell.

    Raises:
        FileError: a file is broken, or a shot does not fit the cell.
        DataError: the data cannot be used: no sphere found, too few shots, wrong units, no solution.
        SettingsError: an unknown camera error model or method, or two that do not go together.
    """
    from threadpoolctl import threadpool_limits

    # thousands of products of small matrices: threads in BLAS cost ten times what they save, and reorder sums
    with threadpool_limits(limits=1, user_api="blas"):
        return _calibrate(sessions, settings or CalibrationSettings())


def _calibrate(sessions: Sequence[Session], settings: CalibrationSettings) -> Calibration:
    began = time.perf_counter()
    cell, model = cell_of_sessions(sessions)
    cell, warmth = cell_when_seen(cell, sessions, uses_lengths=settings.method != "stepwise")
    notes = check_reported_poses(sessions, model) + warmth
    observations = see_sessions(sessions, cell=cell, model=model)
    if model is not None and observations.external and not _show_spheres(sessions):
        return _calibrate_robot_alone(sessions, observations, cell, model, settings, notes, began)
    if not observations.shots:
        check_units(sessions, cell)
        raise _nothing_to_use(sessions, observations)
    hints = check_closure(sessions, observations, model)
    solved, compared = solve_observations(observations, cell, model, settings)
    return make_result(
        solved,
        method=settings.method,
        cell=cell,
        sessions=sessions,
        n_shots=observations.n_shots,
        notes=notes,
        compared=compared,
        rejected=with_hints(observations.rejected + solved.rejected, hints),
        created_utc=_now_utc(),
        software=_software(),
        began=began,
        like=settings.datum,
    )


def _calibrate_robot_alone(
    sessions: Sequence[Session],
    observations: Observations,
    cell: Cell,
    model: RobotModel,
    settings: CalibrationSettings,
    notes: tuple[str, ...],
    began: float,
) -> Calibration:
    if settings.method != "clouds":
        message = f"the method {settings.method} works on spheres, and the session holds external reference points alone"
        raise SettingsError(message, remedy="Use --method clouds.")
    solved = solve_robot_alone(observations.external, model, settings.priors, cell.flange_from_camera)
    return robot_alone_result(
        solved,
        cell=cell,
        sessions=sessions,
        n_shots=observations.n_shots,
        notes=notes,
        rejected=observations.rejected + solved.rejected,
        created_utc=_now_utc(),
        software=_software(),
        began=began,
        like=settings.datum,
    )


def _show_spheres(sessions: Sequence[Session]) -> bool:
    return any(shot.sphere is not None and shot.status != "skipped" and not shot.is_reference_point for s in sessions for shot in s.shots)


def _now_utc() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def _software() -> str:
    return f"spherecal {importlib.metadata.version('spherecal')}"


def cell_of_sessions(sessions: Sequence[Session]) -> tuple[Cell, RobotModel | None]:
    """The one cell and robot of some sessions; DataError where two of them describe different ones."""
    if not sessions:
        raise DataError("no session given", remedy="Name at least one session folder.")
    digests = [session.digest for session in sessions]
    if len(set(digests)) < len(digests):
        raise DataError("the same session was given twice", remedy="Name every session once.")
    cell = cell_of_session(sessions[0])
    model = robot_model_of(cell, sessions[0])
    for session in sessions:
        other = cell_of_session(session)
        if (other.spheres, other.lengths, other.robot.model) != (cell.spheres, cell.lengths, cell.robot.model):
            raise DataError(
                "its spheres, lengths or robot differ from those of the first session",
                file=session.cell_path,
                remedy="Calibrate sessions of different cells apart, or give moved spheres their own names in one cell file.",
            )
        check_session(session, other, robot_model_of(other, session))
    check_one_system(sessions)
    return cell, model


def solve_observations(
    observations: Observations, cell: Cell, model: RobotModel | None, settings: CalibrationSettings
) -> tuple[Solved, dict[str, float]]:
    """Solve with the camera error model asked for, or with the simplest that held-out shots do not tell from the best."""
    solved, compared = _solved_by_method(observations, cell, model, settings)
    # a field follows whatever the others do
    asked = settings.camera_error not in {"auto", "field"} and settings.method in _SOLVERS
    if not asked or not solved.solution.problem.along_sight or solved.solution.held:
        return solved, compared
    others = _candidates(observations, cell, replace(settings, camera_error="auto"))
    return replace(solved, misfit=misfit_of(solved.solution, others)), compared


def _solved_by_method(
    observations: Observations, cell: Cell, model: RobotModel | None, settings: CalibrationSettings
) -> tuple[Solved, dict[str, float]]:
    if settings.method == "stepwise":
        from calibrate.stepwise_sessions import solve_stepwise_sessions

        solved = solve_stepwise_sessions(observations, cell, model, settings)
        return replace(solved, rejected=solved.rejected + tuple(_not_taken(shot, "stepwise") for shot in observations.external)), {}
    solver = _SOLVERS.get(settings.method)
    if solver is None:
        raise SettingsError(f"unknown method {settings.method!r}", remedy=f"Choose {', '.join(_SOLVERS)} or stepwise.")
    models = _candidates(observations, cell, settings)
    first = assemble(observations.shots, cell=cell, model=model, camera_error=models[-1], priors=settings.priors)
    if settings.method == "centres":
        require_centres(first.problem)
    starved = not observations.external and is_starved(first.problem)
    if starved:
        first, models = first.subset(np.arange(first.problem.n_shots), models[0]), models[:1]
        first = replace(first, problem=replace(first.problem, priors=held_by_priors(settings.priors)))
    start, keep, rejected = _start(first, cell)
    problem = replace(first.problem, first_flange_from_camera=start.flange_from_camera)
    if settings.method == "clouds":
        problem, start, spoiled = joined_by_external(problem, start, observations.external, start.flange_from_camera)
    else:
        spoiled = tuple(_not_taken(shot, settings.method) for shot in observations.external)
    first, rejected = replace(first, problem=problem), rejected + spoiled
    compared: dict[str, float] = {}
    if is_open(models, problem) and not starved:
        keep, about, rejected = _solved_on_some_points(solver, first, start, keep, rejected)
        choice = choose_model(about, models)
        first, start, compared = first.subset(np.arange(first.problem.n_shots), choice.model), choice.state, dict(choice.held_out_rms_mm)
    solved = _solve_and_reject(solver, first, start, keep, rejected)
    if starved:
        return replace(solved, solution=replace(solved.solution, held=True)), compared
    arm = choose_terms(solved.solution) if settings.method == "clouds" and settings.robot_terms == "auto" else NO_CHOICE
    _LOG.debug("held-out rms by camera error model: %s, by terms of the arm: %s", compared, arm.held_out_rms_mm)
    if not arm.names:
        return solved, compared
    # what the terms explain may have looked like outliers: every shot gets another chance
    first = replace(first, problem=with_terms(first.problem, arm.terms))
    start = replace(solved.solution.state, terms_rad=np.zeros(len(arm.terms)))
    return _solve_and_reject(solver, first, start, keep, rejected), {**compared, **arm.held_out_rms_mm}


def _candidates(observations: Observations, cell: Cell, settings: CalibrationSettings) -> list[CameraError]:
    if cell.camera.kind == "line_profile" and settings.camera_error == "auto" and len(observations.shots) < _LEAST_PROFILES:
        return [NoCameraError()]
    names = _AUTO if settings.camera_error == "auto" else (settings.camera_error,)
    points = np.concatenate([shot.points_in_camera_mm for shot in observations.shots])
    crossing = cell.camera.sight_crossing_mm or _DEFAULT_SIGHT_CROSSING_MM
    return camera_error_models(names, points_in_camera_mm=points, sight_crossing_mm=crossing)


def _start(assembled: Assembled, cell: Cell) -> tuple[State, NDArray[np.int64], tuple[RejectedShot, ...]]:
    """First guess, the shots that fit it, and those that do not."""
    problem, shots = assembled.problem, assembled.shots
    if not problem.along_sight:
        start = start_from_arcs(problem, cell.flange_from_camera)
        check_arcs(problem, shots, start.scale_mm)
    else:
        centres = np.array([shot.centre_in_camera_mm for shot in shots], dtype=np.float64)
        start = start_from_centres(problem, centres, cell.flange_from_camera)
    rejected = tuple(_too_far(shots[i], start.miss_mm[i]) for i in np.flatnonzero(start.spoiled))
    return start.state, np.flatnonzero(~start.spoiled), rejected


def _solve_and_reject(solver: _Solver, everything: Assembled, start: State, keep: NDArray[np.int64], rejected: tuple[RejectedShot, ...]) -> Solved:
    """Solve, reject the shots that the noise cannot explain, and solve again until none is left."""
    for _ in range(_REJECT_ROUNDS):
        part = everything.subset(keep)
        solution = solver.solve(part.problem, without_pose_noise(start, part.problem.n_scans), _FIRST_NOISE)
        found = unexplained(part.problem, solution)
        far, miss_mm = found.far, found.miss_mm
        external, spoiled = without_spoiled(solution)
        if not far.any() and not spoiled:
            break
        rejected += tuple(_too_far(part.shots[i], miss_mm[i]) for i in np.flatnonzero(far)) + spoiled
        keep, start = keep[~far], solution.state
        everything = replace(everything, problem=replace(everything.problem, external=external))
    return Solved(part, solution, solver.held_out(solution), rejected, held_out_errors(solution))


def _solved_on_some_points(
    solver: _Solver, everything: Assembled, start: State, keep: NDArray[np.int64], rejected: tuple[RejectedShot, ...]
) -> tuple[NDArray[np.int64], Solution, tuple[RejectedShot, ...]]:
    """A solve good enough to compare camera models about it, and the shots that it cannot explain."""
    thin = replace(everything, problem=thinned(everything.problem, _THIN_POINTS))
    for _ in range(_REJECT_ROUNDS):
        part = thin.subset(keep)
        solution = solver.solve(part.problem, without_pose_noise(start, part.problem.n_scans), _FIRST_NOISE)
        found = unexplained(part.problem, solution)
        far, miss_mm = found.far, found.miss_mm
        if not far.any():
            break
        rejected += tuple(_too_far(part.shots[i], miss_mm[i]) for i in np.flatnonzero(far))
        keep, start = keep[~far], solution.state
    return keep, solution, rejected


def _not_taken(shot: ExternalShot, method: str) -> RejectedShot:
    return RejectedShot(shot.session, shot.index, f"the method {method} takes no external reference points; --method clouds does")


def _too_far(shot: SphereShot, miss_mm: float) -> RejectedShot:
    return RejectedShot(shot.session, shot.index, f"outlier: its sphere {shot.sphere} lies {miss_mm:.2f} mm from where the other shots put it")


def _nothing_to_use(sessions: Sequence[Session], observations: Observations) -> DataError:
    if not observations.rejected:
        return DataError("the session holds no shot of a sphere", file=sessions[0].folder / "shots.jsonl", remedy="Capture shots first.")
    first = observations.rejected[0]
    return DataError(
        f"none of {observations.n_shots} shots shows its sphere; shot {first.index}: {first.reason}",
        file=sessions[0].folder,
        remedy="`spherecal centres` shows each shot; check units, diameters and which sphere each shot names.",
    )
