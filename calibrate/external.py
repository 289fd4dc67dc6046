"""External reference points in the normal equations: a laser tracker sees a target on the flange (METHOD.md 4, *External points*).

Residual of a shot, three rows in base axes: `base_from_flange(q) target + e - base_from_reference p`, p the measured
point, e the displacement that the stop's pose noise causes at the target: the same link twists, deflection terms and
pose-noise law as for spheres, so that both kinds of shot add to the same sums. Frame and target are unknowns with no more
than a far and weak hold at the first guess, for points that leave them open. Distances between measured points bring the
scale that spheres alone only have from their diameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibrate.datum import link_columns, term_columns
from calibrate.external_points import ExternalPoints
from calibrate.normal import Linearised, NoiseModel, marginal_cost
from calibrate.problem import Layout, Problem, State
from calibrate.variance import minimise_by_parabolas
from drivers.kinematics import mdh, se3
from drivers.kinematics.se3 import FloatArray

FIRST_NOISE_MM = 0.03
_HOLD_MM, _HOLD_RAD = 100.0, 0.3
_TYPICAL_NOISE_MM, _TYPICAL_FACTOR = 0.015, 2.0
"""What a laser tracker's points scatter by on each axis, give or take a factor: translations of the flange look the same
in these points alone, and only this tells how much of a scatter is whose."""
_SMALLEST = np.log([1e-4, 2e-7, 1e-4])


@dataclass(frozen=True, slots=True, eq=False)
class ExternalRows:
    """Residuals and Jacobian of E external points with H stops at a state of P unknowns; base axes, mm."""

    points: ExternalPoints
    residual_mm: FloatArray
    """(E, 3), pose noise of the state taken out."""
    columns: FloatArray
    """(E, 3, P)."""
    noise_columns: FloatArray
    """(E, 3, 6): displacement per nuisance twist of the stop."""
    hold_precision: FloatArray
    """(P,) inverse variances of the weak hold on frames and targets, zero elsewhere."""
    hold_value: FloatArray
    """(P,) how far they are from where they are held."""

    def pose_covariance_mm2(self, noise: NoiseModel) -> FloatArray:
        """(E, 3, 3) of one measured point about the model: tracker and pose noise."""
        pose = self.noise_columns / noise.pose_precision @ np.swapaxes(self.noise_columns, 1, 2)
        return np.asarray(pose + external_sigma_mm(noise) ** 2 * np.eye(3))


def external_sigma_mm(noise: NoiseModel) -> float:
    """Standard deviation of a measured point on each axis; a first guess where none was estimated yet."""
    return noise.external_mm or FIRST_NOISE_MM


def external_rows(problem: Problem, state: State) -> ExternalRows | None:
    """Linearise the external points of a problem; None where it has none."""
    points, model = problem.external, problem.model
    if points is None or model is None:
        return None
    layout, rows = problem.layout, np.arange(points.n_shots)
    deflection = points.load @ state.terms_rad if state.terms_rad.any() else None
    frames = mdh.chain(model, points.joints_rad, state.link_twists, deflection)
    flange = frames[:, -1]
    seen = se3.apply(flange, state.target_in_flange_mm[points.target])
    told = se3.apply(state.base_from_reference[points.reference], points.points_in_reference_mm)
    noise_columns = se3.point_columns(seen - flange[:, :3, 3])
    pose_noise = state.pose_noise[problem.n_scans - points.n_stops :][points.stop]
    columns = np.zeros((points.n_shots, 3, layout.size))
    columns[:, :, layout.links] = link_columns(state.link_twists, frames, seen)
    if problem.terms:
        columns[:, :, layout.terms] = term_columns(state.link_twists, frames, points.load, seen)
    of_frame = -se3.point_columns(told)
    for axis in range(6):
        columns[rows, :, layout.references.start + 6 * points.reference + axis] = of_frame[:, :, axis]
    for axis in range(3):
        columns[rows, :, layout.targets.start + 3 * points.target + axis] = flange[:, :3, axis]
    residual = seen - told + np.einsum("eij,ej->ei", noise_columns, pose_noise)
    return ExternalRows(points, residual, columns, noise_columns, *_hold(points, state, layout))


def _hold(points: ExternalPoints, state: State, layout: Layout) -> tuple[FloatArray, FloatArray]:
    precision, value = np.zeros(layout.size), np.zeros(layout.size)
    if points.first_base_from_reference is not None and points.first_target_in_flange_mm is not None:
        precision[layout.references] = np.tile([_HOLD_MM**-2] * 3 + [_HOLD_RAD**-2] * 3, layout.n_references)
        value[layout.references] = se3.log(state.base_from_reference @ se3.inverse(points.first_base_from_reference)).ravel()
        precision[layout.targets] = _HOLD_MM**-2
        value[layout.targets] = (state.target_in_flange_mm - points.first_target_in_flange_mm).ravel()
    return precision, value


def joined(spheres: Linearised, rows: ExternalRows, noise: NoiseModel) -> Linearised:
    """Sums of spheres and external points together."""
    weight = rows.points.weight / external_sigma_mm(noise) ** 2
    first = len(spheres.noise_hessian) - rows.points.n_stops
    stop = first + rows.points.stop
    noise_hessian, noise_gradient, cross = spheres.noise_hessian.copy(), spheres.noise_gradient.copy(), spheres.cross.copy()
    noise_t = np.swapaxes(rows.noise_columns, 1, 2) * weight[:, None, None]
    np.add.at(noise_hessian, stop, noise_t @ rows.noise_columns)
    np.add.at(noise_gradient, stop, (noise_t @ rows.residual_mm[..., None])[..., 0])
    np.add.at(cross, stop, noise_t @ rows.columns)
    flat = rows.columns.reshape(-1, rows.columns.shape[-1])
    weighted = flat * np.repeat(weight, 3)[:, None]
    hessian = weighted.T @ flat
    return replace(
        spheres,
        hessian=spheres.hessian + hessian + np.diag(rows.hold_precision),
        gradient=spheres.gradient + weighted.T @ rows.residual_mm.reshape(-1) + rows.hold_precision * rows.hold_value,
        data_hessian=spheres.data_hessian + hessian,
        noise_hessian=noise_hessian,
        noise_gradient=noise_gradient,
        cross=cross,
        cost=spheres.cost + float((weight * (rows.residual_mm**2).sum(axis=1)).sum() + (rows.hold_precision * rows.hold_value**2).sum()),
    )


def estimate_shared_noise(spheres: Linearised, rows: ExternalRows, start: NoiseModel, *, sweeps: int) -> NoiseModel:
    """The (s_t, s_r) of the poses and the noise of external points that make all data most likely (see `estimate_pose_noise`)."""
    believed = 3.0 * float(rows.points.weight.sum())

    def noise_of(log_sigma: FloatArray) -> NoiseModel:
        pose_mm, pose_rad, external_mm = np.exp(np.maximum(log_sigma, _SMALLEST))
        return replace(start, pose_mm=float(pose_mm), pose_rad=float(pose_rad), external_mm=float(external_mm))

    def cost(log_sigma: FloatArray) -> float:
        noise = noise_of(log_sigma)
        log_external = float(np.log(external_sigma_mm(noise)))
        surprise = (log_external - np.log(_TYPICAL_NOISE_MM)) / np.log(_TYPICAL_FACTOR)
        return marginal_cost(joined(spheres, rows, noise), noise.pose_precision) + 2 * believed * log_external + float(surprise) ** 2

    where = np.log([start.pose_mm, start.pose_rad, external_sigma_mm(start)])
    return noise_of(minimise_by_parabolas(cost, np.maximum(where, _SMALLEST), _SMALLEST, sweeps=sweeps))
