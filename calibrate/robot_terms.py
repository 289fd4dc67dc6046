"""Robot physics beyond constant link twists: axes that yield under gravity, and errors of their transmissions.

Each term adds `coefficient * shape(q)` to the angle of one axis. Compliance: the shape is gravity's torque about the
axis for a mass at one place of the arm, in units of the torque at full horizontal stretch, so that the coefficient is
the deflection in rad there (compliance models with a few stiffnesses: Nubiola and Bonev 2013; Icli and Bonev 2020).
Transmission: sine and cosine of the axis angle, once a turn (eccentric gears and encoders).

A term is estimated only where held-out shots want it. Where they do not, it is *considered* (Schmidt's consider
parameters): its coefficient stays zero and its prior goes into the covariance, so that lengths at places with another
load carry what is not known of the arm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

TermKind = Literal["compliance", "sine", "cosine"]


@dataclass(frozen=True, slots=True)
class RobotTerm:
    """One term of the arm's deflection."""

    kind: TermKind
    axis: int
    """Index of the axis whose angle it changes."""
    order: int
    """Compliance: the link frame at which the mass sits (n is the flange). Transmission: cycles per turn."""

    @property
    def name(self) -> str:
        """For files and tables; axes and links counted from 1."""
        what = f"mass_at_link{self.order}" if self.kind == "compliance" else f"{self.order}_per_turn"
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


def load_basis(terms: tuple[RobotTerm, ...], model: RobotModel, joints_rad: ArrayLike) -> FloatArray:
    """(m, n, K) change of every link angle per unit coefficient, for q (m, n), on the nominal geometry."""
    q = np.asarray(joints_rad, dtype=np.float64)
    result = np.zeros((*q.shape, len(terms)))
    if not terms:
        return result
    frames = mdh.chain(model, q)[..., 1:, :, :]
    for k, term in enumerate(terms):
        if term.kind == "compliance":
            result[..., term.axis, k] = _relative_torque(term, model, frames)
        else:
            result[..., term.axis, k] = (np.sin if term.kind == "sine" else np.cos)(term.order * q[..., term.axis])
    return result


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
