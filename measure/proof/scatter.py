"""How uncertain figures of commonly fitted spheres are because each view stands a little elsewhere.

Two estimates. The *sandwich* takes the residuals as they are; with few views it hardly sees
a scatter that the common fit has swallowed. The *structured* one moves every view as a whole, by what the calibration's
noise says of its pose and by what its points leave open, and sees how the common fit follows; its size is corrected by
the scatter of the views' own centres, pooled over all spheres, with a Student factor for how few there are. The
structured one counts, unless a sphere's own sandwich exceeds it by more than chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.proof.probing import shell_width_mm

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NORMAL_95 = 1.6449
_N_DRAWS = 24
_SMALLEST_MM2 = 1e-6
_POINTS_PER_VIEW = 200


@dataclass(frozen=True, slots=True, eq=False)
class OwnCentre:
    """What one view alone says of its sphere's centre."""

    centre_in_base_mm: FloatArray
    """(3,)."""
    covariance_mm2: FloatArray
    """(3, 3) by which it should scatter: its points, and the pose noise of its shot."""


@dataclass(frozen=True, slots=True)
class ScatterScale:
    """Seen over expected variance of the views' own centres, and on how many degrees of freedom."""

    ratio: float
    freedom: int
    known: bool
    """Whether the expected size means something (a calibration's noise) or only its shape does."""

    @property
    def factor(self) -> float:
        """What expected variances are to be multiplied by: never below 1 where the expectation means something."""
        if not self.freedom:
            return 1.0 if self.known else 0.0
        scaled = self.ratio * student_factor(self.freedom) ** 2
        return max(1.0, scaled) if self.known else scaled


def student_factor(freedom: int) -> float:
    """By how much a one-sided 95 % bound widens when its sigma was estimated with so few degrees of freedom."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.95)) / _NORMAL_95


def agreed_variance(expected: float | None, seen: float, freedom: int) -> float:
    """The variance to claim: what is expected, unless what is seen on so few degrees of freedom exceeds it beyond chance (95 %).

    Taking the larger of the two always would claim too much: with few views the seen one is mostly chance.
    """
    if expected is None:
        return seen
    if freedom < 1:
        return expected
    from scipy.special import chdtri

    return seen if seen > expected * float(chdtri(freedom, 0.05)) / freedom else expected


def scatter_scale(spheres: Sequence[Sequence[OwnCentre]], *, known: bool) -> ScatterScale:
    """Compare the centres of the views of each sphere with what they should scatter by, about their weighted mean."""
    total, freedom = 0.0, 0
    for views in spheres:
        if len(views) < 2:
            continue
        centres = np.stack([view.centre_in_base_mm for view in views])
        weights = np.linalg.inv(np.stack([view.covariance_mm2 + _SMALLEST_MM2 * np.eye(3) for view in views]))
        mean = np.linalg.solve(weights.sum(axis=0), np.einsum("nij,nj->i", weights, centres))
        total += float(np.einsum("ni,nij,nj->", centres - mean, weights, centres - mean))
        freedom += 3 * (len(views) - 1)
    return ScatterScale(total / freedom if freedom else 1.0, freedom, known)


def sandwich(points: FloatArray, groups: IntArray, centre: FloatArray, radius_mm: float, fallback: FloatArray) -> FloatArray:
    """Covariance of a least-squares sphere whose errors are common to all points of a view, from the residuals.

    The "sandwich" of cluster-robust statistics (Liang and Zeger 1986): inv(N) (sum g_j g_j') inv(N), g_j = sum of J' r
    over a view. Counting each point as independent would call the mean of 10 shifted views good to micrometres. One
    view cannot show a scatter between views; the points' own covariance `fallback`, (3, 3) or (4, 4) with the radius,
    is then all there is.
    """
    n_views = int(groups[-1]) + 1
    if n_views < 2:
        return fallback
    design, residual = _design(points, centre, radius_mm, free=len(fallback) == 4)
    scores = np.zeros((n_views, design.shape[1]))
    np.add.at(scores, groups, design * residual[:, None])
    inverse = np.linalg.inv(design.T @ design)
    between = inverse @ (scores.T @ scores) @ inverse * n_views / (n_views - 1)
    return np.asarray(between + fallback)


def structured(
    points: FloatArray, groups: IntArray, centre: FloatArray, radius_mm: float, views: Sequence[FloatArray], fallback: FloatArray
) -> FloatArray:
    """Covariance, (3, 3) or (4, 4) as `fallback`, of a least-squares sphere whose views move as a whole by covariances (3, 3)."""
    follows = _follows(points, groups, centre, radius_mm, len(views), free=len(fallback) == 4)
    return np.asarray(np.einsum("jki,jim,jlm->kl", follows, np.stack(views), follows) + fallback)


def form_sigma_mm(points: FloatArray, groups: IntArray, centre: FloatArray, radius_mm: float, views: Sequence[FloatArray], share: float) -> float:
    """Standard uncertainty of the form shell: by moving views as they should scatter, and by leaving out one after the other.

    The first moves every view by draws from its covariance (3, 3), lets the free-radius sphere follow, and takes the
    standard deviation of the shell's width. The second is the jackknife over views; it counts beyond chance only.
    """
    n_views = len(views)
    # displaced views make the shell, not the number of their points
    step = max(1, len(points) // (_POINTS_PER_VIEW * n_views))
    points, groups = points[::step], groups[::step]
    radii = np.linalg.norm(points - centre, axis=1)
    jackknife = 0.0
    if n_views > 1:
        left_out = np.array([shell_width_mm(radii[groups != j], share) for j in range(n_views)])
        jackknife = float(np.sqrt((n_views - 1) * np.mean((left_out - left_out.mean()) ** 2)))
    design, _ = _design(points, centre, radius_mm, free=True)
    follows = _follows(points, groups, centre, radius_mm, n_views, free=True)
    # the draws are a quadrature, the same every time
    rng = np.random.default_rng(2634)
    draws = np.stack([rng.multivariate_normal(np.zeros(3), covariance, _N_DRAWS) for covariance in views], axis=1)
    widths = []
    for moved in draws:
        followed = np.einsum("jki,ji->k", follows, moved)
        widths.append(shell_width_mm(radii + np.einsum("ni,ni->n", design[:, :3], moved[groups]) - design @ followed, share))
    return float(np.sqrt(agreed_variance(float(np.var(widths)), jackknife**2, n_views - 1)))


def _design(points: FloatArray, centre: FloatArray, radius_mm: float, *, free: bool) -> tuple[FloatArray, FloatArray]:
    offset = points - centre
    distance = np.linalg.norm(offset, axis=1)
    unit = offset / distance[:, None]
    return np.column_stack([unit, np.ones(len(unit))]) if free else unit, distance - radius_mm


def _follows(points: FloatArray, groups: IntArray, centre: FloatArray, radius_mm: float, n_views: int, *, free: bool) -> FloatArray:
    """(m, k, 3) motion of centre (and radius) per motion of each view."""
    design, _ = _design(points, centre, radius_mm, free=free)
    inverse = np.linalg.inv(design.T @ design)
    return np.stack([inverse @ design[groups == j].T @ design[groups == j][:, :3] for j in range(n_views)])
