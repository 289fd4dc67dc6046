"""Robust least-squares fits, what their residuals say of the result, and how the result answers to errors of the cloud.

A fit begins with Tukey's weights on a thinned set, whose scale the data gives, and ends as a least-squares fit of all
points, each by its chance of lying on the surface and not straying (`measure.inspecting.strays`). A point of a fused cloud
weighs what its raw points weigh together: voxels cut a noisy surface into layers, and only with those weights is the fit
that of the raw points. For the same reason the surface's noise is not taken as less than an eighth of a voxel.

What residuals tell of the result is kept in two parts: noise of single points, and what patches of neighbours have in
common (`measure.inspecting.patches`), part of which the cloud's own errors explain. What is common to a whole feature
shows in no residual: for that a fit keeps its response to displacements of its patches (`measure.inspecting.uncertainty`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.inspecting.coverage import Coverage, coverage_of, on_seen_sectors
from measure.inspecting.patches import CELLS_ACROSS, COARSE_CELLS_ACROSS, Division, IntArray, PatchSums, Scatter, patches_of, scatters_of
from measure.inspecting.robust import fit_step, robust_fit
from measure.inspecting.shapes import ConeShape, Distances, PlaneShape, Shape, StadiumShape
from measure.inspecting.strays import Mixture

_CUT = 4.0
_WIDER_FOR_RAW = 1.5
_LAYERS = 4
_CELLS_OF_WALLS = 12
_CORE = 2.0
_VOXELS = 0.5
_SMALLEST_SCALE_MM = 1e-5
_FEWEST_PER_PARAMETER = 5
_LARGEST_TURN_RAD = 0.15
_LOOK = "Look at alignment, nominal and search_mm, and whether the scans show the place."


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

    def distances(self, in_part_mm: FloatArray) -> Distances:
        """Of points (n, 3); the gradient is in the frame of the part."""
        found = self.shape.distances(self.params, se3.apply(self.shape.local_from_part, in_part_mm))
        return found._replace(gradient=found.gradient @ self.shape.local_from_part[:3, :3])


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
    noise_covariance: FloatArray
    """(p, p) by the noise of single points, and by what strays may pull."""
    scatters: tuple[Scatter, ...]
    """What groups of neighbours have in common, divided in several ways."""
    response: Response
    rms_mm: float
    """Of the residuals of the points used, by their weights."""
    rows: IntArray
    """(n,) which points of the cloud those are."""
    n_rejected: int
    patch_residual_mm: FloatArray
    """(K,) mean residual of each patch of the form, which are larger than those of the response."""
    patch_count: IntArray
    """(K,) points of each patch."""
    patch_jacobian: FloatArray
    """(K, p) mean of the residual's derivatives by the parameters."""
    patch_motion: FloatArray
    """(K, K', 3) how that mean answers to displacements of the response's patches, the shape held."""
    coverage: Coverage | None = None
    """Of a round feature's circumference."""

    def covariance(self, explained: Sequence[FloatArray] = ()) -> FloatArray:
        """(p, p) by what the residuals show.

        Args:
            explained: (p, p) for each scatter, what known errors of the cloud make of it.
        """
        beyond = [scatter.beyond(explained[number] if explained else 0.0) for number, scatter in enumerate(self.scatters)]
        if not beyond:
            return self.noise_covariance
        # of the variances that the divisions show the largest; correlations are those of the finest
        sigma, finest = np.sqrt(np.max(beyond, axis=0)), self.scatters[0].observed
        size = np.sqrt(np.maximum(np.diag(finest), 1e-300))
        return np.asarray(self.noise_covariance + finest * np.outer(sigma / size, sigma / size))


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


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Where a shape lies, and the points that it rests on."""

    params: FloatArray
    local: FloatArray
    """(n, 3) kept, in the shape's own frame."""
    points: FitPoints
    """The same, weighted for the fit."""
    mixture: Mixture
    n_left_out: int


def place_shape(shape: Shape, points: FitPoints, *, name: str) -> FloatArray:
    """Parameters of `fit_shape` alone, for who asks for no uncertainty; arguments and errors are its own."""
    return _find(shape, points, name).params


def fit_shape(shape: Shape, points: FitPoints, *, name: str) -> Fit:
    """Fit a shape to its points.

    Args:
        shape: the nominal.
        points: of the nominal region.
        name: of the feature, for errors.

    Raises:
        DataError: too few points, or they leave the shape open.
    """
    found = _find(shape, points, name)
    params, local, used, mixture = found.params, found.local, found.points, found.mixture
    chance = mixture.chances(shape.distances(params, local).residual_mm)
    described = _described(shape, params, local, replace(used, weights=used.weights * chance), found.n_left_out)
    # strays pull to one side: what a narrower look at the surface changes is not known better than that
    core = np.abs(shape.distances(params, local).residual_mm) <= max(_CORE * mixture.sigma_mm, _VOXELS * points.voxel_mm)
    pulled = fit_step(shape.distances(params, local[core]), used.weights[core], name)
    return replace(described, noise_covariance=described.noise_covariance + np.outer(pulled, pulled))


def _find(shape: Shape, points: FitPoints, name: str) -> _Found:
    local = se3.apply(shape.local_from_part, points.in_part_mm)
    _require_enough(int((points.weights > 0).sum()), shape, "lie where the feature should be", name)
    least_sigma_mm = max(_VOXELS * points.voxel_mm / _CUT, _SMALLEST_SCALE_MM)
    robust, mixture = robust_fit(shape, local, points.weights, least_sigma_mm, name)
    chance = mixture.chances(shape.distances(robust, local).residual_mm)
    kept = chance > 0.5
    kept[kept] = on_seen_sectors(shape, local[kept], robust)
    local, used = local[kept], points.taken(kept)
    used = replace(used, weights=used.weights * _tapered(shape, local, points.voxel_mm))
    _require_enough(len(local), shape, "make a surface where the feature should be", name)
    params = _least_squares(shape, local, used.weights, robust, mixture, name)
    _require_near_nominal(shape, params, name)
    return _Found(params, local, used, mixture, len(kept) - len(local))


def _tapered(shape: Shape, local: FloatArray, voxel_mm: float) -> FloatArray:
    """(n,) weights that fade over the last voxel of a cone's ends.

    Voxels cut a steep surface into steps, within each of which the means' residuals run from one sign to the other: a
    region that ends within a step keeps a piece of it at full lever, 0.1 degrees of the angle for voxels of 0.5 mm.
    """
    if not isinstance(shape, ConeShape) or shape.half_angle_rad == 0.0 or voxel_mm == 0.0:
        return np.ones(len(local))
    return np.asarray(np.clip((shape.half_length_mm - np.abs(shape.along(local))) / min(voxel_mm, shape.half_length_mm / 2), 0.0, 1.0))


def _least_squares(shape: Shape, local: FloatArray, weights: FloatArray, params: FloatArray, mixture: Mixture, name: str) -> FloatArray:
    for _ in range(8):
        found = shape.distances(params, local)
        step = fit_step(found, weights * mixture.chances(found.residual_mm), name)
        params = params + step
        if np.abs(step).max() < 1e-5:
            break
    return params


def _require_enough(n_points: int, shape: Shape, where: str, name: str) -> None:
    """A few strays lie near a plane that was not seen at all."""
    needed = _FEWEST_PER_PARAMETER * len(shape.names)
    if n_points < needed:
        raise DataError(f"{n_points} points of the cloud {where}, {needed} are needed", where=name, remedy=_LOOK)


def _require_near_nominal(shape: Shape, params: FloatArray, name: str) -> None:
    """A fit that leaves the place where its points were looked for rests on too few or on the wrong ones."""
    turns = np.array([parameter.startswith(("tilt", "turn", "half")) for parameter in shape.names])
    if np.abs(params[~turns]).max(initial=0.0) > 2 * shape.search_mm or np.abs(params[turns]).max(initial=0.0) > _LARGEST_TURN_RAD:
        raise DataError("the points found near the nominal do not show the feature there", where=name, remedy=_LOOK)


def _patch_motion(gradient: FloatArray, weights: FloatArray, formed: IntArray, labels: IntArray) -> FloatArray:
    """(K, K', 3) mean normal of each form patch, by the response patches that its points lie in."""
    n_forms, n_patches = int(formed.max()) + 1, int(labels.max()) + 1
    both = formed * n_patches + labels
    sums = np.stack([np.bincount(both, column * weights, n_forms * n_patches) for column in gradient.T], axis=1)
    whole = np.maximum(np.bincount(formed, weights, n_forms), 1e-12)
    return np.asarray(sums.reshape(n_forms, n_patches, 3) / whole[:, None, None])


def response_patches(shape: Shape, in_part_mm: FloatArray) -> tuple[IntArray, float]:
    """Patches (n,) of points (n, 3) that a fit's response is given by, and their size in mm.

    Those of round walls are smaller: a wall turns away within a patch, and the views that see it change with it. Those of
    planes are as many across as along: the two ends of a narrow side may be seen by different views, which tilts it.
    """
    if isinstance(shape, PlaneShape):
        in_plane = se3.apply(shape.local_from_part, in_part_mm) * [1.0, 1.0, 0.0]
        return patches_of(in_plane, along_each_axis=True)
    return patches_of(in_part_mm, _CELLS_OF_WALLS if isinstance(shape, ConeShape | StadiumShape) else CELLS_ACROSS)


def _described(shape: Shape, params: FloatArray, local: FloatArray, points: FitPoints, n_rejected: int) -> Fit:
    found = shape.distances(params, local)
    gradient = found.gradient @ shape.local_from_part[:3, :3]
    weighted = found.jacobian * points.weights[:, None]
    # (n, p): what a residual does to the parameters
    gain = np.asarray(-np.linalg.solve(weighted.T @ found.jacobian, weighted.T).T, dtype=np.float64)
    labels, size_mm = response_patches(shape, points.in_part_mm)
    formed = patches_of(points.in_part_mm)[0]
    divisions = [Division.whole(formed), Division.whole(patches_of(points.in_part_mm, COARSE_CELLS_ACROSS)[0])]
    if isinstance(shape, ConeShape | StadiumShape):
        # what a whole rim has in common shows between layers alone
        divisions.append(Division.layers(local[:, 2], _LAYERS, points.voxel_mm))
    patches, forms = PatchSums(labels, points.weights), PatchSums(formed, points.weights)
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
        noise_covariance=(gain * found.residual_mm[:, None]).T @ (gain * found.residual_mm[:, None]),
        scatters=scatters_of(gain, found.residual_mm, found.jacobian, gradient, labels, divisions),
        response=response,
        rms_mm=rms_mm,
        rows=points.rows,
        n_rejected=n_rejected,
        patch_residual_mm=forms.mean(found.residual_mm[:, None])[:, 0],
        patch_count=forms.counts,
        patch_jacobian=forms.mean(found.jacobian),
        patch_motion=_patch_motion(gradient, points.weights, formed, labels),
        coverage=coverage_of(shape, local, params),
    )
