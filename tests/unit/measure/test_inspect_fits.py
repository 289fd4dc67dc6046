"""Fits of an inspection: exact points, rigid motion, outliers, the traits of fused clouds, honest intervals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.inspecting.edges import rim_points
from measure.inspecting.fitting import Fit, FitPoints, fit_shape, response_patches
from measure.inspecting.shapes import ConeShape, PlaneShape, Shape, SphereShape, StadiumShape, cylinder, frame_about
from measure.inspecting.uncertainty import StatedField, joint_covariance
from tests.support.machined import voxel_means

FRAME = frame_about([300.0, -200.0, 100.0], [0.3, -0.2, 0.9])
SLOT = ("x", "y", "radius", "turn", "straight")
SHAPES: dict[str, Shape] = {
    "sphere": SphereShape(FRAME, 12.0, 3.0, np.pi),
    "plane": PlaneShape(FRAME, (20.0, 15.0), 3.0),
    "cylinder": cylinder(FRAME, 10.0, 8.0, 3.0, 1.0),
    "cone": ConeShape(FRAME, 10.0, 0.5, 6.0, 3.0),
    "circle": StadiumShape(FRAME, 8.0, 0.0, 3.0, 3.0),
    "slot": StadiumShape(FRAME, 5.0, 9.0, 3.0, 3.0, -1.0, SLOT),
}
TRUE = {
    "sphere": [0.3, -0.2, 0.1, 0.15],
    "plane": [0.2, 0.004, -0.003],
    "cylinder": [0.2, -0.1, 0.005, 0.004, 0.12],
    "cone": [0.2, -0.1, 0.005, 0.004, 0.12, 0.01],
    "circle": [0.3, -0.1, 0.2],
    "slot": [0.2, -0.1, 0.15, 0.01, 0.2],
}


def on_surface(name: str, n: int, rng: np.random.Generator, params: object = None) -> FloatArray:
    """Points of a shape at parameters, own frame: random ones drawn onto it along the gradient."""
    shape = SHAPES[name]
    reach = shape.reach_mm * (0.9 if name == "plane" else 1.0)
    points = rng.uniform(-1, 1, (40 * n, 3)) * reach
    points = points[shape.near(points)][:n]
    at = np.array(TRUE[name] if params is None else params)
    for _ in range(12):
        found = shape.distances(at, points)
        points = points - found.residual_mm[:, None] * found.gradient
    return points


def fitted(name: str, local: FloatArray, *, voxel_mm: float = 0.0) -> Fit:
    in_part = se3.apply(se3.inverse(SHAPES[name].local_from_part), local)
    return fit_shape(SHAPES[name], FitPoints(in_part, np.ones(len(local)), np.arange(len(local)), voxel_mm), name=name)


@pytest.mark.parametrize("name", SHAPES)
def test_derivatives_against_finite_differences(name: str) -> None:
    rng = np.random.default_rng(1)
    shape, params, step = SHAPES[name], np.array(TRUE[name]), 1e-6
    points = on_surface(name, 200, rng) + rng.normal(0, 0.2, (200, 3))
    found = shape.distances(params, points)
    for i, row in enumerate(np.eye(len(params)) * step):
        difference = shape.distances(params + row, points).residual_mm - shape.distances(params - row, points).residual_mm
        np.testing.assert_allclose(found.jacobian[:, i], difference / (2 * step), atol=1e-5)
    for i, row in enumerate(np.eye(3) * step):
        difference = shape.distances(params, points + row).residual_mm - shape.distances(params, points - row).residual_mm
        np.testing.assert_allclose(found.gradient[:, i], difference / (2 * step), atol=1e-5)


@pytest.mark.parametrize("name", SHAPES)
def test_exact_points_give_the_shape_and_a_fifth_of_outliers_does_not_move_it(name: str) -> None:
    rng = np.random.default_rng(2)
    local = on_surface(name, 1500, rng)
    np.testing.assert_allclose(fitted(name, local).params, TRUE[name], atol=1e-6)
    noisy = local + rng.normal(0, 0.005, local.shape)
    noisy[:300] += SHAPES[name].distances(np.array(TRUE[name]), noisy[:300]).gradient * rng.uniform(0.5, 2.0, (300, 1))
    found = fitted(name, noisy)
    assert found.n_rejected >= 290
    np.testing.assert_allclose(found.params, TRUE[name], atol=6 * 0.005 / np.sqrt(50))


@pytest.mark.parametrize("name", SHAPES)
def test_the_stated_response_is_what_a_refit_shows(name: str) -> None:
    """Patches moved by small random displacements: the fit follows as its response says."""
    rng = np.random.default_rng(3)
    local = on_surface(name, 1500, rng) + rng.normal(0, 1e-4, (1500, 3))
    before = fitted(name, local, voxel_mm=1.0)
    displacement = rng.normal(0, 0.02, before.response.centre_in_part_mm.shape)
    in_part = se3.apply(se3.inverse(FRAME), local)
    moved = se3.apply(FRAME, in_part + displacement[response_patches(SHAPES[name], in_part)[0]])
    expected = np.einsum("kpi,ki->p", before.response.by_patch, displacement)
    found = fitted(name, moved, voxel_mm=1.0).params - before.params
    np.testing.assert_allclose(found, expected, atol=0.05 * np.abs(expected).max())


def test_layers_that_voxels_cut_a_noisy_plane_into_do_not_move_it() -> None:
    rng = np.random.default_rng(4)
    raw = np.column_stack([rng.uniform(-20, 20, (60_000, 2)), rng.normal(0.43, 0.08, 60_000)])  # 0.07 below a voxel's face
    means, count = voxel_means(raw, 0.5)
    shape = PlaneShape(np.eye(4), (18.0, 18.0), 2.0)
    inside = shape.near(means)
    weighed, equal = (
        fit_shape(shape, FitPoints(means[inside], w[inside], np.flatnonzero(inside), 0.5), name="p").params[0] for w in (count, np.ones(len(count)))
    )
    assert abs(weighed - 0.43) < 0.003
    assert abs(equal - 0.43) > 0.02  # what the weights are for


def test_noise_along_the_rays_does_not_open_a_cone() -> None:
    rng = np.random.default_rng(5)
    z, angle = rng.uniform(-4, 4, 40_000), rng.uniform(-np.pi, np.pi, 40_000)
    radius = 12.5 + z
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z + rng.normal(0, 0.08, 40_000)])
    shape = ConeShape(np.eye(4), 12.5, np.pi / 4, 1.5, 2.0)
    points = points[shape.near(points)]
    half_angle = fit_shape(shape, FitPoints(points, np.ones(len(points)), np.arange(len(points))), name="c").params[5]
    assert abs(np.degrees(2 * half_angle)) < 0.15


@pytest.mark.parametrize("name", ["plane", "cylinder", "sphere"])
def test_intervals_from_residuals_cover_noise_and_bumps_that_neighbours_share(name: str) -> None:
    base = on_surface(name, 600, np.random.default_rng(6))
    normals = SHAPES[name].distances(np.array(TRUE[name]), base).gradient
    bumps = _bumps(base, length_mm=1.5)
    inside = []
    for seed in range(40):
        rng = np.random.default_rng([7, seed])
        off = rng.normal(0, 0.03, len(base)) + bumps(rng) * 0.03
        found = fitted(name, base + off[:, None] * normals)
        inside.append(np.abs(found.params - TRUE[name]) <= 2 * np.sqrt(np.diag(found.covariance())))
    assert 0.88 <= np.mean(inside) <= 0.995


def _bumps(points: FloatArray, length_mm: float) -> Callable[[np.random.Generator], FloatArray]:
    """A random field over points (n, 3): Gaussian bumps of about this size and unit variance."""

    def draw(rng: np.random.Generator) -> FloatArray:
        waves = rng.normal(0, 1 / length_mm, (60, 3))
        return np.asarray(np.sqrt(2 / 60) * np.cos(points @ waves.T + rng.uniform(0, 2 * np.pi, 60)).sum(axis=1))

    return draw


def test_a_stated_field_covers_whatever_its_correlation_length() -> None:
    """Displacements of the stated size, common to patches of any size: no parameter is worse than stated."""
    local = on_surface("cylinder", 500, np.random.default_rng(8))
    exact = fitted("cylinder", local)
    covariance = joint_covariance([exact.response], [exact.covariance()], StatedField(0.05, "stated"), 0.0)
    sigma = np.array([np.sqrt(covariance.of(row[None])[0, 0]) for row in np.eye(5)])
    for length_mm in (3.0, 15.0):
        draw = _bumps(local, length_mm)
        errors = []
        for seed in range(25):
            rng = np.random.default_rng([9, seed])
            errors.append(fitted("cylinder", local + 0.05 * np.column_stack([draw(rng) for _ in range(3)]), voxel_mm=1.0).params - TRUE["cylinder"])
        assert (np.sqrt(np.mean(np.square(errors), axis=0)) < 1.35 * sigma).all()


def test_what_two_planes_share_cancels_in_their_distance() -> None:
    shapes = [PlaneShape(frame_about([0, 0, z], [0, 0, 1]), (10.0, 10.0), 2.0) for z in (0.0, 20.0)]
    grid = np.stack(np.meshgrid(np.linspace(-9, 9, 30), np.linspace(-9, 9, 30)), axis=-1).reshape(-1, 2)
    fits = [
        fit_shape(shape, FitPoints(np.column_stack([grid, np.full(len(grid), z)]), np.ones(len(grid)), np.arange(len(grid))), name="p")
        for shape, z in zip(shapes, (0.0, 20.0), strict=True)
    ]
    joint = joint_covariance([fit.response for fit in fits], [fit.covariance() for fit in fits], StatedField(0.1, ""), 0.0)
    long_range = joint.by_field[-1]
    gradient = np.array([[-1.0, 0, 0, 1.0, 0, 0]])
    assert (gradient @ long_range @ gradient.T)[0, 0] < 1e-9
    assert np.sqrt(long_range[0, 0]) == pytest.approx(0.1)


@pytest.mark.parametrize("name", ["cylinder", "plane", "slot"])
def test_points_that_leave_a_feature_open_or_belong_elsewhere_are_told(name: str) -> None:
    rng = np.random.default_rng(10)
    local = on_surface(name, 3000, rng)
    line = local[np.abs(local[:, 1] - local[0, 1]) < 0.02]
    with pytest.raises(DataError, match=name):
        fitted(name, np.repeat(line[:2], 12, axis=0))
    with pytest.raises(DataError, match="points of the cloud lie where"):
        fitted(name, local[:4])


def test_a_hole_in_a_sheet_is_measured_by_its_rim_within_what_its_spacing_allows() -> None:
    shape = StadiumShape(np.eye(4), 8.0, 0.0, 3.0, 3.0, -1.0)
    errors = []
    for seed in range(20):
        rng = np.random.default_rng([11, seed])
        shift = rng.uniform(0, 0.5, 2)
        x, y = np.meshgrid(np.arange(-15, 15, 0.5) + shift[0], np.arange(-15, 15, 0.5) + shift[1])
        sheet = np.column_stack([x.ravel(), y.ravel(), rng.normal(0, 0.01, x.size)])
        sheet = sheet[np.hypot(sheet[:, 0] - 0.2, sheet[:, 1] + 0.1) > 8.1]
        rim, rows, spacing = rim_points(shape, sheet, np.flatnonzero(shape.near(sheet)), "rim")
        assert spacing == pytest.approx(0.5, rel=0.15)
        found = fit_shape(shape, FitPoints(rim, np.ones(len(rim)), rows, spacing), name="rim")
        errors.append(found.params - [0.2, -0.1, 0.1])
    assert np.abs(errors).max() < 0.5 / np.sqrt(3) * 2
    assert abs(np.mean(errors, axis=0)[2]) < 0.12
