"""From per-shot moments to normal equations: priors, certified lengths, and pose noise eliminated by Schur complement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrate.camera_error import CameraError, PolynomialError
from calibrate.problem import Geometry, Problem, State
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

_HELD_RAD = 1e-12
_HELD_UP = 1e-12
_GAUGE_HELD = 1e3
PATCHES = 12
"""Independent patches that a shot's form error is counted as."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Standard deviations of what is not estimated."""

    point_mm: float
    """Random noise of one point along its normal."""
    pose_mm: float
    """s_t: translation of the flange per scan, each axis."""
    pose_rad: float
    """s_r: rotation of the flange per scan, each axis."""
    form_mm: float = 0.0
    """What the model leaves of a sphere's shape, the same over a patch: more points do not average it out."""
    external_mm: float = 0.0
    """Random noise of an external point on each axis; zero where there was none to estimate it from."""
    flat: float = 1.0
    """A point's variance is point_mm² times flat + steep cos², at an angle of incidence; 1 on average."""
    steep: float = 0.0
    range_power: float = 0.0
    """Noise grows with this power of the range, point_mm being that at `range_mm`."""
    range_mm: float = 350.0

    @property
    def pose_precision(self) -> FloatArray:
        """(6,) inverse variances of a nuisance twist."""
        return np.array([self.pose_mm**-2] * 3 + [self.pose_rad**-2] * 3)

    def point_sigma_mm(self, range_mm: FloatArray) -> FloatArray:
        """(m,) noise of a point of average incidence at some ranges."""
        return np.asarray(self.point_mm * (range_mm / self.range_mm) ** self.range_power)

    def point_weight(self, n_points: FloatArray, range_mm: FloatArray | None = None) -> FloatArray:
        """(m,) weight in mm^-2 of one point in shots of so many points: noise at their range, and form error by patches."""
        sigma_mm = self.point_mm if range_mm is None else self.point_sigma_mm(range_mm)
        return np.asarray(1.0 / (sigma_mm**2 + n_points / PATCHES * self.form_mm**2))


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """All sums of one linearisation that do not depend on the pose-noise model; points in units of their sigma.

    P unknowns, G scans. Gradients are of the cost, so steps solve `hessian @ step = -gradient`.
    """

    hessian: FloatArray
    """(P, P) with priors and lengths."""
    gradient: FloatArray
    """(P,)."""
    data_hessian: FloatArray
    """(P, P) of points and lengths alone."""
    noise_hessian: FloatArray
    """(G, 6, 6) without prior."""
    noise_gradient: FloatArray
    """(G, 6) without prior."""
    cross: FloatArray
    """(G, 6, P)."""
    pose_noise: FloatArray
    """(G, 6) current nuisances."""
    cost: float
    """Sum of squares at the state, without the nuisance prior."""


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """Normal equations after the pose noise is eliminated."""

    hessian: FloatArray
    gradient: FloatArray
    noise_inverse: FloatArray
    """(G, 6, 6)."""
    noise_gradient: FloatArray
    """(G, 6) with prior."""
    log_determinant: float
    """Of the nuisances: sum over scans of log |K_g| - log |prior precision|."""
    cost: float
    """Minimum over the nuisances, unknowns held."""


def linearise(problem: Problem, state: State, geometry: Geometry, moments: FloatArray, weight: FloatArray) -> Linearised:
    """Assemble moments (m, v, v) of all shots at a state; weight (m,) of one point of each shot, in mm^-2."""
    scaled = moments * weight[:, None, None]
    inner, edge = scaled[:, :-1, :-1], scaled[:, :-1, -1]
    weighted = inner @ geometry.columns
    # three-factor sums as plain matrix products: einsum would not find them
    flat = geometry.columns.reshape(-1, geometry.columns.shape[-1])
    data_hessian = flat.T @ weighted.reshape(flat.shape)
    gradient = flat.T @ edge.reshape(-1)
    noise_t = np.swapaxes(geometry.noise_columns, -1, -2)
    n_scans = problem.n_scans
    noise_hessian = _sum_by_scan(noise_t @ inner[:, :3, :3] @ geometry.noise_columns, problem.scan, n_scans)
    noise_gradient = _sum_by_scan((noise_t @ edge[:, :3, None])[..., 0], problem.scan, n_scans)
    cross = _sum_by_scan(noise_t @ weighted[:, :3], problem.scan, n_scans)
    length_hessian, length_gradient, length_cost = _lengths(problem, state)
    prior_hessian, prior_value = _priors(problem, state)
    data_hessian = data_hessian + length_hessian
    return Linearised(
        hessian=data_hessian + prior_hessian,
        gradient=gradient + length_gradient + prior_hessian @ prior_value,
        data_hessian=data_hessian,
        noise_hessian=noise_hessian,
        noise_gradient=noise_gradient,
        cross=cross,
        pose_noise=state.pose_noise,
        cost=float(scaled[:, -1, -1].sum() + length_cost + prior_value @ prior_hessian @ prior_value),
    )


def held_poses(problem: Problem, state: State, jacobian: FloatArray, miss_mm: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Hessian (P, P) and gradient (P,) of centres that miss by (m, 3), all directions known alike, where poses have no noise.

    `jacobian` (m, 3, P) is that of the misses, `weight` (m,) in mm^-2; the problem's priors and lengths are added.
    """
    root = np.sqrt(weight)
    rows = (jacobian * root[:, None, None]).reshape(-1, jacobian.shape[-1])
    length_hessian, length_gradient, _ = _lengths(problem, state)
    prior_hessian, prior_value = _priors(problem, state)
    hessian = rows.T @ rows + length_hessian + prior_hessian
    gradient = rows.T @ (miss_mm * root[:, None]).reshape(-1) + length_gradient + prior_hessian @ prior_value
    return hessian, gradient


def reduce(linearised: Linearised, pose_precision: FloatArray, scan_weight: FloatArray | None = None) -> Reduced:
    """Eliminate the nuisances; `scan_weight` (G,) in [0, 1] weakens the prior of scans that look spoiled."""
    precision = np.broadcast_to(pose_precision, linearised.pose_noise.shape)
    if scan_weight is not None:
        precision = precision * scan_weight[:, None]
    diagonal = np.zeros_like(linearised.noise_hessian)
    rows = np.arange(6)
    diagonal[:, rows, rows] = precision
    # scaled to unit diagonal before inverting: mm and rad differ by 1e8 in variance
    k = linearised.noise_hessian + diagonal
    scale = 1.0 / np.sqrt(k[:, rows, rows])
    scaled = k * scale[:, :, None] * scale[:, None, :]
    inverse = np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :]
    noise_gradient = linearised.noise_gradient + precision * linearised.pose_noise
    gain = inverse @ linearised.cross
    flat_cross = linearised.cross.reshape(-1, linearised.cross.shape[-1])
    hessian = linearised.hessian - flat_cross.T @ gain.reshape(flat_cross.shape)
    solved = (inverse @ noise_gradient[..., None])[..., 0]
    gradient = linearised.gradient - flat_cross.T @ solved.reshape(-1)
    _, log_det = np.linalg.slogdet(scaled)
    log_determinant = float((log_det - 2 * np.log(scale).sum(axis=1)).sum() - np.log(precision).sum())
    cost = linearised.cost + float((precision * linearised.pose_noise**2).sum() - (noise_gradient * solved).sum())
    return Reduced(hessian, gradient, inverse, noise_gradient, log_determinant, cost)


def solve_step(linearised: Linearised, reduced: Reduced, damping: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton step of the unknowns (P,) and of the nuisances (G, 6), with a precision (P,) that holds unknowns where they are."""
    hessian = reduced.hessian if damping is None else reduced.hessian + np.diag(damping)
    step = -symmetric_solve(hessian, reduced.gradient)
    right = reduced.noise_gradient + linearised.cross @ step
    return step, -(reduced.noise_inverse @ right[..., None])[..., 0]


def symmetric_solve(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Least-norm solution in scaled coordinates of a symmetric, possibly singular system (rank-revealing)."""
    return np.asarray(symmetric_inverse(matrix) @ right)


def symmetric_inverse(matrix: FloatArray, relative: float = 1e-13) -> FloatArray:
    """Pseudo-inverse of a symmetric matrix after scaling to unit diagonal; directions below `relative` are left alone."""
    diagonal = np.diagonal(matrix)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(matrix * scale[:, None] * scale)
    keep = values > relative * values[-1]
    kept = vectors[:, keep]
    return np.asarray((kept / values[keep]) @ kept.T * scale[:, None] * scale)


class MarginalCost:
    """-2 log marginal likelihood of pose-noise models (REML: unknowns and nuisances integrated out), up to a constant."""

    def __init__(self, linearised: Linearised) -> None:
        """Of the sums of one linearisation; the gradient rides along with the columns of the unknowns."""
        self._sums = linearised
        self._rows = np.concatenate([linearised.cross, linearised.noise_gradient[..., None]], axis=-1)
        # kept from call to call: fresh memory costs more than the sums
        self._white = np.empty(self._rows.shape)
        self._whole = np.block([[linearised.hessian, linearised.gradient[:, None]], [linearised.gradient[None], np.full((1, 1), linearised.cost)]])

    def __call__(self, pose_precision: FloatArray) -> float:
        """At inverse variances (6,) of a nuisance twist."""
        from calibrate.normal_kernels import whiten

        sums = self._sums
        self._rows[:, :, -1] = sums.noise_gradient + pose_precision * sums.pose_noise
        log_determinant = whiten(sums.noise_hessian, pose_precision, self._rows, self._white)
        flat = self._white.reshape(-1, self._rows.shape[-1])
        left = self._whole - flat.T @ flat
        hessian, gradient = left[:-1, :-1], left[:-1, -1]
        cost = left[-1, -1] + float((pose_precision * sums.pose_noise**2).sum())
        diagonal = np.diagonal(hessian)
        scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        # the last term keeps directions that nothing determines out of the comparison: they add a constant
        scaled = hessian * scale[:, None] * scale + _HELD_UP * np.eye(len(scale))
        right = scale * gradient
        log_det = float(np.linalg.slogdet(scaled)[1] - 2 * np.log(scale).sum())
        log_prior = len(sums.pose_noise) * float(np.log(pose_precision).sum())
        return float(log_determinant - log_prior + log_det + cost - right @ np.linalg.solve(scaled, right))


def marginal_cost(linearised: Linearised, pose_precision: FloatArray) -> float:
    """One value of `MarginalCost`."""
    return MarginalCost(linearised)(pose_precision)


def _sum_by_scan(per_shot: FloatArray, scan: NDArray[np.int64], n_scans: int) -> FloatArray:
    if len(scan) == n_scans and bool((scan == np.arange(n_scans)).all()):
        return per_shot
    result = np.zeros((n_scans, *per_shot.shape[1:]))
    np.add.at(result, scan, per_shot)
    return result


def _lengths(problem: Problem, state: State) -> tuple[FloatArray, FloatArray, float]:
    layout = problem.layout
    hessian, gradient, cost = np.zeros((layout.size, layout.size)), np.zeros(layout.size), 0.0
    for length in problem.lengths:
        difference = state.centres_in_base_mm[length.first] - state.centres_in_base_mm[length.second]
        distance = float(np.linalg.norm(difference))
        row = np.zeros(layout.size)
        for index, sign in ((length.first, 1.0), (length.second, -1.0)):
            start = layout.centres.start + 3 * index
            row[start : start + 3] = sign * difference / distance / length.sigma_mm
        residual = (distance - length.length_mm) / length.sigma_mm
        hessian += np.outer(row, row)
        gradient += row * residual
        cost += residual**2
    return hessian, gradient, cost


def physical_precision(problem: Problem) -> FloatArray:
    """(P,) inverse variances of the size that unknowns may physically have, centres and a hand-eye without first guess included."""
    layout, priors = problem.layout, problem.priors
    precision = np.full(layout.size, priors.hand_eye_mm**-2)
    precision[layout.links] = np.tile([priors.link_rho_mm**-2] * 3 + [priors.link_phi_rad**-2] * 3, layout.n_links)
    precision[layout.hand_eye] = [priors.hand_eye_mm**-2] * 3 + [priors.hand_eye_rad**-2] * 3
    precision[layout.camera] = problem.camera_error.prior_sigma_mm**-2.0
    precision[layout.terms] = priors.term_sigma_rad(problem.terms) ** -2.0
    precision[layout.radius_offset] = priors.radius_offset_mm**-2
    precision[layout.sphere_radius] = problem.radius_sigma_mm**-2.0
    return precision


def gauge_precision(model: CameraError) -> FloatArray:
    """(k, k) inverse variances that hold what a camera field turns every point by: the hand-eye transform turns them as well.

    The priors alone choose among the fields that differ by a turn, N, and they choose the one with N' P c = 0. They are so
    weak there that what the linearisation leaves of the data outweighed them: a solve of good data then drifted along the
    turn for ever. Holding N' P c at zero a thousand times as hard changes no minimum, and the drift has no room.
    """
    precision = np.asarray(model.prior_sigma_mm, dtype=np.float64) ** -2.0
    if not isinstance(model, PolynomialError):
        return np.zeros((len(precision), len(precision)))
    weighted = precision[:, None] * model.turns
    return np.asarray(_GAUGE_HELD * weighted @ np.linalg.inv(model.turns.T @ weighted) @ weighted.T)


def _priors(problem: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    """Inverse covariance (P, P) and current values (P,) of the unknowns that have a prior."""
    layout, precision = problem.layout, physical_precision(problem)
    value = np.zeros(layout.size)
    precision[layout.centres.start :] = 0.0
    value[layout.links] = state.link_twists.ravel()
    if problem.first_flange_from_camera is None:
        precision[layout.hand_eye] = 0.0
    else:
        value[layout.hand_eye] = se3.log(state.flange_from_camera @ se3.inverse(problem.first_flange_from_camera))
    value[layout.camera] = state.camera_mm
    # terms that are not estimated are held by a prior that no data can move
    precision[layout.terms] = np.where(problem.free_terms, precision[layout.terms], _HELD_RAD**-2)
    value[layout.terms] = state.terms_rad
    value[layout.radius_offset] = state.radius_offset_mm
    value[layout.sphere_radius] = state.sphere_radius_deviation_mm
    hessian = np.diag(precision)
    hessian[layout.camera, layout.camera] += gauge_precision(problem.camera_error)
    return hessian, value
