"""Several camera error models side by side, for one linearisation that serves them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibrate.camera_error import CameraError, FullPillowError, PillowError, PolynomialError
from calibrate.camera_error_pillow import PILLOW_SCALE_MM
from calibrate.polynomials import Polynomials, Term, legendre
from drivers.kinematics.se3 import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """A camera model as a choice of stacked columns, with its own prior."""

    columns: NDArray[np.int64]
    """(k,) of the stacked terms."""
    prior_sigma_mm: FloatArray
    """(k,)."""


@dataclass(frozen=True, slots=True, eq=False)
class StackedModels:
    """The terms of a polynomial field and of pillows, without priors: columns to choose from, no model to be solved for."""

    field: PolynomialError
    pillows: tuple[PillowError | FullPillowError, ...] = ()
    name: str = "stacked"

    @property
    def axis(self) -> NDArray[np.int64]:
        """The field's, then the pillows'."""
        return np.concatenate([model.axis for model in (self.field, *self.pillows)])

    @property
    def prior_sigma_mm(self) -> FloatArray:
        """Infinite."""
        return np.full(len(self.axis), np.inf)

    def basis(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        """(n, k) of all models."""
        return np.concatenate([model.basis(points_in_camera_mm) for model in (self.field, *self.pillows)], axis=1)

    @property
    def polynomials(self) -> Polynomials:
        """One table of Legendre products; the pillows are the same inside the field's box, and tame outside it."""
        own: list[Term] = [(axis, [(1.0, degrees)]) for axis, degrees in self.field.terms]
        converted = [_in_legendre(term, pillow.sight_crossing_mm, self.field) for pillow in self.pillows for term in pillow.terms]
        return legendre(own + converted, self.field.centre_mm, self.field.half_size_mm)

    def settings(self) -> dict[str, object]:
        """Never written to a file."""
        return {"model": self.name}

    def columns_of(self, model: CameraError) -> Columns:
        """The columns of a model that is stacked, or of a field over the same box that the stacked one holds."""
        if isinstance(model, PolynomialError):
            place = {term: column for column, term in enumerate(self.field.terms)}
            return Columns(np.array([place[term] for term in model.terms], dtype=np.int64), model.prior_sigma_mm)
        first = len(self.field.axis)
        for pillow in self.pillows:
            if model == pillow:
                return Columns(first + np.arange(len(pillow.axis)), pillow.prior_sigma_mm)
            first += len(pillow.axis)
        return Columns(np.zeros(0, dtype=np.int64), np.zeros(0))

    def coefficients_mm(self, model: CameraError, camera_mm: FloatArray) -> FloatArray:
        """(k,) stacked coefficients of a model's own."""
        result = np.zeros(len(self.axis))
        result[self.columns_of(model).columns] = camera_mm
        return result


def _in_legendre(term: Term, crossing_mm: Sequence[float], field: PolynomialError) -> Term:
    """A term in powers of (point - crossing) / L as Legendre products over a field's box."""
    axis, entries = term
    highest = max(max(degrees) for _, degrees in entries)
    by_axis = [
        _powers_in_legendre(highest, (centre - crossing) / PILLOW_SCALE_MM, half / PILLOW_SCALE_MM)
        for centre, crossing, half in zip(field.centre_mm, crossing_mm, field.half_size_mm, strict=True)
    ]
    sums = np.zeros((highest + 1,) * 3)
    for factor, (i, j, k) in entries:
        sums += factor * np.einsum("a,b,c->abc", by_axis[0][i], by_axis[1][j], by_axis[2][k])
    return axis, [(float(sums[a, b, c]), (int(a), int(b), int(c))) for a, b, c in np.argwhere(sums)]


def _powers_in_legendre(highest: int, offset: float, slope: float) -> FloatArray:
    """(n + 1, n + 1): row d holds the Legendre coefficients of (offset + slope t)^d."""
    from numpy.polynomial import Polynomial, legendre

    result = np.zeros((highest + 1, highest + 1))
    for degree in range(highest + 1):
        found = legendre.poly2leg((Polynomial([offset, slope]) ** degree).coef)
        result[degree, : len(found)] = found
    return result
