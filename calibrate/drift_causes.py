"""Single causes of a drift, and which of them explains the residuals of a quick check.

Each cause moves the residuals along a few columns with amplitudes of physical size. Its evidence is the marginal likelihood
`N(y; 0, V + D P D')`, averaged over sizes and over the shapes that a cause may have: a cause that could have explained
anything is believed less than one that predicts what was seen (penalised likelihood, Occam's share in the determinant).
Whether anything changed at all is asked by plain tests of the residuals' chi-square, whole and along each cause.

Exactly alike, whatever the poses: axis 1 and spheres that were moved (turned about it), axis n and the camera's mounting
(turned about it). They are told together, never guessed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp
from scipy.stats import f as f_distribution

from calibrate.datum import term_columns
from calibrate.problem import Problem, State
from calibrate.quick_check import CheckResiduals
from calibrate.robot_terms import deflection_rad
from drivers.kinematics import mdh, se3
from drivers.kinematics.se3 import FloatArray

HAND_EYE, CAMERA, SPHERE, SHOT = "hand-eye", "camera", "sphere moved", "single shot"

FALSE_ALARM = 0.009
"""Chance of an alarm where nothing changed, by the sum over all tests; 1.2 % is what 940 unchanged checks of 260 cells gave (docs/check.md)."""
_ALIKE_SIGMAS, _GENEROUS = 1.5, 8.0
"""A cause that can imitate another to within so much, by sizes of up to so many times the usual ones, is told beside it."""
_SHARE = 0.025
"""Part of that for each test that names nothing: of all residuals, of axis 1, the last axis, spheres and single shots."""
_SIZES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 64.0)
"""Factors on the usual size of a cause."""
_HAND_EYE_MM, _HAND_EYE_RAD = 0.15, 4e-4
_AXIS_RAD = 2e-4
_BOW_MM = 0.1
BOW_AT_MM = 150.0
"""Distance from the camera's axis at which a bow is stated."""
_FIELD_MM = 0.05
_SPHERE_MM, _STAND_RAD = 0.2, 3e-4
_SHOT_MM = 0.5
ODDS = 0.15
"""A cause with this share of the likeliest one's probability is told beside it."""
_PRIOR_OF_SHOT = 0.2
"""Of a single spoiled shot against each lasting cause."""


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """One way in which a cause may show."""

    columns: FloatArray
    """(3 m, k) minus the motion of the residuals per unit of each change."""
    size: FloatArray
    """(k,) usual amplitudes."""
    names: tuple[str, ...]
    """(k) of the amplitudes, with units."""
    weight: float = 1.0

    @property
    def scaled(self) -> FloatArray:
        """(3 m, k) motion by the usual amplitudes."""
        return np.asarray(self.columns * self.size)


@dataclass(frozen=True, slots=True, eq=False)
class Cause:
    """What may have changed."""

    name: str
    shapes: tuple[Shape, ...]
    prior: float = 1.0
    is_named: bool = False
    """Whether a check must be able to name it: such causes share most of the chance of a false alarm."""


def causes_of(residuals: CheckResiduals, state: State, sphere_names: Sequence[str]) -> tuple[Cause, ...]:
    """Every cause that a check looks for.

    Args:
        residuals: m shots.
        state: the calibration's values.
        sphere_names: of all spheres of the calibration, by index.
    """
    problem, m = residuals.problem, residuals.n_shots
    layout = problem.layout
    twist = residuals.sensitivity[:, :, layout.hand_eye].reshape(3 * m, 6)
    parts = ("rho_x_mm", "rho_y_mm", "rho_z_mm", "phi_x_rad", "phi_y_rad", "phi_z_rad")
    size = np.array([_HAND_EYE_MM] * 3 + [_HAND_EYE_RAD] * 3)
    found = [Cause(HAND_EYE, (Shape(twist[:, :3], size[:3], parts[:3]), Shape(twist, size, parts)), is_named=True)]
    axes = axis_columns(problem, state)
    n = axes.shape[1]
    for i in range(n):
        shape = Shape(axes[:, i : i + 1], np.array([_AXIS_RAD]), (f"axis{i + 1}_rad",))
        found.append(Cause(f"axis {i + 1}", (shape,), is_named=0 < i < n - 1))
    found.append(_camera(residuals))
    found.append(_spheres(residuals, sphere_names))
    shots = tuple(
        Shape(-np.eye(3 * m)[:, 3 * j : 3 * j + 3], np.full(3, _SHOT_MM), tuple(f"shot{j}.{a}_mm" for a in "xyz"), 1.0 / m) for j in range(m)
    )
    found.append(Cause(SHOT, shots, _PRIOR_OF_SHOT))
    return tuple(found)


def axis_columns(problem: Problem, state: State) -> FloatArray:
    """(3 m, n) motion of the residuals per rad that a controller's reading of each axis is off; (3 m, 0) for pose-only data."""
    if problem.model is None or problem.joints_rad is None:
        return np.zeros((3 * problem.n_shots, 0))
    n = problem.model.n_joints
    load = np.broadcast_to(problem.model.coupling, (problem.n_shots, n, n))
    centres = state.centres_in_base_mm[problem.sphere]
    deflection = deflection_rad(problem.terms, state.terms_rad, problem.model, problem.joints_rad)
    frames = mdh.chain(problem.model, problem.joints_rad, state.link_twists, deflection)
    return term_columns(state.link_twists, frames, load, centres).reshape(3 * problem.n_shots, n)


def _camera(residuals: CheckResiduals) -> Cause:
    """A depth error that grows from the axis outwards, or any smooth one of second degree."""
    centre, m = residuals.geometry.centre_in_camera_mm, residuals.n_shots
    radius = residuals.problem.radius_mm[residuals.problem.sphere]
    seen = centre * (1 - radius / np.linalg.norm(centre, axis=1))[:, None]
    depth = residuals.geometry.base_from_camera[:, :3, 2]
    x, y, z = seen.T / BOW_AT_MM
    z = z - z.mean()
    bow = (x**2 + y**2)[:, None]
    field = np.stack([x, y, z, x**2, x * y, y**2, x * z, y * z, z**2], axis=-1)

    def moved(basis: FloatArray) -> FloatArray:
        return np.asarray(-(depth[:, :, None] * basis[:, None]).reshape(3 * m, -1))

    names = tuple(f"depth_{name}_mm" for name in ("x", "y", "z", "xx", "xy", "yy", "xz", "yz", "zz"))
    return Cause(
        CAMERA,
        (
            Shape(moved(bow), np.array([_BOW_MM]), ("bow_mm",)),
            Shape(moved(field), np.full(field.shape[1], _FIELD_MM), names),
        ),
        is_named=True,
    )


def _spheres(residuals: CheckResiduals, sphere_names: Sequence[str]) -> Cause:
    problem, m = residuals.problem, residuals.n_shots
    seen = np.unique(problem.sphere)
    shapes = []
    for i in seen:
        columns = -np.kron((problem.sphere == i)[:, None], np.eye(3))
        shapes.append(Shape(columns, np.full(3, _SPHERE_MM), tuple(f"sphere {sphere_names[i]}.{a}_mm" for a in "xyz"), 1.0 / len(seen)))
    if len(seen) > 1:
        in_base = residuals.geometry.base_from_camera @ np.concatenate([residuals.geometry.centre_in_camera_mm, np.ones((m, 1))], axis=1)[..., None]
        points = in_base[:, :3, 0]
        middle = points.mean(axis=0)
        rigid = -se3.point_columns(points - middle).reshape(3 * m, 6)
        names = tuple(f"stand.{part}" for part in ("x_mm", "y_mm", "z_mm", "about_x_rad", "about_y_rad", "about_z_rad"))
        shapes.append(Shape(rigid, np.array([_SPHERE_MM] * 3 + [_STAND_RAD] * 3), names))
    return Cause(SPHERE, tuple(shapes))


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """How well one cause explains the residuals."""

    name: str
    probability: float
    """Posterior among all causes, one of them taken to be there."""
    chi_square: float
    """What it explains at best."""
    freedom: int
    left: float
    """Chi-square of the residuals that is left after it."""
    amplitudes: dict[str, tuple[float, float]]
    """Estimate and standard uncertainty of each change of its likeliest shape: of the thing itself, a camera's as the error it now has."""
    alone: dict[str, tuple[float, float]]
    """The same of its first and simplest shape, whatever is likeliest: what can be followed from check to check."""


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """Whether something changed, and what."""

    chi_square: float
    freedom: int
    p_value: float
    """Of the least probable of all tests, each divided by its share of the chance of a false alarm."""
    log_odds: float
    """Natural logarithm of the evidence for any of the causes against that for no change."""
    explanations: tuple[Explanation, ...]
    """The likeliest first."""
    alike: tuple[str, ...] = ()
    """Other causes that could do to these shots what the likeliest one does, but for less than they show."""

    @property
    def changed(self) -> bool:
        """Whether chance alone is no explanation."""
        return bool(self.p_value < FALSE_ALARM)


def diagnose(residuals: CheckResiduals, causes: Sequence[Cause]) -> Diagnosis:
    """Test for a change, and weigh every cause."""
    factor, y = whitened(residuals)
    total, freedom = float(y @ y), len(y)
    shares = _shares(causes, factor)
    noise_freedom = residuals.noise_freedom
    p_values = [chance(total, freedom, noise_freedom) / _SHARE]
    weighed = []
    for cause, share in zip(causes, shares, strict=True):
        shapes = [weigh(shape, factor, y) for shape in cause.shapes]
        best = max(range(len(shapes)), key=lambda i: shapes[i][0])
        evidence = float(logsumexp([s[0] for s in shapes], b=np.array([shape.weight for shape in cause.shapes]) / len(cause.shapes)))
        p_values.append(min(chance(explained, k, noise_freedom) for _, explained, k, _ in shapes) * len(shapes) / share)
        weighed.append((cause, evidence + np.log(cause.prior), shapes[best], shapes[0][3]))
    log_total = float(logsumexp([evidence for _, evidence, _, _ in weighed]))
    explanations = [
        Explanation(cause.name, float(np.exp(evidence - log_total)), explained, k, total - explained, amplitudes, alone)
        for cause, evidence, (_, explained, k, amplitudes), alone in weighed
    ]
    explanations.sort(key=lambda e: -e.probability)
    alike = _alike(explanations[0], causes, factor)
    prior = sum(cause.prior for cause in causes)
    return Diagnosis(total, freedom, float(min(1.0, *p_values)), log_total - float(np.log(prior)), tuple(explanations), alike)


def whitened(residuals: CheckResiduals) -> tuple[FloatArray, FloatArray]:
    """Cholesky factor (3 m, 3 m) of the covariance where nothing changed, and the residuals (3 m,) in units of it."""
    factor: FloatArray = np.asarray(np.linalg.cholesky(residuals.covariance_mm2), dtype=np.float64)
    return factor, np.asarray(np.linalg.solve(factor, residuals.residual_mm.reshape(-1)), dtype=np.float64)


def named(diagnosis: Diagnosis, n_axes: int) -> tuple[str, ...]:
    """What a check says has changed: the likeliest cause and those that the shots cannot tell from it; nothing where nothing changed.

    Axis 1 and the last axis never stand alone: spheres turned about axis 1, and a camera turned about the last one, look the same.
    """
    if not diagnosis.changed:
        return ()
    first = diagnosis.explanations[0]
    exactly = {"axis 1": SPHERE, f"axis {n_axes}": HAND_EYE}
    told = [first.name, *(e.name for e in diagnosis.explanations[1:] if e.probability > ODDS * first.probability)]
    told += [name for name in diagnosis.alike if name not in told]
    told += [other for axis, other in exactly.items() if axis in told and other not in told]
    return tuple(told)


def _alike(likeliest: Explanation, causes: Sequence[Cause], factor: FloatArray) -> tuple[str, ...]:
    """Causes that leave less than the shots can show of the likeliest one's effect."""
    own = next(cause for cause in causes if cause.name == likeliest.name)
    shape = next(shape for shape in own.shapes if set(shape.names) == set(likeliest.amplitudes))
    change = np.array([likeliest.amplitudes[name][0] for name in shape.names])
    effect = np.linalg.solve(factor, shape.columns @ change)
    found = []
    for cause in causes:
        if cause.name not in (own.name, SHOT):
            columns = _GENEROUS * np.linalg.solve(factor, np.concatenate([s.scaled for s in cause.shapes], axis=1))
            inner = columns.T @ columns + np.eye(columns.shape[1])
            toward = columns.T @ effect
            left = float(effect @ effect - toward @ np.linalg.solve(inner, toward))
            if left < _ALIKE_SIGMAS**2:
                found.append(cause.name)
    return tuple(found)


def chance(chi_square: float, freedom: int, noise_freedom: float) -> float:
    """Of so large a chi-square by noise alone, where the size of the noise is itself an estimate."""
    return float(f_distribution.sf(chi_square / freedom, freedom, noise_freedom))


def _shares(causes: Sequence[Cause], factor: FloatArray) -> FloatArray:
    """(c,) of the chance of a false alarm: more for what is hard to see, so that the weakest cause is missed least."""
    shares = np.full(len(causes), _SHARE)
    hard = np.zeros(len(causes))
    for i, cause in enumerate(causes):
        seen = np.linalg.norm(np.linalg.solve(factor, cause.shapes[0].scaled), axis=0).min()
        hard[i] = max(float(seen), 1.0) ** -4 if cause.is_named else 0.0
    is_named = hard > 0
    if is_named.any():
        left = 1.0 - _SHARE * (1 + (~is_named).sum())
        shares[is_named] = np.maximum(left * hard[is_named] / hard.sum(), 1e-3)
    return shares


def weigh(shape: Shape, factor: FloatArray, y: FloatArray) -> tuple[float, float, int, dict[str, tuple[float, float]]]:
    """Log evidence against no change, chi-square explained, its freedom, amplitudes."""
    columns: FloatArray = np.asarray(np.linalg.solve(factor, shape.scaled), dtype=np.float64)
    u, s, vt = np.linalg.svd(columns, full_matrices=False)
    along = u.T @ y
    kept = s > 1e-9 * max(float(s[0]), 1e-300)
    logs = []
    for size in _SIZES:
        gain = (size * s[kept]) ** 2
        logs.append(0.5 * float((along[kept] ** 2 * gain / (1 + gain)).sum() - np.log1p(gain).sum()))
    evidence = float(logsumexp(logs) - np.log(len(logs)))
    # amplitudes by the likeliest size's prior: what the shots leave open stays small
    size = _SIZES[int(np.argmax(logs))]
    shrunk = size**2 * s / (1 + (size * s) ** 2)
    # residuals are minus the columns times the change: a calibration that was not told of it sees the opposite
    estimate = -vt.T @ (shrunk * along) * shape.size
    spread = size**2 * (np.eye(len(shape.size)) - (vt.T * (s * shrunk)) @ vt)
    sigma = np.sqrt(np.maximum(np.diagonal(spread), 0.0)) * shape.size
    amplitudes = {name: (float(v), float(u_)) for name, v, u_ in zip(shape.names, estimate, sigma, strict=True)}
    return evidence, float((along[kept] ** 2).sum()), int(kept.sum()), amplitudes
