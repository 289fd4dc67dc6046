"""Models of the camera's error: a correction added to every measured point, linear in its coefficients.

    point_corrected = point_measured + sum_k coefficient_k * basis_k(point_measured) * e[axis_k]

Every basis function is scaled so that its coefficient is in mm and says what the term does at a stated place, which
keeps the solver's unknowns of like size (the paper's k are 1e-9 to 1e-18). Single coefficients are not identifiable;
the sum as a field is (METHOD.md 3), so only the field is ever reported.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import comb
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibrate.polynomials import Polynomials, legendre, monomials
from drivers.errors import FileError, SettingsError
from drivers.kinematics.se3 import FloatArray

PILLOW_SCALE_MM = 250.0
"""Distance from the sight crossing at which a pillow coefficient is the correction in mm."""


class CameraError(Protocol):
    """What the solver needs to know of a camera error model."""

    @property
    def name(self) -> str:
        """Short name, as on the command line."""
        ...

    @property
    def axis(self) -> NDArray[np.int64]:
        """(k,) the camera axis, 0 to 2, that each term moves a point along."""
        ...

    @property
    def prior_sigma_mm(self) -> FloatArray:
        """(k,) standard deviation of each coefficient before any data, of physical size."""
        ...

    def basis(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        """(n, k) values of the terms at points (n, 3)."""
        ...

    @property
    def polynomials(self) -> Polynomials:
        """The same terms as a table for the kernels."""
        ...

    def settings(self) -> dict[str, object]:
        """What a file must hold to make this model again with `camera_error_from_settings`."""
        ...


@dataclass(frozen=True, slots=True)
class NoCameraError:
    """The camera is taken as it measures."""

    name: str = "none"

    @property
    def axis(self) -> NDArray[np.int64]:
        """No term."""
        return np.zeros(0, dtype=np.int64)

    @property
    def prior_sigma_mm(self) -> FloatArray:
        """No term."""
        return np.zeros(0)

    def basis(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        """(n, 0)."""
        return np.zeros((len(np.asarray(points_in_camera_mm)), 0))

    @property
    def polynomials(self) -> Polynomials:
        """An empty table."""
        return monomials((), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))

    def settings(self) -> dict[str, object]:
        """Nothing to keep."""
        return {"model": "none"}


@dataclass(frozen=True, slots=True)
class PillowError:
    """The paper's pillow (eq. 5): dz = sum_i k_i (z - z_s) r^(2i), r² = (x - x_s)² + (z - z_s)².

    Scaled: term i is ((z - z_s) / L) (r / L)^(2i) with L = 250 mm.
    """

    sight_crossing_mm: tuple[float, float, float] = (60.0, 0.0, 500.0)
    n_terms: int = 3
    name: str = "pillow"

    @property
    def axis(self) -> NDArray[np.int64]:
        """Every term acts on depth."""
        return np.full(self.n_terms, 2, dtype=np.int64)

    @property
    def prior_sigma_mm(self) -> FloatArray:
        """2 mm at 250 mm from the sight crossing."""
        return np.full(self.n_terms, 2.0)

    def basis(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        """(n, n_terms) values of the scaled terms."""
        points = np.asarray(points_in_camera_mm, dtype=np.float64)
        x = (points[:, 0] - self.sight_crossing_mm[0]) / PILLOW_SCALE_MM
        z = (points[:, 2] - self.sight_crossing_mm[2]) / PILLOW_SCALE_MM
        r2 = x * x + z * z
        return np.stack([z * r2 ** (i + 1) for i in range(self.n_terms)], axis=-1)

    @property
    def polynomials(self) -> Polynomials:
        """Each term z r^(2i) by the binomial theorem."""
        powers = range(1, self.n_terms + 1)
        terms = [(2, [(float(comb(i, j)), (2 * j, 0, 2 * (i - j) + 1)) for j in range(i + 1)]) for i in powers]
        return monomials(terms, self.sight_crossing_mm, (PILLOW_SCALE_MM,) * 3)

    def coefficients_k(self, coefficients_mm: ArrayLike) -> FloatArray:
        """The paper's k_i (mm^-2i) of scaled coefficients in mm."""
        powers = 2 * np.arange(1, self.n_terms + 1) + 1
        return np.asarray(np.asarray(coefficients_mm, dtype=np.float64) / PILLOW_SCALE_MM**powers)

    def settings(self) -> dict[str, object]:
        """Sight crossing and number of terms."""
        return {"model": "pillow", "sight_crossing_mm": list(self.sight_crossing_mm), "n_terms": self.n_terms}


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
    """Prior size of a first-degree depth coefficient; degree d is divided by d."""
    lateral_smoothness_mm: float = 0.3
    """The same across the view."""
    name: str = "field"

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
        """Falls as 1 / total degree."""
        return np.array([(self.smoothness_mm if axis == 2 else self.lateral_smoothness_mm) / sum(t) for axis, t in self.terms])

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
        }


def correction_in_camera_mm(model: CameraError, coefficients_mm: ArrayLike, points_in_camera_mm: ArrayLike) -> FloatArray:
    """The correction (n, 3) in mm to be added to measured points (n, 3)."""
    return correction_of_basis(model, coefficients_mm, model.basis(points_in_camera_mm))


def correction_of_basis(model: CameraError, coefficients_mm: ArrayLike, basis: FloatArray) -> FloatArray:
    """The correction (n, 3) in mm where the basis (n, k) is at hand already."""
    values = basis * np.asarray(coefficients_mm, dtype=np.float64)
    result = np.zeros((len(basis), 3))
    for axis in range(3):
        chosen = model.axis == axis
        if chosen.any():
            result[:, axis] = values[:, chosen].sum(axis=1)
    return result


def camera_error_models(names: Sequence[str], *, points_in_camera_mm: FloatArray, sight_crossing_mm: tuple[float, float, float]) -> list[CameraError]:
    """Models by their command-line names, polynomial boxes laid around the points (n, 3) that were seen.

    Raises SettingsError for an unknown name.
    """
    lower, upper = points_in_camera_mm.min(axis=0), points_in_camera_mm.max(axis=0)
    centre = tuple(float(c) for c in (lower + upper) / 2)
    half = tuple(float(max(h, 20.0)) for h in (upper - lower) / 2)
    made: dict[str, CameraError] = {
        "none": NoCameraError(),
        "affine": PolynomialError((centre[0], centre[1], centre[2]), (half[0], half[1], half[2]), 1, 1, name="affine"),
        "pillow": PillowError(sight_crossing_mm),
        "field": PolynomialError((centre[0], centre[1], centre[2]), (half[0], half[1], half[2]), 3, 2, name="field"),
    }
    unknown = [name for name in names if name not in made]
    if unknown:
        raise SettingsError(f"unknown camera error model {unknown[0]!r}", remedy=f"Choose one of auto, {', '.join(made)}.")
    return [made[name] for name in names]


def camera_error_from_settings(settings: Mapping[str, object], *, file: str | None = None) -> CameraError:
    """The model that `CameraError.settings` described; FileError when it describes none."""
    try:
        match settings["model"]:
            case "none":
                return NoCameraError()
            case "pillow":
                return PillowError(_triple(settings["sight_crossing_mm"]), int(str(settings["n_terms"])))
            case "affine" | "field" as name:
                return PolynomialError(
                    _triple(settings["centre_mm"]),
                    _triple(settings["half_size_mm"]),
                    int(str(settings["degree"])),
                    int(str(settings["lateral_degree"])),
                    float(str(settings["smoothness_mm"])),
                    float(str(settings["lateral_smoothness_mm"])),
                    str(name),
                )
            case other:
                raise ValueError(f"unknown model {other!r}")
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(
            f"not a camera error model: {error}", file=file, where="camera_error", remedy="Calibrate again to write a whole file."
        ) from error


def _degrees(highest: int) -> list[tuple[int, int, int]]:
    """Degrees in x, y, z of all terms of total degree 1 to `highest`, lowest first."""
    each = range(highest + 1)
    return sorted(((i, j, k) for i, j, k in product(each, each, each) if 0 < i + j + k <= highest), key=lambda t: (sum(t), t))


def _legendre_tame(x: FloatArray, degree: int) -> list[FloatArray]:
    """P_0..P_degree inside [-1, 1], their tangents outside."""
    inside = np.clip(x, -1.0, 1.0)
    values, slopes = [np.ones_like(x), inside], [np.zeros_like(x), np.ones_like(x)]
    for n in range(1, degree):
        values.append(((2 * n + 1) * inside * values[n] - n * values[n - 1]) / (n + 1))
        slopes.append(slopes[n - 1] + (2 * n + 1) * values[n])
    return [value + slope * (x - inside) for value, slope in zip(values, slopes, strict=True)][: degree + 1]


def _triple(value: object) -> tuple[float, float, float]:
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ValueError(f"{value!r} is no list of three numbers")
    return float(value[0]), float(value[1]), float(value[2])
