"""Robust least-squares fits, what their residuals say of the result, and how the result answers to errors of the cloud.

A fit begins with Tukey's weights on a thinned set, whose scale the data gives, and ends as a plain least-squares fit of
the points within 4 scales: what is reported is a least-squares element. A point of a fused cloud weighs what its raw
points weigh together: voxels cut a noisy surface into layers, and only with those weights is the fit that of the raw
points. For the same reason no mean of a voxel is rejected that lies within half a voxel of the surface.

The covariance comes from the residuals summed over patches, so that what neighbours have in common is not averaged
away (cluster-robust, K.-Y. Liang and S. L. Zeger, Biometrika 73, 1986), with Student's factor for the number of patches.
What is common to a whole feature shows in no residual: for that a fit keeps its response to displacements of its patches
(see `measure.inspecting.uncertainty`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.inspecting.coverage import Coverage, coverage_of, on_seen_sectors
from measure.inspecting.patches import IntArray, PatchSums, patch_covariance, patches_of
from measure.inspecting.shapes import ConeShape, Distances, Shape, StadiumShape

_THINNED = 6_000
_ROUNDS = 25
_TUKEY = 4.685
_CUT = 4.0
_WIDER_FOR_RAW = 1.5
_LAYERS = 4
_VOXELS = 0.5
_SMALLEST_SCALE_MM = 1e-5
_LONGEST_STEP_MM = 0.5
_FEWEST_PER_PARAMETER = 5
_LARGEST_TURN_RAD = 0.15
_LOOK = "Look at alignment, nominal and search_mm, and whether the scans show the place."
_MOST_CONDITION = 1e5


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A fitted shape as the place where points belong to it."""

    shape: Shape
    params: FloatArray
    """(p,)."""
    limit_mm: float

    def holds(self, in_part_mm: FloatArray) -> NDArray[np.bool_]:
        """(n,) which points (n, 3) lie on it, in its region."""
        local = se3.apply(self.shape.local_from_part, in_part_mm)
        return np.asarray(self.shape.near(local) & (np.abs(self.shape.distances(self.params, local).residual_mm) <= self.limit_mm))


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """How p parameters answer to small displacements of K patches: change = sum over k of by_patch[k] @ displacement[k]."""

    centre_in_part_mm: FloatArray
    """(K, 3)."""
    by_patch: FloatArray
    """(K, p, 3)."""
    size_mm: float
    """Edge of a patch."""
    outward: FloatArray
    """(p,) change per mm by which the whole surface moves out of the material."""
    surface: Surface | None = None
    """What tells the points that a view has of it from those beside it; None where the points' place alone must do."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """One fitted shape."""

    shape: Shape
    params: FloatArray
    """(p,)."""
    covariance: FloatArray
    """(p, p) by what the residuals show."""
    response: Response
    rms_mm: float
    """Of the residuals of the points used, by their weights."""
    rows: IntArray
    """(n,) which points of the cloud those are."""
    n_rejected: int
    patch_residual_mm: FloatArray
    """(K,) mean residual of each patch."""
    patch_count: IntArray
    """(K,) points of each patch."""
    patch_jacobian: FloatArray
    """(K, p) mean of the residual's derivatives by the parameters."""
    patch_normal: FloatArray
    """(K, 3) mean of its derivatives by the point, frame of the part."""
    coverage: Coverage | None = None
    """Of a round feature's circumference."""


@dataclass(frozen=True, slots=True, eq=False)
class FitPoints:
    """The points of one feature."""

    in_part_mm: FloatArray
    """(n, 3)."""
    weights: FloatArray
    """(n,) at least 0."""
    rows: IntArray
    """(n,) what they are called in the cloud."""
    voxel_mm: float = 0.0

    def taken(self, kept: NDArray[np.bool_]) -> FitPoints:
        """Some of them."""
        return FitPoints(self.in_part_mm[kept], self.weights[kept], self.rows[kept], self.voxel_mm)


def fit_shape(shape: Shape, points: FitPoints, *, name: str) -> Fit:
    """Fit a shape to its points.

    Args:
        shape: the nominal.
        points: of the nominal region.
        name: of the feature, for errors.

    Raises:
        DataError: too few points, or they leave the shape open.
    """
    local = se3.apply(shape.local_from_part, points.in_part_mm)
    n_params, n_points = len(shape.names), int((points.weights > 0).sum())
    if n_points < _FEWEST_PER_PARAMETER * n_params:
        message = f"{n_points} points of the cloud lie where the feature should be, {_FEWEST_PER_PARAMETER * n_params} are needed"
        raise DataError(message, where=name, remedy=_LOOK)
    thinned = slice(None, None, max(1, len(local) // _THINNED))
    robust, scale = _robust_start(shape, local[thinned], points.weights[thinned], points.voxel_mm, name)
    kept = np.abs(shape.distances(robust, local).residual_mm) <= max(_CUT * scale, _VOXELS * points.voxel_mm)
    kept[kept] = on_seen_sectors(shape, local[kept], robust)
    local, used = local[kept], points.taken(kept)
    params = _least_squares(shape, local, used.weights, robust, name)
    _require_near_nominal(shape, params, name)
    found = _described(shape, params, local, used, len(kept) - len(local))
    # what hangs on how far-off points are treated is not known better than that
    return replace(found, covariance=found.covariance + np.outer(params - robust, params - robust))


def _robust_start(shape: Shape, local: FloatArray, weights: FloatArray, voxel_mm: float, name: str) -> tuple[FloatArray, float]:
    params = np.zeros(len(shape.names))
    scale = np.inf
    for _ in range(_ROUNDS):
        found = shape.distances(params, local)
        scale = max(_scale_of(found.residual_mm), _VOXELS * voxel_mm / _CUT, _SMALLEST_SCALE_MM)
        share = np.clip(found.residual_mm / (_TUKEY * scale), -1.0, 1.0)
        step = _step(found, weights * (1.0 - share**2) ** 2, name)
        params = params + step
        if np.abs(step).max() < 1e-3 * scale:
            break
    return params, max(_scale_of(shape.distances(params, local).residual_mm), _SMALLEST_SCALE_MM)


def _least_squares(shape: Shape, local: FloatArray, weights: FloatArray, params: FloatArray, name: str) -> FloatArray:
    for _ in range(8):
        step = _step(shape.distances(params, local), weights, name)
        params = params + step
        if np.abs(step).max() < 1e-5:
            break
    return params


def _require_near_nominal(shape: Shape, params: FloatArray, name: str) -> None:
    """A fit that leaves the place where its points were looked for rests on too few or on the wrong ones."""
    turns = np.array([parameter.startswith(("tilt", "turn", "half")) for parameter in shape.names])
    if np.abs(params[~turns]).max(initial=0.0) > 2 * shape.search_mm or np.abs(params[turns]).max(initial=0.0) > _LARGEST_TURN_RAD:
        raise DataError("the points found near the nominal do not show the feature there", where=name, remedy=_LOOK)


def _scale_of(residual_mm: FloatArray) -> float:
    """Standard deviation about zero, by the median of sizes."""
    return 1.4826 * float(np.median(np.abs(residual_mm)))


def _step(found: Distances, weights: FloatArray, name: str) -> FloatArray:
    weighted = found.jacobian * weights[:, None]
    normal = weighted.T @ found.jacobian
    size = np.sqrt(np.maximum(np.diag(normal), 1e-30))
    if np.linalg.cond(normal / np.outer(size, size)) > _MOST_CONDITION**2:
        raise DataError(
            "the points leave the feature open: they cover too little of it",
            where=name,
            remedy="Scan more of the feature, or describe it by another one (a circle, a plane).",
        )
    step = -np.linalg.solve(normal, weighted.T @ found.residual_mm)
    return np.asarray(step * min(1.0, _LONGEST_STEP_MM / max(float(np.abs(step).max()), 1e-12)))


def _layers(shape: Shape, local: FloatArray) -> IntArray | None:
    """(n,) which of the layers along its axis a point of a wall lies in; None where there is no wall."""
    if not isinstance(shape, ConeShape | StadiumShape):
        return None
    z = local[:, 2]
    edges = np.quantile(z, np.linspace(0, 1, _LAYERS + 1)[1:-1])
    return np.unique(np.searchsorted(edges, z), return_inverse=True)[1].astype(np.int64)


def _described(shape: Shape, params: FloatArray, local: FloatArray, points: FitPoints, n_rejected: int) -> Fit:
    found = shape.distances(params, local)
    gradient = found.gradient @ shape.local_from_part[:3, :3]
    weighted = found.jacobian * points.weights[:, None]
    # (n, p): what a residual does to the parameters
    gain = np.asarray(-np.linalg.solve(weighted.T @ found.jacobian, weighted.T).T, dtype=np.float64)
    labels, size_mm = patches_of(points.in_part_mm)
    patches = PatchSums(labels, points.weights)
    rms_mm = float(np.sqrt(np.average(found.residual_mm**2, weights=points.weights)))
    response = Response(
        centre_in_part_mm=patches.mean(points.in_part_mm),
        by_patch=patches.total((gain[:, :, None] * gradient[:, None, :]).reshape(len(gain), -1)).reshape(len(patches.weights), -1, 3),
        size_mm=size_mm,
        outward=np.asarray(gain.sum(axis=0) * shape.outward),
        # single points scatter more than means of voxels do
        surface=Surface(shape, params, _WIDER_FOR_RAW * _CUT * max(rms_mm, _SMALLEST_SCALE_MM)),
    )
    return Fit(
        shape=shape,
        params=params,
        covariance=patch_covariance(gain, found.residual_mm, points.in_part_mm, found.jacobian, _layers(shape, local)),
        response=response,
        rms_mm=rms_mm,
        rows=points.rows,
        n_rejected=n_rejected,
        patch_residual_mm=patches.mean(found.residual_mm[:, None])[:, 0],
        patch_count=patches.counts,
        patch_jacobian=patches.mean(found.jacobian),
        patch_normal=patches.mean(gradient),
        coverage=coverage_of(shape, local, params),
    )
