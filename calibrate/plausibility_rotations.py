"""Rotations that were made by the wrong convention: each as the function that makes the right one of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import Literal

import numpy as np

from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

Turn = Callable[[FloatArray], FloatArray]
"""Rotations (m, 3, 3) as recorded to rotations as meant."""

_Angles = Literal["xyz", "XYZ", "ZYZ", "ZXZ"]
_Numbers = Literal["xyz", "XYZ", "ZYZ", "ZXZ", "vector"]

_TOLD: dict[_Angles, str] = {
    "xyz": "about the fixed axes x, y, z",
    "XYZ": "about x, y, z of the moving body",
    "ZYZ": "about z, y, z of the moving body",
    "ZXZ": "about z, x, z of the moving body",
}
"""SciPy's names: small letters are fixed axes, capitals turn with the body."""
_ROLL_PITCH_YAW: tuple[_Angles, ...] = ("xyz", "XYZ")


def rotation_causes() -> Iterator[tuple[str, Turn, str]]:
    """Name, the function that undoes it, and the remedy of every convention that is often mistaken."""
    angles = "Convert the angles of the controller anew; its manual names their order and axes."
    for taken, meant in product(_TOLD, repeat=2):
        if taken != meant:
            yield f"the angles of the poses were taken {_TOLD[taken]}, but they are {_TOLD[meant]}", _reread(taken, meant), angles
    yield "the angles of the poses come in the order z, y, x", _reread("xyz", "xyz", backwards=True), angles
    yield f"the angles of the poses come in the order z, y, x and are {_TOLD['XYZ']}", _reread("xyz", "XYZ", backwards=True), angles
    yield "the angles of the poses were converted from degrees to rad twice", _degrees_again("xyz"), angles
    vector = "Convert the rotations anew: a rotation vector (Universal Robots) is no set of roll, pitch and yaw."
    for taken in _ROLL_PITCH_YAW:
        yield f"the rotation vectors of the poses were taken as angles {_TOLD[taken]}", _reread(taken, "vector"), vector
        yield f"the angles of the poses, {_TOLD[taken]}, were taken as rotation vectors", _reread("vector", taken), vector
    quaternion = "Convert the quaternions of the poses anew: w first (ABB) is not w last (ROS, SciPy)."
    yield "the quaternions of the poses were read with w last, but it is first", _requaternioned(1), quaternion
    yield "the quaternions of the poses were read with w first, but it is last", _requaternioned(-1), quaternion


def _reread(taken: _Numbers, meant: _Numbers, *, backwards: bool = False) -> Turn:
    def turn(rotation: FloatArray) -> FloatArray:
        numbers = _numbers(taken, rotation)
        return _rotation(meant, numbers[:, ::-1] if backwards else numbers)

    return turn


def _degrees_again(sequence: _Angles) -> Turn:
    return lambda rotation: _rotation(sequence, np.degrees(_numbers(sequence, rotation)))


def _requaternioned(by: int) -> Turn:
    """Rotations of the same four numbers, counted from another one on."""
    from scipy.spatial.transform import Rotation

    return lambda rotation: np.asarray(Rotation.from_quat(np.roll(Rotation.from_matrix(rotation).as_quat(), by, axis=1)).as_matrix())


def _numbers(convention: _Numbers, rotation: FloatArray) -> FloatArray:
    """The three numbers (m, 3) of rotations."""
    import warnings

    from scipy.spatial.transform import Rotation

    if convention == "vector":
        return se3.log_so3(rotation)
    with warnings.catch_warnings():
        # gimbal lock of a convention that is only tried
        warnings.simplefilter("ignore", UserWarning)
        return np.asarray(Rotation.from_matrix(rotation).as_euler(convention))


def _rotation(convention: _Numbers, numbers: FloatArray) -> FloatArray:
    from scipy.spatial.transform import Rotation

    return se3.exp_so3(numbers) if convention == "vector" else np.asarray(Rotation.from_euler(convention, numbers).as_matrix())
