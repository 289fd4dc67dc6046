"""A smooth camera error field in orthogonal polynomials, and the smoothnesses that left-out shots choose among."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibrate.polynomials import Polynomials, legendre
from drivers.kinematics.se3 import FloatArray

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Centre and half sizes in mm, camera frame."""

_DEGREES = (3, 4, 5, 6)
_SMOOTHNESS_MM = (1.0, 0.3, 0.1)
_DECAYS = (2, 1)
_LATERAL_MM = (0.0, 0.03, 0.1, 0.3)
_LATERAL_DEGREE = 2


@dataclass(frozen=True, slots=True)
class PolynomialError:
    """A smooth field in Legendre polynomials over a box of the camera frame, by total degree.

    Depth gets all terms up to `degree`, x and y those up to `lateral_degree`: wrong focal lengths and principal points
    move points sideways as well (0.04 mm at the edge of the view for a focal length wrong by 0.25 per mille), and a
    depth-only field leaves that in the lengths. Constants are left out: they are shifts that the hand-eye transform
    holds already. The prior falls with the degree, so that a field is smooth unless the data want it otherwise.
    """

    centre_mm: tuple[float, float, float]
    half_size_mm: tuple[float, float, float]
    degree: int
    lateral_degree: int = 0
    smoothness_mm: float = 1.0
    """Prior size of a first-degree depth coefficient; that of degree d is divided by d to the power of `decay`."""
    lateral_smoothness_mm: float = 0.3
    """The same across the view."""
    name: str = "field"
    decay: int = 1

    @property
    def terms(self) -> tuple[tuple[int, tuple[int, int, int]], ...]:
        """Axis moved and degrees in x, y, z of every term."""
        return tuple((2, t) for t in _degrees(self.degree)) + tuple((axis, t) for axis in (0, 1) for t in _degrees(self.lateral_degree))

    @property
    def exponents(self) -> tuple[tuple[int, int, int], ...]:
        """Degrees in x, y, z of every term."""
        return tuple(degrees for _, degrees in self.terms)

    @property
    def axis(self) -> NDArray[np.int64]:
        """Depth terms first, then x, then y."""
        return np.array([axis for axis, _ in self.terms], dtype=np.int64)

    @property
    def prior_sigma_mm(self) -> FloatArray:
        """Falls as total degree to the power of -decay."""
        size = (self.lateral_smoothness_mm, self.lateral_smoothness_mm, self.smoothness_mm)
        return np.array([size[axis] / sum(t) ** self.decay for axis, t in self.terms])

    def basis(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        """(n, k) products of Legendre polynomials; linear beyond the box, so that extrapolation stays tame."""
        points = np.asarray(points_in_camera_mm, dtype=np.float64)
        scaled = (points - np.asarray(self.centre_mm)) / np.asarray(self.half_size_mm)
        values = _legendre_tame(scaled, max(self.degree, self.lateral_degree))
        result = np.empty((len(points), len(self.terms)))
        products: dict[tuple[int, int, int], FloatArray] = {}
        for column, (_, (i, j, k)) in enumerate(self.terms):
            if (i, j, k) not in products:
                products[i, j, k] = values[i][:, 0] * values[j][:, 1] * values[k][:, 2]
            result[:, column] = products[i, j, k]
        return result

    @property
    def turns(self) -> FloatArray:
        """(k, g) coefficients in mm by which the field turns every point about the box's centre, as the hand-eye transform can."""
        place = {(axis, degrees): column for column, (axis, degrees) in enumerate(self.terms)}
        pairs = [(a, b) for a, b in ((0, 1), (1, 2), (0, 2)) if (a, _first_degree(b)) in place and (b, _first_degree(a)) in place]
        result = np.zeros((len(place), len(pairs)))
        for column, (a, b) in enumerate(pairs):
            result[place[a, _first_degree(b)], column] = self.half_size_mm[b]
            result[place[b, _first_degree(a)], column] = -self.half_size_mm[a]
        return result

    @property
    def polynomials(self) -> Polynomials:
        """One product a term."""
        return legendre([(axis, [(1.0, degrees)]) for axis, degrees in self.terms], self.centre_mm, self.half_size_mm)

    def settings(self) -> dict[str, object]:
        """Box, degrees and smoothness."""
        return {
            "model": self.name,
            "centre_mm": list(self.centre_mm),
            "half_size_mm": list(self.half_size_mm),
            "degree": self.degree,
            "lateral_degree": self.lateral_degree,
            "smoothness_mm": self.smoothness_mm,
            "lateral_smoothness_mm": self.lateral_smoothness_mm,
            "decay": self.decay,
        }


def box_of_points(points_in_camera_mm: FloatArray) -> Box:
    """The box round points (n, 3), no side shorter than 40 mm."""
    lower, upper = points_in_camera_mm.min(axis=0), points_in_camera_mm.max(axis=0)
    centre, half = (lower + upper) / 2, np.maximum((upper - lower) / 2, 20.0)
    return (float(centre[0]), float(centre[1]), float(centre[2])), (float(half[0]), float(half[1]), float(half[2]))


def affine_error(box: Box) -> PolynomialError:
    """First-degree terms along all three axes."""
    return PolynomialError(*box, 1, 1, name="affine")


def default_field(box: Box) -> PolynomialError:
    """The field where nothing is known of its smoothness yet: wide priors, cubic."""
    return PolynomialError(*box, 3, 2)


def field_variants(box: Box) -> tuple[PolynomialError, ...]:
    """Fields of every degree, strength and decay of the depth prior that left-out shots are asked about, the stiffest first."""
    return tuple(
        PolynomialError(*box, degree, _LATERAL_DEGREE, smoothness_mm, _LATERAL_MM[1], decay=decay)
        for degree, smoothness_mm, decay in product(_DEGREES, reversed(_SMOOTHNESS_MM), _DECAYS)
    )


def lateral_variants(field: PolynomialError) -> tuple[PolynomialError, ...]:
    """A field with every strength of the prior across the view, none first."""
    return tuple(
        replace(field, lateral_degree=_LATERAL_DEGREE if size_mm else 0, lateral_smoothness_mm=size_mm or field.lateral_smoothness_mm)
        for size_mm in _LATERAL_MM
    )


def richest_field(box: Box) -> PolynomialError:
    """Holds every term of every variant."""
    return PolynomialError(*box, max(_DEGREES), _LATERAL_DEGREE)


def _degrees(highest: int) -> list[tuple[int, int, int]]:
    """Degrees in x, y, z of all terms of total degree 1 to `highest`, lowest first."""
    each = range(highest + 1)
    return sorted(((i, j, k) for i, j, k in product(each, each, each) if 0 < i + j + k <= highest), key=lambda t: (sum(t), t))


def _first_degree(axis: int) -> tuple[int, int, int]:
    return (int(axis == 0), int(axis == 1), int(axis == 2))


def _legendre_tame(x: FloatArray, degree: int) -> list[FloatArray]:
    """P_0..P_degree inside [-1, 1], their tangents outside."""
    inside = np.clip(x, -1.0, 1.0)
    values, slopes = [np.ones_like(x), inside], [np.zeros_like(x), np.ones_like(x)]
    for n in range(1, degree):
        values.append(((2 * n + 1) * inside * values[n] - n * values[n - 1]) / (n + 1))
        slopes.append(slopes[n - 1] + (2 * n + 1) * values[n])
    return [value + slope * (x - inside) for value, slope in zip(values, slopes, strict=True)][: degree + 1]
