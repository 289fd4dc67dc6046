"""Patches of a surface: sums over them, and what residuals say of a fit when neighbours have errors in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.kinematics.se3 import FloatArray

IntArray = NDArray[np.int64]

CELLS_ACROSS = 6
COARSE_CELLS_ACROSS = 3
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


def patches_of(points_mm: FloatArray, cells_across: int = CELLS_ACROSS, *, along_each_axis: bool = False) -> tuple[IntArray, float]:
    """Cells of a grid as patches: labels (n,) from 0 without gaps, and the longest edge of a cell.

    Args:
        points_mm: (n, 3).
        cells_across: along the longest side of the points' box; the cells are cubes.
        along_each_axis: that many along every side instead.
    """
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    sides = (high - low) if along_each_axis else np.full(3, float((high - low).max()))
    sizes = np.maximum(sides / cells_across, 1e-6)
    cells = np.minimum(np.floor((points_mm - low) / sizes), cells_across - 1).astype(np.int64)
    keys = (cells[:, 0] * cells_across + cells[:, 1]) * cells_across + cells[:, 2]
    taken = np.zeros(cells_across**3, dtype=np.int64)
    taken[keys] = 1
    return (np.cumsum(taken) - 1)[keys], float(sizes.max())


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """What a fit changes by where one of G groups of neighbours is left out (the jackknife by groups).

    A group that alone holds a parameter has small residuals because of that; leaving it out tells, they do not (CR3 of R. M.
    Bell and D. F. McCaffrey, Survey Methodology 28, 2002). Part of these changes is no news: noise of single points, and
    the cloud's errors as far as they are known, move the groups too. What is beyond both is form and whatever nobody
    stated, and that alone is charged: the method of moments for a component of variance.
    """

    observed: FloatArray
    """(p, p) variance of the parameters as the groups' changes show it."""
    by_noise: FloatArray
    """(p, p) what noise of single points makes of it."""
    by_patch: FloatArray
    """(G, p, K, 3) change per displacement of the fit's K patches, so scaled that squares sum up to `observed`."""
    freedom: int
    """Groups less what they fix: Student's factor for what is beyond."""

    def beyond(self, by_field: FloatArray | float) -> FloatArray:
        """(p,) variances that neither noise nor a field explains, which alone would show as `by_field` (p, p)."""
        from scipy.special import stdtrit

        student = float(stdtrit(max(self.freedom, 2), 0.975)) / 1.959964
        return np.asarray(np.maximum(np.diag(self.observed - self.by_noise - by_field), 0.0) * student**2)


@dataclass(frozen=True, slots=True, eq=False)
class Division:
    """A fit's points divided into groups; a point may belong to two in part."""

    groups: IntArray
    """(m,) from 0 without gaps."""
    rows: IntArray
    """(m,) the point that each entry is of."""
    shares: FloatArray
    """(m,) how much of it."""

    @classmethod
    def whole(cls, groups: IntArray) -> Division:
        """By groups (n,) that share no point."""
        return cls(groups, np.arange(len(groups)), np.ones(len(groups)))

    @classmethod
    def layers(cls, height_mm: FloatArray, n_layers: int, blur_mm: float) -> Division:
        """By heights (n,) into layers of as many points each, which run into one another over some mm.

        Means of voxels lie in steps on a steep surface; layers that end within a step would differ by that alone.
        """
        edges = np.unique(np.quantile(height_mm, np.linspace(0, 1, n_layers + 1)[1:-1]))
        nearest = np.abs(height_mm[:, None] - edges).argmin(axis=1)
        above = np.clip((height_mm - edges[nearest]) / max(blur_mm, 1e-9) + 0.5, 0.0, 1.0)
        rows = np.arange(len(height_mm))
        return cls(np.concatenate([nearest, nearest + 1]), np.concatenate([rows, rows]), np.concatenate([1 - above, above]))


def scatters_of(
    gain: FloatArray, residual_mm: FloatArray, jacobian: FloatArray, gradient: FloatArray, patches: IntArray, divisions: Sequence[Division]
) -> tuple[Scatter, ...]:
    """One for each way to divide a fit's points (n,) into groups, where it has groups enough.

    Args:
        gain: (n, p) change of the parameters per residual of a point.
        residual_mm: (n,).
        jacobian: (n, p) of the residuals by the parameters.
        gradient: (n, 3) of the residuals by the points, frame of the part.
        patches: (n,) labels of the fit's K patches.
        divisions: into groups.
    """
    pull = gain[:, :, None] * jacobian[:, None, :]
    moved = gain[:, :, None] * gradient[:, None, :]
    found = [_scatter(gain * residual_mm[:, None], pull, moved, patches, groups) for groups in divisions]
    return tuple(one for one in found if one is not None)


def _scatter(scores: FloatArray, pull: FloatArray, moved: FloatArray, patches: IntArray, division: Division) -> Scatter | None:
    groups, rows, shares = division.groups, division.rows, division.shares[:, None]
    scores, pull, moved, patches = scores[rows] * shares, pull[rows] * shares[:, :, None], moved[rows] * shares[:, :, None], patches[rows]
    sums = PatchSums(groups, np.ones(len(groups)))
    n_groups, p = len(sums.counts), scores.shape[1]
    if n_groups < 2:
        return None
    n_patches = int(patches.max()) + 1
    held = sums.total(pull.reshape(len(pull), -1)).reshape(-1, p, p)
    undone = _without_each(held) * np.sqrt((n_groups - 1) / n_groups)
    # what a displaced patch does to the residuals of a group: its own points', and all by the fit that follows
    both = groups * n_patches + patches
    own = np.stack([np.bincount(both, column, n_groups * n_patches) for column in moved.reshape(len(moved), -1).T], axis=1)
    own = own.reshape(n_groups, n_patches, p, 3).transpose(0, 2, 1, 3)
    by_fit = np.einsum("gpq,qki->gpki", held, own.sum(axis=0), optimize=True)
    changes = np.einsum("gpq,gq->gp", undone, sums.total(scores))
    squares = sums.total((scores[:, :, None] * scores[:, None, :]).reshape(len(scores), -1)).reshape(-1, p, p)
    return Scatter(
        observed=changes.T @ changes,
        by_noise=np.einsum("gpq,gqr,gsr->ps", undone, squares, undone, optimize=True),
        by_patch=np.einsum("gpq,gqki->gpki", undone, own + by_fit, optimize=True),
        freedom=n_groups - 1,
    )


def _without_each(held: FloatArray) -> FloatArray:
    """(G, p, p) what turns the scores of a group into the change of the fit by leaving it out; `held` (G, p, p) is what it holds."""
    p = held.shape[1]
    # -gain jacobian summed over all points is the identity; what is left of it without a group
    left = np.eye(p) + held
    open_ = np.linalg.cond(left) > _MOST_CONDITION
    return np.asarray(np.linalg.inv(np.where(open_[:, None, None], left + _LEAST_LEFT * np.eye(p), left)))


def patch_covariance(gain: FloatArray, residual_mm: FloatArray, points_mm: FloatArray) -> FloatArray:
    """(p, p) of parameters that answer to residuals (n,) at points (n, 3) by gains (n, p), by the residuals alone.

    Cluster-robust (K.-Y. Liang and S. L. Zeger, Biometrika 73, 1986), by patches of two sizes, since nobody knows how far
    neighbours have errors in common: each variance is the larger one.
    """
    scores = gain * residual_mm[:, None]
    fine, coarse = (_by_patches(scores, patches_of(points_mm, cells)[0]) for cells in (CELLS_ACROSS, COARSE_CELLS_ACROSS))
    if fine is None:  # too few patches to tell anything
        fine = scores.T @ scores * max(1.0, len(scores) / CELLS_ACROSS)
    variances = [np.diag(fine)] if coarse is None else [np.diag(fine), np.diag(coarse)]
    larger = np.sqrt(np.max(variances, axis=0) / np.maximum(np.diag(fine), 1e-300))
    return np.asarray(fine * np.outer(larger, larger))


def _by_patches(scores: FloatArray, labels: IntArray) -> FloatArray | None:
    """The patches' sums of squares with Student's factor; None where there are too few patches."""
    from scipy.special import stdtrit

    sums = PatchSums(labels, np.ones(len(labels))).total(scores)
    freedom = len(sums) - scores.shape[1]
    if freedom < _LEAST_FREEDOM:
        return None
    student = float(stdtrit(freedom, 0.975)) / 1.959964
    return np.asarray(sums.T @ sums * (len(sums) / freedom) * student**2)
