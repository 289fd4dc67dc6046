"""Which terms beyond link twists the arm gets: only those that predict left-out shots better (METHOD.md 4, *Further physics*).

One linearisation about a solve carries all candidates at once (see `linear_folds`). Errors of the transmissions are many:
a score test first picks the few that the data speak of at all; held-out shots then have the last word.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibrate import normal
from calibrate.camera_error import CameraError
from calibrate.camera_error_stack import Columns
from calibrate.clouds import Solution
from calibrate.linear_folds import Folds, held_out_miss_mm, linear_folds, linearised_at, noise_of
from calibrate.normal import Linearised, NoiseModel, Reduced
from calibrate.polynomials import Polynomials
from calibrate.problem import Problem, State, linearise_geometry
from calibrate.robot_terms import RobotTerm, candidate_groups, load_basis
from calibrate.validation import N_FOLDS, folds_of
from drivers.kinematics.se3 import FloatArray

_FEWEST_SHOTS = 40
_LOUD_CHI2 = 30.0
"""A pair of terms that is not there exceeds it in three of ten million cases, of about 200 that are looked at."""
_LOUD_ABOVE_MEDIAN = 8.0
_MOST_GROUPS, _MOST_TRIED = 4, 6
_WIN_SIGMAS = 3.0
"""How many standard errors a group's held-out squared error must be smaller by: doubtful terms stay considered only. A pair was
picked among two hundred; at two errors compliance that hardly counts came and went from one calibration of a cell to the next, and
places moved by 0.04 mm with it."""


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """What held-out shots want."""

    names: tuple[str, ...]
    """Groups that won, in their order."""
    terms: tuple[RobotTerm, ...]
    """All terms of the arm: those that won are estimated, the others only considered."""
    held_out_rms_mm: Mapping[str, float]
    """Without any, and after each that won; empty where none did."""


NO_CHOICE = Choice((), (), {})


def choose_terms(solution: Solution) -> Choice:
    """Add the group of terms that makes held-out errors smallest, as long as it wins clearly.

    Args:
        solution: of an area camera's shots with axis angles; points may be thinned.
    """
    problem = solution.problem
    if problem.model is None or problem.joints_rad is None or problem.n_shots < _FEWEST_SHOTS or not problem.along_sight:
        return NO_CHOICE
    groups = candidate_groups(problem.model)
    scores = _scores(solution, groups)
    won: tuple[str, ...] = ()
    rms: dict[str, float] = {}
    noise = solution.noise
    while len(won) < _MOST_GROUPS:
        loud = scores.loud(won, noise)
        contest = _contest(solution, _terms_of(groups, (*won, *loud)))
        errors = contest.squared_errors_mm2(_terms_of(groups, won))
        rms = rms or {f"{problem.camera_error.name}, rigid arm": float(np.sqrt(errors.mean()))}
        tried = {name: contest.squared_errors_mm2(_terms_of(groups, (*won, name))) for name in loud}
        best = min(tried, key=lambda name: float(tried[name].mean()), default=None)
        if best is None or not _wins(errors, tried[best]):
            break
        won = (*won, best)
        noise = contest.noise_left(_terms_of(groups, won))
        rms[f"with {best}"] = float(np.sqrt(tried[best].mean()))
    estimated = _terms_of(groups, won)
    kept = tuple(term for term in problem.terms if replace(term, estimated=True) not in estimated)
    return Choice(won, kept + estimated, rms) if won else NO_CHOICE


def with_terms(problem: Problem, terms: tuple[RobotTerm, ...]) -> Problem:
    """The problem with other terms of the arm."""
    if problem.model is None or problem.joints_rad is None:
        return problem
    external = problem.external
    if external is not None:
        external = replace(external, load=load_basis(terms, problem.model, external.joints_rad))
    return replace(problem, terms=terms, load=load_basis(terms, problem.model, problem.joints_rad), external=external)


@dataclass(frozen=True, slots=True, eq=False)
class _Scores:
    """Normal equations with all candidates at a solution that has none of them."""

    groups: Mapping[str, tuple[RobotTerm, ...]]
    linearised: Linearised
    free: NDArray[np.bool_]
    """(P,) unknowns of the solution itself."""
    place: Mapping[RobotTerm, int]

    def loud(self, won: tuple[str, ...], noise: NoiseModel) -> tuple[str, ...]:
        """Groups that the data may speak of, once those that won are estimated: the large ones, and pairs that stand out."""
        reduced, free = normal.reduce(self.linearised, noise.pose_precision), self.free.copy()
        free[[self.place[term] for term in _terms_of(self.groups, won)]] = True
        inverse = normal.symmetric_inverse(reduced.hessian[np.ix_(free, free)])
        score = {name: self._chi2(terms, reduced, free, inverse) for name, terms in self.groups.items() if name not in won}
        pairs = [value for name, value in score.items() if len(self.groups[name]) == 2]
        least = max(_LOUD_CHI2, _LOUD_ABOVE_MEDIAN * float(np.median(pairs)))
        large = [name for name in score if len(self.groups[name]) > 2]
        loudest = sorted((name for name in score if name not in large and score[name] > least), key=lambda name: -score[name])
        return tuple(large + loudest[:_MOST_TRIED])

    def _chi2(self, terms: tuple[RobotTerm, ...], reduced: Reduced, free: NDArray[np.bool_], inverse: FloatArray) -> float:
        """Score statistic: how much the cost would fall, to first order."""
        at = np.array([self.place[term] for term in terms])
        cross = reduced.hessian[np.ix_(free, at)]
        gradient = reduced.gradient[at] - cross.T @ (inverse @ reduced.gradient[free])
        left = reduced.hessian[np.ix_(at, at)] - cross.T @ inverse @ cross
        return float(gradient @ np.linalg.pinv(left, hermitian=True) @ gradient)


def _scores(solution: Solution, groups: Mapping[str, tuple[RobotTerm, ...]]) -> _Scores:
    terms = tuple(dict.fromkeys(term for group in groups.values() for term in group))
    problem, state = _with_candidates(solution, terms)
    linearised, _, _ = linearised_at(problem, state, linearise_geometry(problem, state), solution.noise)
    layout, free = problem.layout, np.ones(problem.layout.size, dtype=bool)
    free[layout.terms] = False
    place = {term: layout.terms.start + i for i, term in enumerate(terms)}
    return _Scores(groups, linearised, free, place)


@dataclass(frozen=True, slots=True, eq=False)
class _Contest:
    """A linearisation by folds with a few candidates, and who is allowed to move in it."""

    terms: tuple[RobotTerm, ...]
    where: slice
    folds: Folds
    camera: Columns
    noise: NoiseModel

    def squared_errors_mm2(self, chosen: tuple[RobotTerm, ...]) -> FloatArray:
        """(m,) of held-out centres with some terms estimated, the pose noise being what they leave."""
        folds, noise = self._with(chosen), self.noise_left(chosen)
        squared = (held_out_miss_mm(folds, self.camera, noise) ** 2).sum(axis=1)
        return np.asarray(squared[np.isfinite(squared)])

    def noise_left(self, chosen: tuple[RobotTerm, ...]) -> NoiseModel:
        """The noise model with the pose noise that some terms leave."""
        return noise_of(self._with(chosen), self.camera, self.noise)

    def _with(self, chosen: tuple[RobotTerm, ...]) -> Folds:
        free = self.folds.free.copy()
        free[self.where] = [term in chosen for term in self.terms]
        return replace(self.folds, free=free)


def _contest(solution: Solution, terms: tuple[RobotTerm, ...]) -> _Contest:
    problem, state = _with_candidates(solution, terms)
    camera = _OneModel(problem.camera_error)
    folds = linear_folds(problem, state, solution.noise, folds_of(problem, N_FOLDS), camera)
    return _Contest(terms, problem.layout.terms, folds, camera.columns, solution.noise)


def _with_candidates(solution: Solution, terms: tuple[RobotTerm, ...]) -> tuple[Problem, State]:
    return with_terms(solution.problem, terms), replace(solution.state, terms_rad=np.zeros(len(terms)))


@dataclass(frozen=True, slots=True)
class _OneModel:
    """A camera model whose prior is taken with its columns, as `linear_folds` wants it."""

    model: CameraError
    name: str = "one"

    @property
    def axis(self) -> NDArray[np.int64]:
        return self.model.axis

    @property
    def prior_sigma_mm(self) -> FloatArray:
        return np.full(len(self.model.axis), np.inf)

    @property
    def polynomials(self) -> Polynomials:
        return self.model.polynomials

    @property
    def columns(self) -> Columns:
        return Columns(np.arange(len(self.model.axis)), self.model.prior_sigma_mm)

    def basis(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        return self.model.basis(points_in_camera_mm)

    def settings(self) -> dict[str, object]:
        return self.model.settings()

    def coefficients_mm(self, model: CameraError, camera_mm: FloatArray) -> FloatArray:
        return camera_mm


def _terms_of(groups: Mapping[str, tuple[RobotTerm, ...]], names: tuple[str, ...]) -> tuple[RobotTerm, ...]:
    return tuple(term for name in names for term in groups[name])


def _wins(before_mm2: FloatArray, after_mm2: FloatArray) -> bool:
    gain = before_mm2 - after_mm2
    return bool(gain.mean() > _WIN_SIGMAS * gain.std(ddof=1) / np.sqrt(len(gain)))
