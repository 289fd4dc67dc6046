"""Patches of a surface: sums over them, and what residuals say of a fit when neighbours have errors in common."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.kinematics.se3 import FloatArray

IntArray = NDArray[np.int64]

_CELLS_ACROSS = 6
_COARSE_CELLS_ACROSS = 3
_LEAST_FREEDOM = 3
_MOST_CONDITION = 1e5
_LEAST_LEFT = 0.02
"""Of a parameter's hold, where a patch is all that holds it."""


class PatchSums:
    """Sums and means of rows by patch."""

    def __init__(self, labels: IntArray, weights: FloatArray) -> None:
        self._labels = labels
        self._weights = weights
        self.counts: IntArray = np.bincount(labels).astype(np.int64)
        """(K,) rows of each patch."""
        self.weights: FloatArray = np.maximum(np.bincount(labels, weights), 1e-12)
        """(K,) their weights."""

    def total(self, values: FloatArray) -> FloatArray:
        """(K, m) plain sums of values (n, m)."""
        return np.column_stack([np.bincount(self._labels, column, len(self.counts)) for column in values.T])

    def mean(self, values: FloatArray) -> FloatArray:
        """(K, m) weighted means of values (n, m)."""
        return np.asarray(self.total(values * self._weights[:, None]) / self.weights[:, None])


def patches_of(points_mm: FloatArray, cells_across: int = _CELLS_ACROSS) -> tuple[IntArray, float]:
    """Cubes of a grid as patches: labels (n,) from 0 without gaps, and the edge of a cube."""
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    size = max(float((high - low).max()) / cells_across, 1e-6)
    cells = np.minimum(np.floor((points_mm - low) / size), cells_across - 1).astype(np.int64)
    keys = (cells[:, 0] * cells_across + cells[:, 1]) * cells_across + cells[:, 2]
    taken = np.zeros(cells_across**3, dtype=np.int64)
    taken[keys] = 1
    return (np.cumsum(taken) - 1)[keys], size


def patch_covariance(
    gain: FloatArray, residual_mm: FloatArray, points_mm: FloatArray, jacobian: FloatArray | None = None, layers: IntArray | None = None
) -> FloatArray:
    """(p, p) of parameters that answer to residuals (n,) at points (n, 3) by gains (n, p).

    Patches of two sizes, since nobody knows how far neighbours have errors in common: each variance is the larger one.
    With the residuals' derivatives (n, p) it is what the fit changes by where one patch is left out (the jackknife by
    groups, CR3 of R. M. Bell and D. F. McCaffrey, Survey Methodology 28, 2002): a patch that alone holds a parameter
    has small residuals because of that, and would else pass for a good one.
    """
    scores = gain * residual_mm[:, None]
    pull = None if jacobian is None else gain[:, :, None] * jacobian[:, None, :]
    fine, coarse = (_by_patches(scores, pull, patches_of(points_mm, cells)[0]) for cells in (_CELLS_ACROSS, _COARSE_CELLS_ACROSS))
    if fine is None:  # too few patches to tell anything
        fine = scores.T @ scores * max(1.0, len(scores) / _CELLS_ACROSS)
    variances = [np.diag(fine)] if coarse is None else [np.diag(fine), np.diag(coarse)]
    if pull is not None and layers is not None:
        variances.append(_by_layers(scores, pull, layers))
    larger = np.sqrt(np.max(variances, axis=0) / np.maximum(np.diag(fine), 1e-300))
    return np.asarray(fine * np.outer(larger, larger))


def _by_patches(scores: FloatArray, pull: FloatArray | None, labels: IntArray) -> FloatArray | None:
    """The patches' sums of squares with Student's factor; None where there are too few patches."""
    from scipy.special import stdtrit

    patches = PatchSums(labels, np.ones(len(labels)))
    sums = patches.total(scores)
    freedom = len(sums) - scores.shape[1]
    if freedom < _LEAST_FREEDOM:
        return None
    student = float(stdtrit(freedom, 0.975)) / 1.959964
    if pull is None:
        return np.asarray(sums.T @ sums * (len(sums) / freedom) * student**2)
    sums = _without_each(patches, pull, sums)
    return np.asarray(sums.T @ sums * ((len(sums) - 1) / len(sums)) * student**2)


def _by_layers(scores: FloatArray, pull: FloatArray, layers: IntArray) -> FloatArray:
    """(p,) variances by what the fit changes by where a layer is left out: what a whole rim has in common, patches beside each other do not tell."""
    from scipy.special import stdtrit

    patches = PatchSums(layers, np.ones(len(layers)))
    k = len(patches.counts)
    if k < 2:
        return np.zeros(scores.shape[1])
    changes = _without_each(patches, pull, patches.total(scores))
    student = float(stdtrit(max(k - 1, 2), 0.975)) / 1.959964
    return np.asarray(np.sum(changes**2, axis=0) * (k - 1) / k * student**2)


def _without_each(patches: PatchSums, pull: FloatArray, sums: FloatArray) -> FloatArray:
    """(K, p) changes of the fit by leaving out each patch, which alone moves it by sums (K, p)."""
    p = sums.shape[1]
    # -gain jacobian summed over all points is the identity; what is left of it without a patch
    left = np.eye(p) + patches.total(pull.reshape(len(pull), -1)).reshape(-1, p, p)
    open_ = np.linalg.cond(left) > _MOST_CONDITION
    left = np.where(open_[:, None, None], left + _LEAST_LEFT * np.eye(p), left)
    return np.asarray(np.linalg.solve(left, sums[:, :, None])[:, :, 0])
