"""Robot physics beyond constant link twists: axes that yield under gravity, and errors of their transmissions.

Each term adds `coefficient * shape(q)` to the angle of one axis (transmissions: to what that axis' motor drives).
Compliance: the shape is gravity's torque about the axis for a mass at one place of the arm, in units of the torque at full
horizontal stretch, so that the coefficient is the deflection in rad there (compliance models with a few stiffnesses:
Nubiola and Bonev 2013; Icli and Bonev 2020).
Transmission: sine and cosine of the axis angle, once a turn or more often (eccentric gears and encoders, teeth).
Linkage: a parallelogram drives an axis, and its bars are not of equal length in pairs. With x the angle by which the
cranks are away from square to the arm, closing the four bars gives to first order
`(crank difference tan x - rod difference / cos x) / crank`.

A term is estimated only where held-out shots want it. Where they do not, it is *considered* (Schmidt's consider
parameters): its coefficient stays zero and its prior goes into the covariance, so that lengths at places with another
load carry what is not known of the arm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

HIGHEST_ORDER = 30
"""Cycles per turn up to which errors of a transmission are looked for."""
_STRETCHED_RAD = 1.3
"""A parallelogram folds up beyond this; robots keep away from it."""

TermKind = Literal["compliance", "sine", "cosine", "tangent", "secant"]


@dataclass(frozen=True, slots=True)
class RobotTerm:
    """One term of the arm's deflection."""

    kind: TermKind
    axis: int
    """Index of the axis whose angle it changes."""
    order: int
    """Compliance: the link frame at which the mass sits (n is the flange). Transmission: cycles per turn. Linkage: unused."""
    estimated: bool = False
    """Whether the term is an unknown of the solve; else it stays zero and is only considered in the covariance."""

    @property
    def name(self) -> str:
        """For files and tables; axes and links counted from 1."""
        what = {"compliance": f"mass_at_link{self.order}", "tangent": "cranks", "secant": "rods"}.get(self.kind, f"{self.order}_per_turn")
        return f"{self.kind}.axis{self.axis + 1}.{what}"


def arm_terms(model: RobotModel) -> tuple[RobotTerm, ...]:
    """Every term that an arm can have.

    Payload on every axis but the first and the last (a vertical axis feels no gravity, the flange has no lever), the
    forearm's own mass on the two axes that carry it, and a transmission error once a turn on every axis.
    """
    n = model.n_joints
    payload = [RobotTerm("compliance", axis, n) for axis in range(1, n - 1)]
    forearm = [RobotTerm("compliance", axis, 4) for axis in (1, 2)] if n > 4 else []
    kinds: tuple[TermKind, TermKind] = ("sine", "cosine")
    transmission = [RobotTerm(kind, axis, 1) for axis in range(n) for kind in kinds]
    return tuple(payload + forearm + transmission)


def candidate_groups(model: RobotModel) -> dict[str, tuple[RobotTerm, ...]]:
    """Terms that held-out shots may ask for, by the name of what they stand for; each group wins or loses as a whole."""
    groups = {"compliance": tuple(replace(term, estimated=True) for term in arm_terms(model) if term.kind == "compliance")}
    coupled = (model.coupling != np.diag(np.diagonal(model.coupling))).any(axis=1)
    for axis in np.flatnonzero(coupled).tolist():
        groups[f"linkage of axis {axis + 1}"] = (RobotTerm("tangent", axis, 1, True), RobotTerm("secant", axis, 1, True))
    for axis in range(model.n_joints):
        for order in range(1, HIGHEST_ORDER + 1):
            groups[f"axis {axis + 1}, {order} a turn"] = (RobotTerm("sine", axis, order, True), RobotTerm("cosine", axis, order, True))
    return groups


def load_basis(terms: tuple[RobotTerm, ...], model: RobotModel, joints_rad: ArrayLike) -> FloatArray:
    """(m, n, K) change of every link angle per unit coefficient, for q (m, n), on the nominal geometry."""
    q = np.asarray(joints_rad, dtype=np.float64)
    result = np.zeros((*q.shape, len(terms)))
    if not terms:
        return result
    frames = mdh.chain(model, q)[..., 1:, :, :]
    for k, term in enumerate(terms):
        # a transmission turns what its motor drives: on coupled axes more than one link angle
        driven = model.coupling[:, term.axis] if term.kind in {"sine", "cosine"} else np.eye(model.n_joints)[term.axis]
        result[..., k] = _shape(term, model, q, frames)[..., None] * driven
    return result


def _shape(term: RobotTerm, model: RobotModel, q: FloatArray, frames: FloatArray) -> FloatArray:
    match term.kind:
        case "compliance":
            return _relative_torque(term, model, frames)
        case "sine":
            return np.asarray(np.sin(term.order * q[..., term.axis]))
        case "cosine":
            return np.asarray(np.cos(term.order * q[..., term.axis]))
    away = np.clip((q @ model.coupling.T)[..., term.axis], -_STRETCHED_RAD, _STRETCHED_RAD)
    return np.asarray(np.tan(away) if term.kind == "tangent" else 1.0 / np.cos(away))


def deflection_rad(terms: tuple[RobotTerm, ...], coefficients_rad: FloatArray, model: RobotModel, joints_rad: ArrayLike) -> FloatArray | None:
    """(m, n) to be added to the link angles; None where every coefficient is zero."""
    if not len(coefficients_rad) or not coefficients_rad.any():
        return None
    return np.asarray(load_basis(terms, model, joints_rad) @ coefficients_rad)


def _relative_torque(term: RobotTerm, model: RobotModel, frames: FloatArray) -> FloatArray:
    axes, origins = frames[..., :3, 2], frames[..., :3, 3]
    lever = origins[..., term.order - 1, :] - origins[..., term.axis, :]
    torque = (axes[..., term.axis, :] * np.cross(lever, [0.0, 0.0, -1.0])).sum(axis=-1)
    reach = np.hypot(model.a_mm, model.d_mm)[term.axis + 1 : term.order].sum()
    return np.asarray(torque / reach if reach > 0 else np.zeros_like(torque))
