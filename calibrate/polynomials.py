"""What the compiled kernels know of a camera error model: a table of products of one-dimensional polynomials."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.kinematics.se3 import FloatArray

Term = tuple[int, Sequence[tuple[float, tuple[int, int, int]]]]
"""Camera axis that a term moves a point along, and its products: a factor, and degrees in x, y, z."""


class Polynomials(NamedTuple):
    """k terms, each a sum of factors times f_i(x) f_j(y) f_l(z); a tuple of arrays, because numba takes no dataclass.

    The functions follow f_0 = 1, f_1 = t, f_(n+1) = forward_n t f_n - backward_n f_(n-1), t = (x - centre) / scale.
    """

    centre_mm: FloatArray
    """(3,)."""
    scale_mm: FloatArray
    """(3,)."""
    forward: FloatArray
    """(D,) of the recurrence, D the highest degree."""
    backward: FloatArray
    """(D,)."""
    tame: bool
    """Whether each function goes on along its tangent outside [-1, 1]."""
    degrees: NDArray[np.int64]
    """(M, 3) of every product in x, y, z."""
    starts: NDArray[np.int64]
    """(k + 1,) where each term's entries begin."""
    product: NDArray[np.int64]
    """(entries,) index of a product."""
    factor: FloatArray
    """(entries,)."""
    axis: NDArray[np.int64]
    """(k,) the camera axis that a term moves a point along."""


def legendre(terms: Sequence[Term], centre_mm: Sequence[float], scale_mm: Sequence[float]) -> Polynomials:
    """Terms in Legendre polynomials over a box, linear beyond it."""
    n = np.arange(_highest(terms), dtype=np.float64)
    return _table(terms, centre_mm, scale_mm, (2 * n + 1) / (n + 1), n / (n + 1), tame=True)


def monomials(terms: Sequence[Term], centre_mm: Sequence[float], scale_mm: Sequence[float]) -> Polynomials:
    """Terms in plain powers."""
    degree = _highest(terms)
    return _table(terms, centre_mm, scale_mm, np.ones(degree), np.zeros(degree), tame=False)


def _highest(terms: Sequence[Term]) -> int:
    return max((degree for _, products in terms for _, degrees in products for degree in degrees), default=0)


def _table(
    terms: Sequence[Term], centre_mm: Sequence[float], scale_mm: Sequence[float], forward: FloatArray, backward: FloatArray, *, tame: bool
) -> Polynomials:
    entries = [entry for _, products in terms for entry in products]
    unique = list(dict.fromkeys(degrees for _, degrees in entries))
    return Polynomials(
        centre_mm=np.asarray(centre_mm, dtype=np.float64),
        scale_mm=np.asarray(scale_mm, dtype=np.float64),
        forward=forward,
        backward=backward,
        tame=tame,
        degrees=np.array(unique, dtype=np.int64).reshape(-1, 3),
        starts=np.concatenate([[0], np.cumsum([len(products) for _, products in terms])]).astype(np.int64),
        product=np.array([unique.index(degrees) for _, degrees in entries], dtype=np.int64),
        factor=np.array([factor for factor, _ in entries], dtype=np.float64),
        axis=np.array([axis for axis, _ in terms], dtype=np.int64),
    )
