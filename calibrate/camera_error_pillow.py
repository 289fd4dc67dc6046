"""The paper's camera errors: eq. 5 (depth only), eq. 4 (all three axes), and either with its sight crossing free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibrate.polynomials import Polynomials, Term, monomials
from drivers.kinematics.se3 import FloatArray

PILLOW_SCALE_MM = 250.0
"""Distance from the sight crossing at which a pillow coefficient is the correction in mm."""
_DEPTH_SIGMA_MM, _LATERAL_SIGMA_MM = 2.0, 0.5
_CROSSING_SIGMA_MM = 50.0


@dataclass(frozen=True, slots=True)
class PillowError:
    """The paper's pillow (eq. 5): dz = sum_i k_i (z - z_s) r^(2i), r² = (x - x_s)² + (z - z_s)².

    Scaled: term i is ((z - z_s) / L) (r / L)^(2i) with L = 250 mm.
    """

    sight_crossing_mm: tuple[float, float, float] = (60.0, 0.0, 500.0)
    n_terms: int = 3
    name: str = "pillow"

    @property
    def terms(self) -> tuple[Term, ...]:
        """Each term, z r^(2i), by the binomial theorem, in (point - crossing) / L."""
        return tuple((2, _times(_radius_squared(i), (0, 0, 1))) for i in range(1, self.n_terms + 1))

    @property
    def axis(self) -> NDArray[np.int64]:
        """Every term acts on depth."""
        return np.full(self.n_terms, 2, dtype=np.int64)

    @property
    def prior_sigma_mm(self) -> FloatArray:
        """2 mm at 250 mm from the sight crossing."""
        return np.full(self.n_terms, _DEPTH_SIGMA_MM)

    def basis(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        """(n, n_terms) values of the scaled terms."""
        points = np.asarray(points_in_camera_mm, dtype=np.float64)
        x = (points[:, 0] - self.sight_crossing_mm[0]) / PILLOW_SCALE_MM
        z = (points[:, 2] - self.sight_crossing_mm[2]) / PILLOW_SCALE_MM
        r2 = x * x + z * z
        return np.stack([z * r2 ** (i + 1) for i in range(self.n_terms)], axis=-1)

    @property
    def polynomials(self) -> Polynomials:
        """The terms as they are."""
        return monomials(self.terms, self.sight_crossing_mm, (PILLOW_SCALE_MM,) * 3)

    def coefficients_k(self, coefficients_mm: ArrayLike) -> FloatArray:
        """The paper's k_i (mm^-2i) of scaled coefficients in mm."""
        powers = 2 * np.arange(1, self.n_terms + 1) + 1
        return np.asarray(np.asarray(coefficients_mm, dtype=np.float64) / PILLOW_SCALE_MM**powers)

    def settings(self) -> dict[str, object]:
        """Sight crossing and number of terms."""
        return {"model": self.name, "sight_crossing_mm": list(self.sight_crossing_mm), "n_terms": self.n_terms}


@dataclass(frozen=True, slots=True)
class FullPillowError:
    """The paper's eq. 4: eq. 5 in depth, the same in x, and dy = sum_j k_j (y - y_s) (r² + (y - y_s)²)^j; scaled as eq. 5.

    Terms come in the order of depth, x, y.
    """

    sight_crossing_mm: tuple[float, float, float] = (60.0, 0.0, 500.0)
    n_terms: int = 3
    name: str = "pillow-full"

    @property
    def terms(self) -> tuple[Term, ...]:
        """In (point - crossing) / L."""
        powers = range(1, self.n_terms + 1)
        depth = tuple((2, _times(_radius_squared(i), (0, 0, 1))) for i in powers)
        across = tuple((0, _times(_radius_squared(i), (1, 0, 0))) for i in powers)
        return depth + across + tuple((1, _times(_distance_squared(i), (0, 1, 0))) for i in powers)

    @property
    def axis(self) -> NDArray[np.int64]:
        """Depth, x, y."""
        return np.repeat(np.array([2, 0, 1], dtype=np.int64), self.n_terms)

    @property
    def prior_sigma_mm(self) -> FloatArray:
        """2 mm in depth and 0.5 mm across the view, at 250 mm from the sight crossing."""
        return np.repeat([_DEPTH_SIGMA_MM, _LATERAL_SIGMA_MM, _LATERAL_SIGMA_MM], self.n_terms)

    def basis(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        """(n, 3 n_terms) values of the scaled terms."""
        points = np.asarray(points_in_camera_mm, dtype=np.float64)
        x, y, z = ((points - np.asarray(self.sight_crossing_mm)) / PILLOW_SCALE_MM).T
        r2 = x * x + z * z
        powers = range(1, self.n_terms + 1)
        return np.stack([*(z * r2**i for i in powers), *(x * r2**i for i in powers), *(y * (r2 + y * y) ** i for i in powers)], axis=-1)

    @property
    def polynomials(self) -> Polynomials:
        """The terms as they are."""
        return monomials(self.terms, self.sight_crossing_mm, (PILLOW_SCALE_MM,) * 3)

    def settings(self) -> dict[str, object]:
        """Sight crossing and number of terms."""
        return {"model": self.name, "sight_crossing_mm": list(self.sight_crossing_mm), "n_terms": self.n_terms}


@dataclass(frozen=True, slots=True)
class FreeCrossing:
    """A pillow whose sight crossing is sought: more terms say what a crossing off by 1 mm would change.

    The pillow is not linear in its crossing S, so it is linearised about coefficients that are near: their terms'
    derivatives by S are the columns, their coefficients the change of S in mm. Each axis that points are moved along has
    its own change, so that every term moves one axis. A solve that found S (`calibrate.crossing`) ends where the changes
    are next to zero, and what they could still be is in its covariance.
    """

    pillow: PillowError | FullPillowError
    about_mm: tuple[float, ...]
    """Coefficients of the pillow that the derivatives are taken at."""
    crossing_sigma_mm: float = _CROSSING_SIGMA_MM
    """How far the crossing may be from where it is taken."""

    @property
    def name(self) -> str:
        """The pillow's, and that its crossing is free."""
        return f"{self.pillow.name}-free"

    @property
    def crossing_terms(self) -> tuple[tuple[int, Term], ...]:
        """Coordinate of S, and the term of its change; only where there is one."""
        found = []
        for moved in dict.fromkeys(self.pillow.axis.tolist()):
            for coordinate in range(3):
                entries = _derivative_by_crossing(self.pillow.terms, self.about_mm, moved, coordinate)
                if entries:
                    found.append((coordinate, (moved, entries)))
        return tuple(found)

    @property
    def axis(self) -> NDArray[np.int64]:
        """The pillow's, then those of the changes."""
        return np.concatenate([self.pillow.axis, np.array([axis for _, (axis, _) in self.crossing_terms], dtype=np.int64)])

    @property
    def coordinate(self) -> NDArray[np.int64]:
        """(k,) coordinate of S that a term changes, -1 for the pillow's own terms."""
        return np.array([-1] * len(self.pillow.axis) + [coordinate for coordinate, _ in self.crossing_terms], dtype=np.int64)

    @property
    def prior_sigma_mm(self) -> FloatArray:
        """The pillow's, then how far the crossing may be off."""
        return np.concatenate([self.pillow.prior_sigma_mm, np.full(len(self.crossing_terms), self.crossing_sigma_mm)])

    def basis(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        """(n, k): the pillow's terms, then mm per mm of crossing."""
        points = np.asarray(points_in_camera_mm, dtype=np.float64)
        x, y, z = ((points - np.asarray(self.pillow.sight_crossing_mm)) / PILLOW_SCALE_MM).T
        changes = [sum(factor * x**i * y**j * z**k for factor, (i, j, k) in entries) for _, (_, entries) in self.crossing_terms]
        return np.column_stack([self.pillow.basis(points), *changes])

    @property
    def polynomials(self) -> Polynomials:
        """The pillow's terms and the changes'."""
        terms = (*self.pillow.terms, *(term for _, term in self.crossing_terms))
        return monomials(terms, self.pillow.sight_crossing_mm, (PILLOW_SCALE_MM,) * 3)

    def settings(self) -> dict[str, object]:
        """The pillow's, and what the changes are taken about."""
        return self.pillow.settings() | {"model": self.name, "about_mm": list(self.about_mm), "crossing_sigma_mm": self.crossing_sigma_mm}


def _radius_squared(power: int) -> list[tuple[float, tuple[int, int, int]]]:
    """(x² + z²) to a power."""
    return [(float(comb(power, j)), (2 * j, 0, 2 * (power - j))) for j in range(power + 1)]


def _distance_squared(power: int) -> list[tuple[float, tuple[int, int, int]]]:
    """(x² + y² + z²) to a power."""
    return [
        (float(comb(power, j) * comb(power - j, i)), (2 * i, 2 * j, 2 * (power - j - i))) for j in range(power + 1) for i in range(power - j + 1)
    ]


def _times(entries: Sequence[tuple[float, tuple[int, int, int]]], by: tuple[int, int, int]) -> list[tuple[float, tuple[int, int, int]]]:
    return [(factor, (i + by[0], j + by[1], k + by[2])) for factor, (i, j, k) in entries]


def _derivative_by_crossing(
    terms: Sequence[Term], coefficients_mm: Sequence[float], moved: int, coordinate: int
) -> list[tuple[float, tuple[int, int, int]]]:
    """Entries of d(correction along `moved`) / d(S along `coordinate`), in mm per mm."""
    sums: dict[tuple[int, int, int], float] = {}
    for (axis, entries), coefficient in zip(terms, coefficients_mm, strict=True):
        for factor, degrees in entries if axis == moved else ():
            if degrees[coordinate]:
                lower = list(degrees)
                lower[coordinate] -= 1
                key = (lower[0], lower[1], lower[2])
                sums[key] = sums.get(key, 0.0) - factor * coefficient * degrees[coordinate] / PILLOW_SCALE_MM
    return [(factor, degrees) for degrees, factor in sums.items()]
