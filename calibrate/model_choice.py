"""Which camera error model: left-out shots choose a field's smoothness, and the simplest model within one standard error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrate.assemble import without_pose_noise
from calibrate.camera_error import CameraError, FreeCrossing, FullPillowError, PillowError, PolynomialError
from calibrate.camera_error_field import field_variants, lateral_variants, richest_field
from calibrate.camera_error_stack import StackedModels
from calibrate.clouds import Solution, solve_clouds
from calibrate.crossing import find_crossing
from calibrate.linear_folds import Folds, full_step, held_out_miss_mm, linear_folds, noise_of
from calibrate.normal import NoiseModel
from calibrate.problem import Problem, State
from calibrate.validation import N_FOLDS, cross_validate, folds_of, squared_errors_mm2
from drivers.kinematics.se3 import FloatArray

_TYPICAL_CAP = 16.0
"""Of the median squared error: four times the typical miss, beyond any clean shot's."""


@dataclass(frozen=True, slots=True, eq=False)
class Tried:
    """A model and how it predicts shots that its solve never saw."""

    model: CameraError
    state: State
    """Where its solve on all shots ends, to first order."""
    squared_errors_mm2: FloatArray
    """(m,) of the shots' centres."""

    @property
    def rms_mm(self) -> float:
        """Over all shots."""
        return float(np.sqrt(self.squared_errors_mm2.mean()))


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The model to solve for."""

    model: CameraError
    state: State
    """Where its solve may start."""
    held_out_rms_mm: dict[str, float]
    """Of every model that was compared, by name; of a field with its best smoothness. Empty where nothing was."""


def is_open(models: Sequence[CameraError], problem: Problem) -> bool:
    """Whether the data have a say in the model: several to compare, a smoothness or a sight crossing to be found."""
    if not problem.along_sight:
        return len(models) > 1
    return len(models) > 1 or len(variants_of(models[0])) > 1 or isinstance(models[0], FreeCrossing)


def choose_model(solution: Solution, models: Sequence[CameraError]) -> Choice:
    """Compare models, the simplest first, on left-out shots, or find the sight crossing of the only one.

    Args:
        solution: with the last of the models, good enough on points that may be thinned; of profiles with all of theirs.
        models: several of which the last is a field, or one field, or one pillow with a free crossing.
    """
    if isinstance(models[-1], FreeCrossing):
        found, state = find_crossing(solution)
        return Choice(found, state, {})
    if solution.problem.along_sight:
        tried = try_families(solution, [variants_of(model) for model in models])
    else:
        tried = [_solved_with(solution, model) for model in models]
    chosen = tried[simplest_of_the_best([one.squared_errors_mm2 for one in tried])]
    return Choice(chosen.model, chosen.state, {one.model.name: one.rms_mm for one in tried} if len(tried) > 1 else {})


def _solved_with(solution: Solution, model: CameraError) -> Tried:
    """A model solved for by itself: profiles have too few points for that to take long, and no centre for folds without solves."""
    problem = replace(solution.problem, camera_error=model)
    start = replace(without_pose_noise(solution.state, problem.n_scans), camera_mm=np.zeros(len(model.prior_sigma_mm)))
    found = solve_clouds(problem, start, solution.noise)
    return Tried(model, found.state, squared_errors_mm2(cross_validate(found)))


def try_families(solution: Solution, families: Sequence[Sequence[CameraError]]) -> list[Tried]:
    """The best variant of every family, by one linearisation about one solve.

    Args:
        solution: of an area camera's problem with a polynomial field, good enough on points that may be thinned.
        families: variants of the same kind of model, all fields over the solution's box.
    """
    field = solution.problem.camera_error
    if not isinstance(field, PolynomialError):
        raise TypeError(f"models are compared about a solve with a field, not with {field.name}")
    pillows = tuple(model for family in families for model in family if isinstance(model, PillowError | FullPillowError))
    stacked = StackedModels(richest_field((field.centre_mm, field.half_size_mm)), pillows)
    folds = linear_folds(solution.problem, solution.state, solution.noise, folds_of(solution.problem, N_FOLDS), stacked)
    return [_best_of(family, solution, folds, stacked) for family in families]


def simplest_of_the_best(errors_mm2: Sequence[FloatArray]) -> int:
    """The first model whose held-out error is within one standard error (of the difference) of the best.

    Errors (m,) of each model on the same shots are capped at some times the typical one: a lone pose that no solve
    without it predicts would drown the rest.
    """
    cap = _cap(errors_mm2)
    capped = [np.minimum(error, cap) for error in errors_mm2]
    best = int(np.argmin([error.mean() for error in capped]))
    for i, error in enumerate(capped):
        difference = error - capped[best]
        if difference.mean() <= difference.std(ddof=1) / np.sqrt(len(difference)):
            return i
    return best


def capped_rms_mm(errors_mm2: Sequence[FloatArray]) -> list[float]:
    """Held-out rms of each model, errors (m,) capped as where models are compared."""
    cap = _cap(errors_mm2)
    return [float(np.sqrt(np.minimum(error, cap).mean())) for error in errors_mm2]


def _best_of(family: Sequence[CameraError], solution: Solution, folds: Folds, stacked: StackedModels) -> Tried:
    # variants of a family leave much the same pose noise, so that the middle one speaks for all
    noise = noise_of(folds, stacked.columns_of(family[len(family) // 2]), solution.noise)
    model, errors = _best_variant(family, folds, stacked, noise)
    if isinstance(model, PolynomialError) and len(family) > 1:
        model, errors = _best_variant(lateral_variants(model), folds, stacked, noise)
    columns = stacked.columns_of(model)
    problem = replace(solution.problem, camera_error=stacked)
    state, still = replace(solution.state, camera_mm=folds.camera_mm), np.zeros_like(solution.state.pose_noise)
    there = state.moved(problem.layout, full_step(folds, columns, noise), still)
    return Tried(model, replace(there, camera_mm=there.camera_mm[columns.columns]), errors)


def _best_variant(family: Sequence[CameraError], folds: Folds, stacked: StackedModels, noise: NoiseModel) -> tuple[CameraError, FloatArray]:
    errors = [_squared(held_out_miss_mm(folds, stacked.columns_of(model), noise)) for model in family]
    cap = _cap(errors)
    best = int(np.argmin([np.minimum(error, cap).mean() for error in errors]))
    return family[best], errors[best]


def _squared(miss_mm: FloatArray) -> FloatArray:
    squared = (miss_mm**2).sum(axis=1)
    finite = np.isfinite(squared)
    # where no shot is left out from which others could tell (all of one pose) nothing speaks for more than the simplest model
    return np.asarray(squared[finite]) if finite.any() else np.full(2, np.nan)


def _cap(errors_mm2: Sequence[FloatArray]) -> float:
    return _TYPICAL_CAP * min(float(np.median(error)) for error in errors_mm2)


def variants_of(model: CameraError) -> tuple[CameraError, ...]:
    """Models of the same kind among which held-out shots choose."""
    if isinstance(model, PolynomialError) and model.name == "field":
        return field_variants((model.centre_mm, model.half_size_mm))
    return (model,)
