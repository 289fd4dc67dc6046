"""SE(3): group axioms over batch shapes, near identity and near half turns, and SciPy as an oracle."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

BATCHES = [(), (1,), (7,), (2, 3)]
ANGLES = {
    "any": (0.0, 3.1),
    "identity": (0.0, 0.0),
    "rounding": (1e-16, 1e-14),
    "tiny": (1e-9, 1e-7),
    "at the series switch": (0.99e-4, 1.01e-4),
    "small": (1e-4, 1e-2),
    "near half a turn": (np.pi - 1e-6, np.pi - 1e-9),
    "very near half a turn": (np.pi - 1e-12, np.pi - 1e-14),
}
cases = pytest.mark.parametrize(("batch", "angles"), [(b, a) for b in BATCHES for a in ANGLES], ids=str)

numbers = st.floats(-1.0, 1.0, allow_nan=False, allow_subnormal=False)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)


def twists(batch: tuple[int, ...], angles: str, seed: int = 0) -> FloatArray:
    rng = np.random.default_rng([seed, *batch, len(angles)])
    axis = rng.normal(size=(*batch, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    rho = rng.uniform(-800, 800, (*batch, 3))
    return np.concatenate([rho, axis * rng.uniform(*ANGLES[angles], (*batch, 1))], axis=-1)


def transforms(batch: tuple[int, ...], angles: str, seed: int = 0) -> FloatArray:
    """By SciPy, so that the code under test does not make its own cases."""
    xi = twists(batch, angles, seed)
    result = np.broadcast_to(np.eye(4), (*batch, 4, 4)).copy()
    result[..., :3, :3] = Rotation.from_rotvec(xi[..., 3:].reshape(-1, 3)).as_matrix().reshape(*batch, 3, 3)
    result[..., :3, 3] = xi[..., :3]
    return result


@cases
def test_inverse_is_the_inverse_on_both_sides(batch: tuple[int, ...], angles: str) -> None:
    t = transforms(batch, angles)
    np.testing.assert_allclose(t @ se3.inverse(t), se3.identity(*batch), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(t) @ t, se3.identity(*batch), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(t), np.linalg.inv(t), atol=1e-11)


@cases
def test_apply_is_an_action_of_the_group(batch: tuple[int, ...], angles: str) -> None:
    a, b = transforms(batch, angles), transforms(batch, "any", seed=1)
    points = np.random.default_rng(2).normal(size=(*batch, 3)) * 100
    np.testing.assert_allclose(se3.apply(a @ b, points), se3.apply(a, se3.apply(b, points)), atol=1e-10)
    homogeneous = np.concatenate([points, np.ones((*batch, 1))], axis=-1)
    np.testing.assert_allclose(se3.apply(a, points), (a @ homogeneous[..., None])[..., :3, 0], atol=1e-10)


def test_apply_broadcasts_one_transform_over_points_and_points_over_transforms() -> None:
    t, points = transforms((5,), "any"), np.random.default_rng(0).normal(size=(5, 3))
    one_by_one = np.stack([[se3.apply(t[i], points[j]) for j in range(5)] for i in range(5)])
    np.testing.assert_allclose(se3.apply(t[0], points), one_by_one[0])
    np.testing.assert_allclose(se3.apply(t[:, None], points), one_by_one)


@cases
def test_exp_gives_rigid_transforms_and_log_undoes_it(batch: tuple[int, ...], angles: str) -> None:
    xi = twists(batch, angles)
    t = se3.exp(xi)
    assert all(se3.is_rigid(one, tolerance=1e-14 * 10) for one in t.reshape(-1, 4, 4))
    np.testing.assert_allclose(se3.log(t)[..., 3:], xi[..., 3:], atol=2e-15 if "half" not in angles else 1e-13)
    # rho is as long as 800 mm, and near half a turn 1e-16 in the matrix is 1e-16 in the axis
    np.testing.assert_allclose(se3.log(t)[..., :3], xi[..., :3], atol=1e-10)


@cases
def test_log_then_exp_gives_the_transform_back(batch: tuple[int, ...], angles: str) -> None:
    t = transforms(batch, angles)
    np.testing.assert_allclose(se3.exp(se3.log(t)), t, atol=1e-10)


@cases
def test_exp_and_log_agree_with_scipy(batch: tuple[int, ...], angles: str) -> None:
    xi = twists(batch, angles).reshape(-1, 6)
    oracle = RigidTransform.from_exp_coords(np.concatenate([xi[:, 3:], xi[:, :3]], axis=-1))
    np.testing.assert_allclose(se3.exp(xi), oracle.as_matrix(), atol=1e-10)
    expected = oracle.as_exp_coords()
    if "very" not in angles:  # SciPy may choose the other axis there
        np.testing.assert_allclose(se3.log(oracle.as_matrix()), np.concatenate([expected[:, 3:], expected[:, :3]], axis=-1), atol=1e-6)


@cases
def test_adjoint_moves_a_twist_across_a_transform(batch: tuple[int, ...], angles: str) -> None:
    t, xi = transforms(batch, "any"), twists(batch, angles, seed=3) * [1e-2, 1e-2, 1e-2, 1, 1, 1]
    moved = (se3.adjoint(t) @ xi[..., None])[..., 0]
    np.testing.assert_allclose(t @ se3.exp(xi), se3.exp(moved) @ t, atol=1e-9)


@pytest.mark.parametrize("batch", BATCHES, ids=str)
def test_adjoint_is_a_homomorphism(batch: tuple[int, ...]) -> None:
    a, b = transforms(batch, "any"), transforms(batch, "any", seed=1)
    np.testing.assert_allclose(se3.adjoint(a @ b), se3.adjoint(a) @ se3.adjoint(b), atol=1e-9)
    np.testing.assert_allclose(se3.adjoint(se3.inverse(a)), np.linalg.inv(se3.adjoint(a)), atol=1e-9)


def test_left_update_is_the_derivative_of_a_moved_point() -> None:
    """d(exp(delta) p)/d(delta) at 0 is [I | -hat(p)], which every Jacobian of the solvers rests on."""
    point, step = np.array([120.0, -40.0, 300.0]), 1e-6
    columns = [(se3.apply(se3.exp(step * e), point) - se3.apply(se3.exp(-step * e), point)) / (2 * step) for e in np.eye(6)]
    np.testing.assert_allclose(np.stack(columns, axis=-1), np.hstack([np.eye(3), -se3.hat(point)]), atol=1e-6)


@given(vectors, vectors)
def test_hat_is_the_cross_product_and_antisymmetric(a: FloatArray, b: FloatArray) -> None:
    np.testing.assert_allclose(se3.hat(a) @ b, np.cross(a, b), atol=1e-15)
    np.testing.assert_array_equal(se3.hat(a).T, -se3.hat(a))


@given(vectors.filter(lambda v: float(np.linalg.norm(v)) > 1e-3), st.floats(0, 3.14159))
def test_quaternion_agrees_with_scipy(axis: FloatArray, angle: float) -> None:
    rotation = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle)
    ours = se3.quaternion_wxyz(rotation.as_matrix())
    assert ours[0] >= 0
    np.testing.assert_allclose(ours, rotation.as_quat(canonical=True, scalar_first=True), atol=1e-14)


def test_log_of_exact_half_turns_is_half_a_turn_about_the_same_axis() -> None:
    for axis in [*np.eye(3), np.array([1, 1, 0]) / np.sqrt(2), np.array([-1, 2, -2]) / 3]:
        rotation = 2 * np.outer(axis, axis) - np.eye(3)
        phi = se3.log_so3(rotation)
        assert np.linalg.norm(phi) == pytest.approx(np.pi, abs=1e-14)
        assert abs(phi @ axis) == pytest.approx(np.pi, abs=1e-14)


def test_nearest_rotation_is_a_projection_and_undoes_noise_to_second_order() -> None:
    rng = np.random.default_rng(4)
    rotation = transforms((50,), "any")[:, :3, :3]
    noise = rng.normal(size=(50, 3, 3)) * 1e-5
    noise = noise + np.swapaxes(noise, -1, -2)  # symmetric: pure stretch, seen from the rotation
    np.testing.assert_allclose(se3.nearest_rotation(rotation @ (np.eye(3) + noise)), rotation, atol=1e-8)
    np.testing.assert_allclose(se3.nearest_rotation(rotation), rotation, atol=1e-14)
    assert (np.linalg.det(se3.nearest_rotation(rng.normal(size=(200, 3, 3)))) > 0).all()


def test_fit_rigid_finds_the_transform_and_is_least_squares() -> None:
    rng = np.random.default_rng(5)
    truth, source = transforms((), "any"), rng.normal(size=(30, 3)) * 200
    np.testing.assert_allclose(se3.fit_rigid(source, se3.apply(truth, source)), truth, atol=1e-10)
    target = se3.apply(truth, source) + rng.normal(size=source.shape)
    best = se3.fit_rigid(source, target)

    def cost(t: FloatArray) -> float:
        return float(((se3.apply(t, source) - target) ** 2).sum())

    scales = np.array([1e-2, 1e-2, 1e-2, 1e-4, 1e-4, 1e-4])
    assert all(cost(se3.exp(rng.normal(size=6) * scales) @ best) > cost(best) for _ in range(50))


@pytest.mark.parametrize(
    "matrix",
    [
        np.eye(3),
        np.full((4, 4), np.nan),
        np.diag([1, 1, -1, 1.0]),
        np.diag([1, 1, 1.001, 1]),
        np.diag([1000, 1000, 1000, 1.0]),
        np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [10, 20, 30, 1.0]]),
    ],
    ids=["3x3", "nan", "mirror", "stretch", "scale", "transposed"],
)
def test_is_rigid_refuses(matrix: FloatArray) -> None:
    assert not se3.is_rigid(matrix)


def test_is_rigid_takes_what_a_file_rounds() -> None:
    assert se3.is_rigid(np.round(transforms((), "any"), 7))


def test_point_columns_are_the_derivative_by_a_left_twist() -> None:
    rng = np.random.default_rng(8)
    points = rng.normal(0, 300, (4, 5, 3))
    columns = se3.point_columns(points)
    for k, h in enumerate([1e-3] * 3 + [1e-6] * 3):
        step = h * np.eye(6)[k]
        moved = (se3.apply(se3.exp(step), points) - se3.apply(se3.exp(-step), points)) / (2 * h)
        np.testing.assert_allclose(columns[..., k], moved, atol=1e-5)
