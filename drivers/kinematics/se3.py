"""SE(3) as plain (..., 4, 4) float64 arrays and pure functions.

Conventions, said once and used everywhere:

* a transform is named `target_from_source`; columns are vectors, so `base_from_camera = base_from_flange @ flange_from_camera`;
* a twist is `(rho, phi)`: three translational components in mm first, then three rotational ones in rad;
* updates act on the left: `transform <- exp(delta) @ transform`;
* every function broadcasts over leading axes.

Formulas: J. Solà, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics", arXiv:1812.01537,
appendix D (with rho and phi in the same order).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

# Below this angle the closed forms lose digits to cancellation and a Taylor series is exact to double precision.
_SMALL_ANGLE_RAD = 1e-4


def identity(*batch: int) -> FloatArray:
    """Identity transforms, shape (*batch, 4, 4)."""
    return np.broadcast_to(np.eye(4), (*batch, 4, 4)).copy()


def from_rotation_translation(rotation: ArrayLike, translation_mm: ArrayLike) -> FloatArray:
    """Transform from a rotation matrix (..., 3, 3) and a translation (..., 3)."""
    rotation_ = np.asarray(rotation, dtype=np.float64)
    translation = np.asarray(translation_mm, dtype=np.float64)
    batch = np.broadcast_shapes(rotation_.shape[:-2], translation.shape[:-1])
    result = identity(*batch)
    result[..., :3, :3] = rotation_
    result[..., :3, 3] = translation
    return result


def hat(vector: ArrayLike) -> FloatArray:
    """Cross-product matrix (..., 3, 3) of (..., 3): `hat(a) @ b == cross(a, b)`."""
    v = np.asarray(vector, dtype=np.float64)
    result = np.zeros((*v.shape[:-1], 3, 3))
    result[..., 0, 1], result[..., 0, 2] = -v[..., 2], v[..., 1]
    result[..., 1, 0], result[..., 1, 2] = v[..., 2], -v[..., 0]
    result[..., 2, 0], result[..., 2, 1] = -v[..., 1], v[..., 0]
    return result


def inverse(transform: ArrayLike) -> FloatArray:
    """Inverse of rigid transforms (..., 4, 4)."""
    t = np.asarray(transform, dtype=np.float64)
    rotation_inverse = np.swapaxes(t[..., :3, :3], -1, -2)
    return from_rotation_translation(rotation_inverse, -(rotation_inverse @ t[..., :3, 3:4])[..., 0])


def apply(target_from_source: ArrayLike, points_in_source_mm: ArrayLike) -> FloatArray:
    """Points (..., 3) moved by transforms (..., 4, 4); leading axes broadcast."""
    t = np.asarray(target_from_source, dtype=np.float64)
    points = np.asarray(points_in_source_mm, dtype=np.float64)
    rotated = np.einsum("...ij,...j->...i", t[..., :3, :3], points)
    return np.asarray(rotated + t[..., :3, 3])


def adjoint(transform: ArrayLike) -> FloatArray:
    """Adjoint (..., 6, 6): `T @ exp(xi) == exp(adjoint(T) @ xi) @ T`."""
    t = np.asarray(transform, dtype=np.float64)
    rotation = t[..., :3, :3]
    result = np.zeros((*t.shape[:-2], 6, 6))
    result[..., :3, :3] = rotation
    result[..., 3:, 3:] = rotation
    result[..., :3, 3:] = hat(t[..., :3, 3]) @ rotation
    return result


def exp_so3(rotation_vector_rad: ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) (Rodrigues)."""
    phi = np.asarray(rotation_vector_rad, dtype=np.float64)
    a, b, _ = _series(np.linalg.norm(phi, axis=-1))
    k = hat(phi)
    return np.asarray(np.eye(3) + a[..., None, None] * k + b[..., None, None] * (k @ k))


def log_so3(rotation: ArrayLike) -> FloatArray:
    """Rotation vectors (..., 3), angle at most pi, of rotation matrices (..., 3, 3).

    By way of the quaternion, which stays exact near half a turn where the trace formula breaks down.
    """
    quaternion = quaternion_wxyz(rotation)
    vector_norm = np.linalg.norm(quaternion[..., 1:], axis=-1)
    angle = 2.0 * np.arctan2(vector_norm, quaternion[..., 0])
    small = vector_norm < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, vector_norm)
    scale = np.where(small, 2.0 / quaternion[..., 0].clip(0.5), angle / safe)
    # second term of 2 atan(v/w)/v, so that nothing is lost at the switch
    scale = np.where(small, scale * (1.0 - (vector_norm / quaternion[..., 0].clip(0.5)) ** 2 / 3.0), scale)
    return np.asarray(quaternion[..., 1:] * scale[..., None])


def quaternion_wxyz(rotation: ArrayLike) -> FloatArray:
    """Unit quaternions (..., 4), w first and not negative, of rotation matrices (..., 3, 3).

    The largest of the four components is computed first (Shepperd 1978), so no root is taken of a small number.
    """
    r = np.asarray(rotation, dtype=np.float64)
    r00, r11, r22 = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    candidates = np.stack(
        [
            np.stack([1 + r00 + r11 + r22, r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1),
            np.stack([r[..., 2, 1] - r[..., 1, 2], 1 + r00 - r11 - r22, r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0]], -1),
            np.stack([r[..., 0, 2] - r[..., 2, 0], r[..., 0, 1] + r[..., 1, 0], 1 - r00 + r11 - r22, r[..., 1, 2] + r[..., 2, 1]], -1),
            np.stack([r[..., 1, 0] - r[..., 0, 1], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1], 1 - r00 - r11 + r22], -1),
        ],
        -2,
    )
    best = np.argmax(np.stack([candidates[..., i, i] for i in range(4)], -1), axis=-1)
    chosen = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    unit = chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)
    return np.asarray(unit * np.where(unit[..., :1] < 0, -1.0, 1.0))


def exp(twist: ArrayLike) -> FloatArray:
    """Transforms (..., 4, 4) of twists (..., 6) = (rho mm, phi rad)."""
    xi = np.asarray(twist, dtype=np.float64)
    translation = (_left_jacobian_so3(xi[..., 3:]) @ xi[..., :3, None])[..., 0]
    return from_rotation_translation(exp_so3(xi[..., 3:]), translation)


def log(transform: ArrayLike) -> FloatArray:
    """Twists (..., 6) = (rho mm, phi rad) of transforms (..., 4, 4)."""
    t = np.asarray(transform, dtype=np.float64)
    phi = log_so3(t[..., :3, :3])
    rho = np.linalg.solve(_left_jacobian_so3(phi), t[..., :3, 3:4])[..., 0]
    return np.concatenate([rho, phi], axis=-1)


def left_jacobian(twist: ArrayLike) -> FloatArray:
    """Left Jacobian (..., 6, 6): `exp(xi + delta) == exp(left_jacobian(xi) @ delta) @ exp(xi)` to first order.

    The series sum_k ad(xi)^k / (k + 1)!, to double precision for rotations up to about half a radian.
    """
    xi = np.asarray(twist, dtype=np.float64)
    ad = np.zeros((*xi.shape[:-1], 6, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = hat(xi[..., 3:])
    ad[..., :3, 3:] = hat(xi[..., :3])
    result = np.broadcast_to(np.eye(6), ad.shape).copy()
    term = result.copy()
    for k in range(2, 14):
        term = term @ ad / k
        result += term
    return result


def is_rigid(transform: ArrayLike, tolerance: float = 1e-6) -> bool:
    """Whether one (4, 4) matrix is finite, has an orthonormal right-handed rotation and the last row 0 0 0 1."""
    t = np.asarray(transform, dtype=np.float64)
    if t.shape != (4, 4) or not np.isfinite(t).all():
        return False
    rotation = t[:3, :3]
    orthonormal = np.abs(rotation @ rotation.T - np.eye(3)).max() <= tolerance
    return bool(orthonormal and np.linalg.det(rotation) > 0 and np.abs(t[3] - [0, 0, 0, 1]).max() <= tolerance)


def nearest_rotation(matrix: ArrayLike) -> FloatArray:
    """Rotations (..., 3, 3) nearest to matrices (..., 3, 3) in the Frobenius norm (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    sign = np.sign(np.linalg.det(u @ vt))
    vt = vt.copy()
    vt[..., 2, :] *= np.asarray(sign)[..., None]
    return np.asarray(u @ vt)


def point_columns(points_mm: ArrayLike) -> FloatArray:
    """(..., 3, 6) motion of points (..., 3) per left twist (mm, rad) of the frame that they are given in: [I, -hat(p)]."""
    points = np.asarray(points_mm, dtype=np.float64)
    return np.concatenate([np.broadcast_to(np.eye(3), (*points.shape, 3)), -hat(points)], axis=-1)


def fit_rigid(source_mm: ArrayLike, target_mm: ArrayLike) -> FloatArray:
    """The `target_from_source` (4, 4) that maps points (n, 3) onto points (n, 3) best in least squares."""
    source, target = np.asarray(source_mm, dtype=np.float64), np.asarray(target_mm, dtype=np.float64)
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    rotation = nearest_rotation((target - target_mean).T @ (source - source_mean))
    return from_rotation_translation(rotation, target_mean - rotation @ source_mean)


def _series(angle: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """sin(t)/t, (1-cos t)/t², (t-sin t)/t³ with their Taylor series near zero."""
    small = angle < _SMALL_ANGLE_RAD
    t = np.where(small, 1.0, angle)
    t2 = angle * angle
    a = np.where(small, 1 - t2 / 6, np.sin(t) / t)
    b = np.where(small, 0.5 - t2 / 24, 2 * np.sin(t / 2) ** 2 / t**2)
    c = np.where(small, 1 / 6 - t2 / 120, (t - np.sin(t)) / t**3)
    return a, b, c


def _left_jacobian_so3(phi: FloatArray) -> FloatArray:
    _, b, c = _series(np.linalg.norm(phi, axis=-1))
    k = hat(phi)
    return np.asarray(np.eye(3) + b[..., None, None] * k + c[..., None, None] * (k @ k))
