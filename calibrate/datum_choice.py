"""Which base a calibration is stated in where it shall be another than the nominal robot's: an earlier calibration's.

A robot that was repaired, or a cell whose programs were taught in the base of an earlier calibration, keeps that base: the
new robot is laid on the old one over the same views, or named spheres that have not moved are laid on where they were.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from calibrate.datum import Datum, References, best_fit_datum, nominal_robot_datum
from calibrate.normal import symmetric_inverse
from calibrate.problem import Problem, State
from drivers.errors import SettingsError
from drivers.kinematics import se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_LEAST_SPREAD_MM = 50.0
"""Off a line: spheres nearer to one leave the turn about it to their noise."""


class EarlierCalibration(Protocol):
    """What an earlier calibration must tell."""

    @property
    def id(self) -> str:
        """Its name for ever."""
        ...

    @property
    def model(self) -> RobotModel | None:
        """Nominal robot, None for a pose-only calibration."""
        ...

    @property
    def datum(self) -> Datum:
        """The base it is stated in."""
        ...

    @property
    def sphere_centres_in_base_mm(self) -> Mapping[str, FloatArray]:
        """Where its spheres stood."""
        ...

    def base_from_flange(self, joints_rad: ArrayLike) -> FloatArray:
        """Its robot (..., 4, 4)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class DatumChoice:
    """The base of an earlier calibration, by its robot, or by spheres that still stand where they stood."""

    earlier: EarlierCalibration
    spheres: tuple[str, ...] = ()
    """Three or more that are not in line; none for the robot."""


def stated_datum(
    choice: DatumChoice | None, problem: Problem, state: State, names: Sequence[str], covariance: FloatArray, references: References
) -> Datum:
    """The base to state results in: the nominal robot's, if nobody wants another.

    Args:
        choice: of another base.
        problem: of the solve, with a robot model.
        state: solved.
        names: of the problem's spheres.
        covariance: (P, P) of the solve, scaled.
        references: where robots are compared.

    Raises:
        SettingsError: the earlier calibration cannot lend its base.
    """
    if problem.model is None:
        raise without_axes()
    if choice is None:
        return nominal_robot_datum(problem.model, state.link_twists, references, problem.terms, state.terms_rad)
    if not choice.spheres:
        return _like_robot(choice, problem.model, problem, state)
    return _by_spheres(choice, problem, state, names, covariance, references)


def without_axes() -> SettingsError:
    """What is wrong with a wish for a base where the robot is taken as it reports."""
    remedy = "Leave --datum out, or record axis angles."
    return SettingsError("without axis angles the base is as the controller reports it", where="--datum", remedy=remedy)


def _like_robot(choice: DatumChoice, model: RobotModel, problem: Problem, state: State) -> Datum:
    """The base in which the calibrated robot is nearest to the earlier one, over the views that the earlier base was fitted over."""
    earlier, over = choice.earlier, choice.earlier.datum.references
    if earlier.model is None or not len(over.joints_rad):
        raise SettingsError(
            "a base is taken over from an earlier calibration's robot, and that one holds none",
            where="--datum",
            remedy="Name spheres that have not moved with --datum-spheres, or leave --datum out.",
        )
    if earlier.model.n_joints != model.n_joints:
        raise SettingsError(
            f"the earlier calibration is of a robot with {earlier.model.n_joints} axes, this one has {model.n_joints}",
            where="--datum",
            remedy="Name a calibration of this robot.",
        )
    found = best_fit_datum(model, state.link_twists, over, earlier.base_from_flange, problem.terms, state.terms_rad)
    return Datum("calibration", found.base_from_solver, found.references, like=earlier.id)


def _by_spheres(choice: DatumChoice, problem: Problem, state: State, names: Sequence[str], covariance: FloatArray, references: References) -> Datum:
    """The base in which named spheres are nearest to where the earlier calibration had them.

    How the base follows robot, hand-eye and camera is how the solve has the spheres follow them: their centres regressed on the
    other unknowns. What the shots' own noise adds to the centres turns and shifts the base as a whole, `Datum.noise`.
    """
    wanted = _places_mm(choice)
    missing = [name for name in choice.spheres if name not in names]
    if missing:
        raise SettingsError(f"no shot shows the sphere {missing[0]!r}", where="--datum-spheres", remedy=f"Seen were: {', '.join(names) or 'none'}.")
    rows = [list(names).index(name) for name in choice.spheres]
    solved = state.centres_in_base_mm[rows]
    base_from_solver = se3.fit_rigid(solved, wanted)
    fit = -np.linalg.pinv(se3.point_columns(solved).reshape(-1, 6))
    layout = problem.layout
    own = np.concatenate([np.arange(3) + layout.centres.start + 3 * row for row in rows])
    known = slice(0, layout.n_geometric)
    follows = covariance[own, known] @ symmetric_inverse(covariance[known, known])
    left = covariance[np.ix_(own, own)] - follows @ covariance[known, own]
    return Datum("spheres", base_from_solver, references, choice.earlier.id, choice.spheres, fit @ follows, fit @ left @ fit.T)


def _places_mm(choice: DatumChoice) -> FloatArray:
    """(k, 3) where the earlier calibration has the named spheres."""
    known = choice.earlier.sphere_centres_in_base_mm
    unknown = [name for name in choice.spheres if name not in known]
    if unknown:
        message = f"the earlier calibration has not seen the sphere {unknown[0]!r}"
        raise SettingsError(message, where="--datum-spheres", remedy=f"It has {', '.join(known) or 'none'}.")
    places = np.array([known[name] for name in choice.spheres]).reshape(-1, 3)
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False) if len(places) > 2 else np.zeros(2)
    if spread[1] < _LEAST_SPREAD_MM:
        message = f"{len(places)} spheres hold no base: three or more are needed, and not in line"
        raise SettingsError(message, where="--datum-spheres", remedy="Name more spheres, or leave --datum-spheres out to lay robot on robot.")
    return places
