"""Spheres in a part's own view: what changed since the calibration, estimated for this part alone.

Fixture spheres that the calibration saw stand around a part. Their centres in the part's scans tell, to first order, a few
things that change between calibrations: where the fixture stands (6), the hand-eye transform (6), zero angles of the inner
axes, and one expansion of all links (warm-up). All are estimated together, each within its physical size, by

    a = -K y,   K = P D' (D P D' + V)^-1,   D = S B,

y the residuals of the shots and V their covariance where nothing changed (`calibrate.quick_check`), B how the unknowns follow
the amplitudes a with prior P. Every sphere is then left out in turn: a correction, of the fixture alone or of everything, is
taken only if spheres that had no part in it come nearer, and agree with it within their uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrate.few_parameters import gain, moved_covariance, unknowns_of
from calibrate.observations import SphereShot
from calibrate.problem import Layout
from calibrate.quick_check import CheckResiduals, check_residuals, known_state
from calibrate.result import Calibration
from calibrate.result_file import calibration_data
from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_RIGID_MM, _RIGID_RAD = 5.0, 1e-2
_HAND_EYE_MM, _HAND_EYE_RAD = 0.5, 2e-3
_AXIS_RAD, _EXPANSION = 3e-4, 3e-4
"""0.3 mrad; 25 K of steel."""
_PASSES = 3
_LEAST_SPHERES, _LEAST_SHOTS = 4, 8
_AGREES_P = 1e-3
_HELD = 1e-12
"""Prior of an amplitude that is not estimated."""


@dataclass(frozen=True, slots=True, eq=False)
class PartCorrection:
    """A correction, or why there is none."""

    calibration: Calibration
    """Corrected where the correction was taken, else as given."""
    accepted: bool
    reason: str
    changes: dict[str, tuple[float, float]]
    """Amplitude and standard uncertainty, mm, rad, or a ratio (`expansion`), of the correction that was tried last."""
    left_out_mm: dict[str, float]
    """Rms distance of spheres' mean centres from where the calibration has them: `as it was`, and for each sphere by a correction
    that it had no part in, of the `fixture` alone and of `everything`. Empty where nothing was tried."""
    n_spheres: int
    n_shots: int

    def to_json_dict(self) -> dict[str, object]:
        """For `--json`."""
        return {
            "accepted": self.accepted,
            "reason": self.reason,
            "changes": {name: {"value": v, "standard_uncertainty": u} for name, (v, u) in self.changes.items()},
            "left_out_mm": dict(self.left_out_mm),
            "n_spheres": self.n_spheres,
            "n_shots": self.n_shots,
        }


def correct_for_part(calibration: Calibration, shots: Sequence[SphereShot]) -> PartCorrection:
    """Estimate what changed from the spheres in a part's view, and take it if spheres left out agree.

    Args:
        calibration: with joints and a robot model.
        shots: of spheres that the calibration saw, from the part's own session.

    Raises:
        DataError: the calibration has no robot model; a sphere that it has not seen.
    """
    if calibration.model is None:
        raise DataError("a calibration without axis angles cannot be corrected axis by axis", remedy="Calibrate sessions with axis angles.")
    names = {shot.sphere for shot in shots}
    if len(names) < _LEAST_SPHERES or len(shots) < _LEAST_SHOTS:
        reason = f"{len(shots)} shots of {len(names)} spheres are too few: {_LEAST_SHOTS} of {_LEAST_SPHERES} spheres are needed"
        return PartCorrection(calibration, False, reason, {}, {}, len(names), len(shots))
    first = check_residuals(calibration, shots)
    columns, labels, prior = _columns(calibration, first)
    held = {"as it was": np.full(len(prior), _HELD), "fixture": np.where(np.arange(len(prior)) < 6, prior, _HELD), "everything": prior}
    tried = {name: _left_out(first, columns, sigma) for name, sigma in held.items()}
    chosen = min(tried, key=lambda name: tried[name].rms_mm)
    accepted, reason = _judged(chosen, tried)
    prior = held["everything" if chosen == "as it was" else chosen]
    current, total = _estimated(calibration, shots, prior)
    covariance, sigma = moved_covariance(calibration, first, columns, prior)
    changes = {label: (float(v), float(u)) for label, v, u, p in zip(labels, total, sigma, prior, strict=True) if p > _HELD}
    found = _named(replace(current, covariance=covariance), calibration, changes) if accepted else calibration
    return PartCorrection(found, accepted, reason, changes, {name: one.rms_mm for name, one in tried.items()}, len(names), len(shots))


def _named(corrected: Calibration, parent: Calibration, changes: dict[str, tuple[float, float]]) -> Calibration:
    """With an id of its own, and what it comes from among its inputs."""
    inputs = {**parent.inputs, "parent": parent.id, "part_correction": {name: list(pair) for name, pair in changes.items()}}
    named = replace(corrected, inputs=inputs)
    return replace(named, id=str(calibration_data(named)["id"]))


def _estimated(calibration: Calibration, shots: Sequence[SphereShot], prior: FloatArray) -> tuple[Calibration, FloatArray]:
    """The calibration with the change (k,) that the shots speak for."""
    current, total = calibration, np.zeros(len(prior))
    for _ in range(_PASSES):
        residuals = check_residuals(current, shots)
        columns = _columns(calibration, residuals)[0]
        # residuals of the calibration as it was: the prior holds the whole change, not each step of it
        effect = residuals.sensitivity.reshape(3 * residuals.n_shots, -1) @ columns
        target = -gain(residuals, columns, prior) @ (residuals.residual_mm.reshape(-1) - effect @ total)
        current, total = _moved(current, residuals.problem.layout, columns, target - total), target
    return current, total


def _judged(chosen: str, tried: dict[str, _LeftOut]) -> tuple[bool, str]:
    before_mm, after = tried["as it was"].rms_mm, tried[chosen]
    if chosen == "as it was":
        nearest = min(tried["fixture"].rms_mm, tried["everything"].rms_mm)
        return False, f"spheres left out come no nearer ({before_mm:.3f} mm before, {nearest:.3f} mm after): nothing that it knows has changed"
    if after.p_value < _AGREES_P:
        return False, f"a sphere left out still lies {after.worst_mm:.3f} mm off, more than chance explains: what changed is not in the correction"
    what = "the fixture stands elsewhere" if chosen == "fixture" else "fixture, hand-eye, axes and warmth"
    return True, f"{what}: spheres left out come nearer, {before_mm:.3f} mm before, {after.rms_mm:.3f} mm after"


def _columns(calibration: Calibration, residuals: CheckResiduals) -> tuple[FloatArray, tuple[str, ...], FloatArray]:
    """Columns (P, k) among the unknowns, names and prior sigmas (k,) of the amplitudes."""
    problem, model = residuals.problem, calibration.model
    if model is None:  # refused before
        raise TypeError("no robot model")
    state, names = known_state(calibration, problem.n_scans), tuple(calibration.sphere_centres_in_base_mm)
    parts = [_fixture(problem.layout, state.centres_in_base_mm), unknowns_of("hand-eye", problem, state, names)[0]]
    labels = [f"fixture.{part}" for part in ("rho_x_mm", "rho_y_mm", "rho_z_mm", "phi_x_rad", "phi_y_rad", "phi_z_rad")]
    labels += [label.replace("fixture", "hand_eye") for label in labels]
    prior = [_RIGID_MM] * 3 + [_RIGID_RAD] * 3 + [_HAND_EYE_MM] * 3 + [_HAND_EYE_RAD] * 3
    # the first axis turns everything as a moved fixture does, the last one as the hand-eye
    for axis in range(1, model.n_joints - 1):
        column, (label,) = unknowns_of(f"axis {axis + 1}", problem, state, names)
        parts.append(column)
        labels.append(label)
        prior.append(_AXIS_RAD)
    return np.hstack([*parts, _expansion(problem.layout, model)]), (*labels, "expansion"), np.array([*prior, _EXPANSION])


def _fixture(layout: Layout, centres_mm: FloatArray) -> FloatArray:
    """(P, 6) all spheres moved by one twist about their middle."""
    columns = np.zeros((layout.size, 6))
    arms = centres_mm - centres_mm.mean(axis=0)
    columns[layout.centres] = np.concatenate([np.tile(np.eye(3), (len(arms), 1)), -se3.hat(arms).reshape(-1, 3)], axis=1)
    return columns


def _expansion(layout: Layout, model: RobotModel) -> FloatArray:
    """(P, 1) all lengths of the links longer by the same ratio.

    A link is RotX TransX(a) RotZ TransZ(d) exp(xi): its d stands left of its own twist, and its a right of the twist before;
    twists are small, so that the sides do not differ. The first a moves the base, as a moved fixture does.
    """
    twists = np.zeros((layout.n_links, 6))
    twists[:, 2] = model.d_mm
    twists[:-1, 0] = model.a_mm[1:]
    column = np.zeros((layout.size, 1))
    column[layout.links, 0] = twists.reshape(-1)
    return column


def _moved(current: Calibration, layout: Layout, columns: FloatArray, step: FloatArray) -> Calibration:
    """The calibration with its changes; spheres stay in the base, so that a moved fixture becomes a moved datum."""
    change = columns @ step
    middle = np.array(list(current.sphere_centres_in_base_mm.values())).mean(axis=0)
    middle_in_solver = se3.apply(se3.inverse(current.datum.base_from_solver), middle)
    about = se3.from_rotation_translation(np.eye(3), middle_in_solver)
    motion = about @ se3.exp(step[:6]) @ se3.inverse(about)
    return replace(
        current,
        datum=replace(current.datum, base_from_solver=current.datum.base_from_solver @ se3.inverse(motion)),
        flange_from_camera=se3.exp(change[layout.hand_eye]) @ current.flange_from_camera,
        link_twists=current.link_twists + change[layout.links].reshape(-1, 6),
    )


@dataclass(frozen=True, slots=True)
class _LeftOut:
    """How spheres fare by a correction that they had no part in."""

    rms_mm: float
    worst_mm: float
    p_value: float
    """Of the worst of all spheres, where the correction is right."""


def _left_out(residuals: CheckResiduals, columns: FloatArray, prior: FloatArray) -> _LeftOut:
    """Mean miss of every sphere, the amplitudes estimated from the others."""
    from scipy import stats

    sphere, m = residuals.problem.sphere, residuals.n_shots
    y, effect = residuals.residual_mm.reshape(-1), residuals.sensitivity.reshape(3 * m, -1) @ columns
    misses, p_values = [], []
    for s in np.unique(sphere):
        inside = np.repeat(sphere == s, 3)
        keep, n = np.flatnonzero(~inside), int((sphere == s).sum())
        # rows that give the sphere's mean miss: its own shots, less what the others' estimate makes of them
        rows = np.zeros((3, 3 * m))
        rows[:, inside] = np.tile(np.eye(3), n) / n
        rows[:, keep] = -rows[:, inside] @ effect[inside] @ gain(residuals, columns, prior, keep)
        left, amplitudes = rows @ y, rows @ effect * prior
        covariance = rows @ residuals.covariance_mm2 @ rows.T + amplitudes @ amplitudes.T
        misses.append(float(np.linalg.norm(left)))
        p_values.append(float(stats.chi2.sf(left @ np.linalg.solve(covariance, left), 3)))
    return _LeftOut(float(np.sqrt(np.mean(np.square(misses)))), max(misses), min(1.0, min(p_values) * len(p_values)))
