"""A few parameters solved anew from a quick check, as a new calibration that names its parent.

Only what the cause names moves: `theta' = theta + B a` with B the columns of the cause among the unknowns (link twists of an
axis, the hand-eye, centres of moved spheres). With `y = S e - D a + n` (e the error of the parent, D = S B, n noise) and the
gain `K = P D' (D P D' + V)^-1`, the estimate is `a = -K y` and the new error

    e' = (I - B K S) e - B (I - K D) a - B K n,

so that the covariance holds what the parent did not know, what the few shots leave open, and how both hang together.
Whether it helps is asked of every shot that was left out of its own estimate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibrate.drift_causes import CAMERA, HAND_EYE, SHOT, SPHERE, causes_of, diagnose
from calibrate.observations import SphereShot
from calibrate.problem import Problem, State, linearise_geometry
from calibrate.quick_check import CheckResiduals, check_residuals, known_state, known_system
from calibrate.result import Calibration
from calibrate.result_file import calibration_data
from calibrate.result_parts import ShotResult
from calibrate.sums import shot_moments
from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

_PASSES = 3
_PRIOR_MM, _PRIOR_RAD = 5.0, 1e-2
"""Sizes that a change may have at all."""
_LEAST_SHOTS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Resolved:
    """What solving a few parameters anew gave."""

    calibration: Calibration
    cause: str
    amplitudes: Mapping[str, tuple[float, float]]
    """Change of each parameter and its standard uncertainty."""
    left_out_before_mm: float
    """Rms over the shots of the distance of a centre from where the parent has it."""
    left_out_after_mm: float
    """The same after an estimate without that shot."""
    n_better: int
    """Shots that came nearer."""
    p_value_after: float
    """Of the tests for a change, with the new calibration."""

    n_shots: int

    @property
    def accepted(self) -> bool:
        """Whether shots that were left out improve: together, and most of them."""
        return self.left_out_after_mm < self.left_out_before_mm and 2 * self.n_better > self.n_shots


def resolve(
    parent: Calibration, shots: Sequence[SphereShot], cause: str, *, created_utc: str, software: str, session_names: Sequence[str]
) -> Resolved:
    """Solve the parameters of one cause anew.

    Args:
        parent: the calibration that the shots disagree with.
        shots: of a quick check, at least four.
        cause: `hand-eye`, `axis N` or `sphere moved`.
        created_utc: for the new file.
        software: for the new file.
        session_names: folders that the shots come from.

    Raises:
        DataError: too few shots, or a cause that a few shots cannot settle.
    """
    _require_soluble(parent, shots, cause)
    state, moved = known_state(parent, 1), np.zeros(0)
    current = parent
    for _ in range(_PASSES):
        residuals = check_residuals(current, shots)
        state = known_state(current, residuals.problem.n_scans)
        columns, names = unknowns_of(cause, residuals.problem, state, tuple(parent.sphere_centres_in_base_mm))
        step = -gain(residuals, columns, _prior(names)) @ residuals.residual_mm.reshape(-1)
        moved = step if not len(moved) else moved + step
        current = _moved(current, residuals.problem, state, columns, step, cause)
    before = check_residuals(parent, shots)
    covariance, sigma = moved_covariance(parent, before, columns, _prior(names))
    errors = _left_out(before, columns, names)
    own = np.linalg.norm(before.residual_mm, axis=1)
    new = replace(
        current,
        covariance=covariance,
        shots=parent.shots + _shot_results(current, shots, errors),
        next_best_poses=(),
        error_budget=None,
        created_utc=created_utc,
        software=software,
    )
    after = check_residuals(new, shots)
    told = diagnose(after, causes_of(after, known_state(new, after.problem.n_scans), tuple(new.sphere_centres_in_base_mm)))
    amplitudes = {name: (float(v), float(s)) for name, v, s in zip(names, moved, sigma, strict=True)}
    evidence = {
        "cause": cause,
        "n_shots": len(shots),
        "n_parent_shots": len(parent.shots),
        "changes": {name: list(pair) for name, pair in amplitudes.items()},
        "left_out_rms_before_mm": _rms(own),
        "left_out_rms_after_mm": _rms(errors),
        "n_better": int((errors < own).sum()),
    }
    new = replace(new, inputs={**parent.inputs, "parent": parent.id, "check_sessions": list(session_names), "resolve": evidence})
    # never better than marginal: only a few shots speak for it
    new = replace(new, verdict="fail" if parent.verdict == "fail" else "marginal", reasons=(_reason(parent, cause, len(shots)), *parent.reasons))
    new = replace(new, id=str(calibration_data(new)["id"]))
    return Resolved(new, cause, amplitudes, _rms(own), _rms(errors), int((errors < own).sum()), told.p_value, len(shots))


def unknowns_of(cause: str, problem: Problem, state: State, sphere_names: Sequence[str]) -> tuple[FloatArray, tuple[str, ...]]:
    """Columns (P, k) of a cause among the unknowns, and the names of its amplitudes; raises DataError where there are none."""
    layout = problem.layout
    if cause == HAND_EYE:
        columns = np.zeros((layout.size, 6))
        columns[layout.hand_eye] = np.eye(6)
        return columns, tuple(f"hand_eye.{part}" for part in ("rho_x_mm", "rho_y_mm", "rho_z_mm", "phi_x_rad", "phi_y_rad", "phi_z_rad"))
    if cause == SPHERE:
        seen = np.unique(problem.sphere)
        columns = np.zeros((layout.size, 3 * len(seen)))
        for k, i in enumerate(seen):
            start = layout.centres.start + 3 * int(i)
            columns[start : start + 3, 3 * k : 3 * k + 3] = np.eye(3)
        return columns, tuple(f"sphere.{sphere_names[int(i)]}.{a}_mm" for i in seen for a in "xyz")
    axis = _axis_of(cause, problem)
    # an offset turns link k by the coupling: a left factor about z of its twist, because RotZ and TransZ commute
    columns = np.zeros((layout.size, 1))
    turn = np.array([0.0, 0, 0, 0, 0, 1])
    of_twist = np.linalg.solve(se3.left_jacobian(state.link_twists), np.broadcast_to(turn, (layout.n_links, 6))[..., None])[..., 0]
    coupling = np.eye(layout.n_links) if problem.model is None else problem.model.coupling
    columns[layout.links, 0] = (coupling[:, axis, None] * of_twist).reshape(-1)
    return columns, (f"axis{axis + 1}_rad",)


def _axis_of(cause: str, problem: Problem) -> int:
    words = cause.split()
    n = problem.layout.n_links
    if len(words) != 2 or words[0] != "axis" or not words[1].isdigit() or not 1 <= int(words[1]) <= n:
        known = ", ".join([HAND_EYE, *(f"axis {i + 1}" for i in range(n)), SPHERE])
        raise DataError(f"{cause!r} is nothing that a few shots can settle", remedy=f"Choose one of: {known}.")
    return int(words[1]) - 1


def _require_soluble(parent: Calibration, shots: Sequence[SphereShot], cause: str) -> None:
    if len(shots) < _LEAST_SHOTS:
        remedy = f"Take {_LEAST_SHOTS} or more, best those of `spherecal plan --for check`."
        raise DataError(f"{len(shots)} shots are too few to solve anything anew", remedy=remedy)
    if cause in {CAMERA, SHOT}:
        remedy = "Calibrate anew, with a full plan." if cause == CAMERA else "Look at that scan, and take the check again."
        raise DataError(f"a few shots cannot settle this cause: {cause}", remedy=remedy)
    if parent.external is not None:
        raise DataError("the calibration has external reference points, which a check does not see", remedy="Calibrate anew.")


def _prior(names: Sequence[str]) -> FloatArray:
    return np.array([_PRIOR_RAD if name.endswith("_rad") else _PRIOR_MM for name in names])


def gain(residuals: CheckResiduals, columns: FloatArray, prior: FloatArray, keep: NDArray[np.int64] | None = None) -> FloatArray:
    """(k, r) estimate of the amplitudes per residual, from rows (r,) to keep or all; its minus is the change.

    Args:
        residuals: of the parent calibration.
        columns: (P, k) how the unknowns follow the amplitudes.
        prior: (k,) sizes that they may have.
        keep: rows of the residuals.
    """
    size = 3 * residuals.n_shots
    rows = np.arange(size) if keep is None else keep
    effect = (residuals.sensitivity.reshape(size, -1) @ columns)[rows] * prior
    total = effect @ effect.T + residuals.covariance_mm2[np.ix_(rows, rows)]
    return np.asarray(prior[:, None] * np.linalg.solve(total, effect).T)


def _left_out(residuals: CheckResiduals, columns: FloatArray, names: Sequence[str]) -> FloatArray:
    """(m,) distance of each shot's centre from where an estimate without its scan puts it."""
    m, scan = residuals.n_shots, residuals.problem.scan
    y, effect = residuals.residual_mm.reshape(-1), residuals.sensitivity.reshape(3 * m, -1) @ columns
    errors = np.zeros(m)
    for g in np.unique(scan):
        out = np.repeat(scan == g, 3)
        keep = np.flatnonzero(~out)
        change = -gain(residuals, columns, _prior(names), keep) @ y[keep]
        left = (y[out] + effect[out] @ change).reshape(-1, 3)
        errors[scan == g] = np.linalg.norm(left, axis=1)
    return errors


def moved_covariance(parent: Calibration, residuals: CheckResiduals, columns: FloatArray, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(P, P) of the calibration with amplitudes estimated, and (k,) standard uncertainties of these; arguments as of `gain`."""
    m, size = residuals.n_shots, len(parent.covariance)
    sensitivity = residuals.sensitivity.reshape(3 * m, -1)
    estimate = gain(residuals, columns, prior)
    noise = residuals.covariance_mm2 - sensitivity @ parent.covariance @ sensitivity.T
    kept = np.eye(size) - columns @ estimate @ sensitivity
    open_ = (np.eye(len(prior)) - estimate @ sensitivity @ columns) * prior
    inner = open_ @ open_.T + estimate @ noise @ estimate.T
    covariance = kept @ parent.covariance @ kept.T + columns @ inner @ columns.T
    sigma = np.sqrt(np.diagonal(inner + estimate @ sensitivity @ parent.covariance @ sensitivity.T @ estimate.T))
    return np.asarray((covariance + covariance.T) / 2), np.asarray(sigma)


def _moved(current: Calibration, problem: Problem, state: State, columns: FloatArray, step: FloatArray, cause: str) -> Calibration:
    layout, change = problem.layout, columns @ step
    if cause == SPHERE:
        names = tuple(current.sphere_centres_in_base_mm)
        rotation = current.datum.base_from_solver[:3, :3]
        shift = change[layout.centres].reshape(-1, 3) @ rotation.T
        centres = {name: current.sphere_centres_in_base_mm[name] + shift[i] for i, name in enumerate(names)}
        return replace(current, sphere_centres_in_base_mm=centres)
    if cause == HAND_EYE:
        return replace(current, flange_from_camera=se3.exp(change[layout.hand_eye]) @ current.flange_from_camera)
    return replace(current, link_twists=state.link_twists + change[layout.links].reshape(-1, 6))


def _reason(parent: Calibration, cause: str, n_shots: int) -> str:
    solved = f"{cause} solved anew from {n_shots} shots of a quick check, everything else is of calibration {parent.id[:12]}"
    return f"{solved}: prove it with `spherecal verify`"


def _shot_results(new: Calibration, shots: Sequence[SphereShot], errors_mm: FloatArray) -> tuple[ShotResult, ...]:
    problem, state = known_system(new, shots)
    geometry = linearise_geometry(problem, state)
    moments, counts = shot_moments(problem, state, geometry, np.inf)
    taken = (moments[:, :3, -1:] * np.linalg.solve(moments[:, :3, :3], moments[:, :3, -1:])).sum(axis=(1, 2))
    return tuple(
        ShotResult(
            session=shot.session,
            index=shot.index,
            sphere=shot.sphere,
            scan_sha256=shot.scan_sha256,
            n_points=len(shot.points_in_camera_mm),
            point_rms_mm=float(np.sqrt(max(counts[j, 1] - taken[j], 0.0) / counts[j, 2])),
            radial_rms_mm=float(np.sqrt(counts[j, 1] / counts[j, 2])),
            centre_in_camera_mm=np.asarray(shot.centre_in_camera_mm),
            centre_in_base_mm=None,
            predicted_error_mm=float(errors_mm[j]),
            joints_rad=shot.joints_rad,
            base_from_flange=shot.base_from_flange if shot.joints_rad is None else None,
        )
        for j, shot in enumerate(shots)
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))
