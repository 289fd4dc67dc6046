"""Errors that a feature's residuals cannot show: what is common to whole regions of the cloud, carried to all features together.

The error of the cloud is a field of displacements. Every fit answers to it linearly, patch by patch (`Response`), so one
covariance of the field at all patches gives one covariance of all parameters, and errors that two features share cancel
in their distance. The field's covariance comes from one of two sources:

* `StatedField`: one number, the standard uncertainty of a coordinate of a point. How far its errors reach is not
  known, so several lengths of correlation are tried and every result takes the worst for itself.
* `SeenField`: the calibration's covariance and pose noise, through the views that saw each patch
  (`measure.inspecting.views`). Exact to first order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivers.kinematics.se3 import FloatArray
from measure.inspecting.fitting import Fit, Response
from measure.inspecting.patches import IntArray

CORRELATION_LENGTHS_MM = (5.0, 20.0, 80.0, 320.0, np.inf)
"""Gaussian: exp(-d² / 2 l²). Short ones average out over a feature, long ones cancel in sizes; in between nothing does."""


class FieldError(Protocol):
    """What is known of the cloud's common errors."""

    @property
    def words(self) -> str:
        """Where it comes from, for people."""
        ...

    def covariances(self, responses: Sequence[Response]) -> tuple[FloatArray, ...]:
        """Candidates (P, P) of the covariance of all parameters together; the largest counts, result by result."""
        ...

    def explains(self, responses: Sequence[Response], number: int, by_patch: FloatArray) -> FloatArray:
        """(p, p) sum over G groups of the products of changes (G, p, K, 3) that answer to the patches of one of the responses."""
        ...

    def point_sigma_mm(self) -> float:
        """Of one coordinate of a typical point."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class UnknownField:
    """Nothing is known: intervals then hold for noise and form alone."""

    words: str = "nothing is stated about errors that whole regions of the cloud share"

    def covariances(self, responses: Sequence[Response]) -> tuple[FloatArray, ...]:
        """No contribution."""
        n_params = sum(response.by_patch.shape[1] for response in responses)
        return (np.zeros((n_params, n_params)),)

    def explains(self, responses: Sequence[Response], number: int, by_patch: FloatArray) -> FloatArray:
        """Nothing."""
        return _nothing(by_patch)

    def point_sigma_mm(self) -> float:
        """Nothing."""
        return 0.0


@dataclass(frozen=True, slots=True, eq=False)
class StatedField:
    """An isotropic field of one standard deviation."""

    standard_uncertainty_mm: float
    """Of one coordinate of a point."""
    words: str

    def covariances(self, responses: Sequence[Response]) -> tuple[FloatArray, ...]:
        """One for each length of correlation."""
        centres = np.concatenate([response.centre_in_part_mm for response in responses])
        squared = np.sum(centres**2, axis=1)
        distance2 = np.maximum(squared[:, None] + squared[None, :] - 2 * centres @ centres.T, 0.0)
        stacked = stack(responses)
        return tuple(self._covariance(stacked, distance2, length) for length in CORRELATION_LENGTHS_MM)

    def explains(self, responses: Sequence[Response], number: int, by_patch: FloatArray) -> FloatArray:
        """Nothing: a field whose reach nobody knows may as well be alike all over a feature."""
        return _nothing(by_patch)

    def point_sigma_mm(self) -> float:
        """As stated."""
        return self.standard_uncertainty_mm

    def _covariance(self, stacked: FloatArray, distance2: FloatArray, length_mm: float) -> FloatArray:
        correlation = np.exp(-distance2 / (2 * length_mm**2))
        found = sum(stacked[:, :, axis] @ correlation @ stacked[:, :, axis].T for axis in range(3))
        return np.asarray(self.standard_uncertainty_mm**2 * found)


@dataclass(frozen=True, slots=True, eq=False)
class SeenField:
    """A field made by M unknowns of known covariance."""

    motion: FloatArray
    """(K, 3, M) displacement of each patch of all responses, in their order, per unknown; frame of the part."""
    covariance: FloatArray
    """(M, M)."""
    words: str

    def covariances(self, responses: Sequence[Response]) -> tuple[FloatArray, ...]:
        """The one."""
        moved = np.einsum("pki,kim->pm", stack(responses), self.motion, optimize=True)
        return (np.asarray(moved @ self.covariance @ moved.T),)

    def explains(self, responses: Sequence[Response], number: int, by_patch: FloatArray) -> FloatArray:
        """As the unknowns move the groups."""
        start = sum(len(response.centre_in_part_mm) for response in responses[:number])
        motion = self.motion[start : start + by_patch.shape[2]]
        changes = np.tensordot(by_patch, motion, axes=((2, 3), (0, 1)))
        return np.asarray(np.einsum("gpm,gqm->pq", changes @ self.covariance, changes))

    def point_sigma_mm(self) -> float:
        """Rms over coordinates and patches."""
        rows = self.motion.reshape(-1, self.motion.shape[2])
        return float(np.sqrt(np.mean(np.einsum("km,km->k", rows @ self.covariance, rows))))


def _nothing(by_patch: FloatArray) -> FloatArray:
    return np.zeros((by_patch.shape[1], by_patch.shape[1]))


def residual_covariances(fits: Sequence[Fit], responses: Sequence[Response], field: FieldError) -> list[FloatArray]:
    """(p, p) of each fit by what its residuals show and the field does not explain; responses are the fits' own, in their order."""
    return [fit.covariance([field.explains(responses, number, scatter.by_patch) for scatter in fit.scatters]) for number, fit in enumerate(fits)]


def stack(responses: Sequence[Response]) -> FloatArray:
    """(P, K, 3): all responses as one, each parameter answering to the patches of its own feature."""
    n_params = sum(response.by_patch.shape[1] for response in responses)
    result = np.zeros((n_params, sum(len(response.by_patch) for response in responses), 3))
    row = column = 0
    for response in responses:
        n_patches, p, _ = response.by_patch.shape
        result[row : row + p, column : column + n_patches] = np.swapaxes(response.by_patch, 0, 1)
        row, column = row + p, column + n_patches
    return result


@dataclass(frozen=True, slots=True, eq=False)
class JointCovariance:
    """Of the parameters of all fits, in their order."""

    by_residuals: FloatArray
    """(P, P) block diagonal."""
    by_field: tuple[FloatArray, ...]
    """Candidates (P, P)."""
    by_surface: FloatArray
    """(P,) change per standard deviation of the surface's unknown optical offset."""

    def of(self, gradient: FloatArray) -> FloatArray:
        """Covariance (m, m) of m results with gradients (m, P); of the candidate that makes its trace largest."""
        surface = gradient @ self.by_surface
        common = gradient @ self.by_residuals @ gradient.T + np.outer(surface, surface)
        fields = [gradient @ field @ gradient.T for field in self.by_field]
        return np.asarray(common + max(fields, key=lambda matrix: float(np.trace(matrix))))

    def of_rows(self, rows: IntArray) -> JointCovariance:
        """Some of the parameters alone."""
        square = np.ix_(rows, rows)
        return JointCovariance(self.by_residuals[square], tuple(field[square] for field in self.by_field), self.by_surface[rows])


def joint_covariance(
    responses: Sequence[Response], by_residuals: Sequence[FloatArray], field: FieldError, surface_standard_uncertainty_mm: float
) -> JointCovariance:
    """All fits together; `by_residuals` are their own covariances (p, p)."""
    from scipy.linalg import block_diag

    outward = np.concatenate([response.outward for response in responses])
    return JointCovariance(block_diag(*by_residuals), field.covariances(responses), outward * surface_standard_uncertainty_mm)
