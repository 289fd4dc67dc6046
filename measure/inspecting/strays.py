"""Which points stray: a mixture of a surface with normal noise, a heap of strays beside it, and points anywhere.

At the mouth of a bore, the rim of a boss and wherever a pixel sees two depths at once, a camera delivers points between
the two. They lie on one side of the surface, as dense there as its own points, and no scale of all residuals tells them
apart: with half of the points straying it is theirs. The mixture tells, since the surface is a peak and they are a heap. Each
point counts by its chance of lying on the surface (D. W. Hogg, J. Bovy, D. Lang, arXiv:1008.4686, section 3; the
expectation-maximisation of A. P. Dempster, N. M. Laird, D. B. Rubin, J. R. Stat. Soc. B 39, 1977), so that a clean surface
keeps the tails of its noise and one among strays does not keep them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.kinematics.se3 import FloatArray

_LEAST_SHARE = 1e-3
_LEAST_WIDER = 4.0
"""A heap of strays is wider than the surface's noise by this factor: two views that disagree are no heap and a surface."""


@dataclass(frozen=True, slots=True)
class Mixture:
    """A surface's noise, a heap of strays beside it, and strays anywhere."""

    sigma_mm: float
    """Standard deviation of the points on the surface."""
    heap_mm: float
    """Mean of the heap."""
    heap_sigma_mm: float
    reach_mm: float
    """Points were looked for within this distance on both sides."""
    shares: tuple[float, float, float] = (0.8, 0.1, 0.1)
    """Of the points, on the surface, in the heap, anywhere."""

    def chances(self, residual_mm: FloatArray) -> FloatArray:
        """(n,) chance of each of the residuals (n,) to belong to the surface."""
        densities = self._densities(residual_mm)
        return np.asarray(densities[0] / densities.sum(axis=0))

    def likelihood(self, residual_mm: FloatArray, weights: FloatArray) -> float:
        """Logarithm of the density of residuals (n,) that count by weights (n,)."""
        return float(weights @ np.log(self._densities(residual_mm).sum(axis=0)))

    def updated(self, residual_mm: FloatArray, weights: FloatArray, least_sigma_mm: float) -> Mixture:
        """One step of expectation and maximisation on residuals (n,) that count by weights (n,)."""
        densities = self._densities(residual_mm)
        chances = densities * (weights / densities.sum(axis=0))
        surface, heap, _ = total = np.maximum(chances.sum(axis=1), 1e-9)
        sigma = max(float(np.sqrt(chances[0] @ residual_mm**2 / surface)), least_sigma_mm)
        middle = float(chances[1] @ residual_mm / heap)
        width = max(float(np.sqrt(chances[1] @ (residual_mm - middle) ** 2 / heap)), _LEAST_WIDER * sigma)
        shares = np.maximum(total / total.sum(), _LEAST_SHARE)
        shares = shares / shares.sum()
        return Mixture(sigma, middle, width, self.reach_mm, (float(shares[0]), float(shares[1]), float(shares[2])))

    def _densities(self, residual_mm: FloatArray) -> FloatArray:
        """(3, n) of the three, per mm."""
        surface, heap, anywhere = self.shares
        return np.stack(
            [
                surface * _normal(residual_mm, self.sigma_mm),
                heap * _normal(residual_mm - self.heap_mm, self.heap_sigma_mm),
                np.full(len(residual_mm), anywhere / (2 * self.reach_mm)),
            ]
        )


def _normal(x: FloatArray, sigma: float) -> FloatArray:
    return np.asarray(np.exp(-0.5 * np.square(x / sigma)) / (np.sqrt(2 * np.pi) * sigma))


def mode_mm(residual_mm: FloatArray) -> float:
    """Where residuals (n,) lie densest: the half sample of least width, again and again (D. R. Bickel, R. Fruehwirth, CSDA 50, 2006)."""
    found = np.sort(residual_mm)
    while len(found) > 3:
        half = (len(found) + 1) // 2
        first = int(np.argmin(found[half - 1 :] - found[: len(found) - half + 1]))
        found = found[first : first + half]
    return float(found.mean())
