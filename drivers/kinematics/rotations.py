"""Rotations as controllers write them: three angles in any of 24 conventions, quaternions, rotation vectors, matrices.

Names of conventions: `fixed-xyz` are turns about axes that stand still, `moving-zyx` about axes that turn with the body;
the letters say the order of the turns, and the numbers come in the same order. `fixed-xyz` of (a, b, c) is
`moving-zyx` of (c, b, a).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from drivers.errors import DataError, SettingsError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

Kind = Literal["fixed", "moving", "quaternion-wxyz", "quaternion-xyzw", "rotation-vector", "matrix"]
_ORDERS = tuple("".join(letters) for letters in product("xyz", repeat=3) if letters[0] != letters[1] != letters[2])
_N_NUMBERS: Mapping[Kind, int] = {"fixed": 3, "moving": 3, "rotation-vector": 3, "quaternion-wxyz": 4, "quaternion-xyzw": 4, "matrix": 9}
_UNIT_NORM = 1e-2
_ORTHONORMAL = 1e-2


@dataclass(frozen=True, slots=True)
class Convention:
    """How numbers are a rotation."""

    kind: Kind
    order: str = ""
    """Of three angles: one of 12, as `zyx`."""

    @property
    def name(self) -> str:
        """As `convention_named` takes it."""
        return f"{self.kind}-{self.order}" if self.order else self.kind

    @property
    def n_numbers(self) -> int:
        """3, 4 or 9."""
        return _N_NUMBERS[self.kind]

    @property
    def has_angles(self) -> bool:
        """Whether its numbers have a unit, deg or rad."""
        return self.n_numbers == 3

    @property
    def places(self) -> tuple[int, int, int]:
        """Where the numbers of this order stand in columns that are named after the axes x, y, z."""
        if len(set(self.order)) < 3:
            return (0, 1, 2)
        first, second, third = ("xyz".index(letter) for letter in self.order)
        return (first, second, third)


CONVENTIONS: tuple[Convention, ...] = (
    *(Convention("fixed", order) for order in _ORDERS),
    *(Convention("moving", order) for order in _ORDERS),
    Convention("rotation-vector"),
    Convention("quaternion-wxyz"),
    Convention("quaternion-xyzw"),
    Convention("matrix"),
)

_BRANDS: Mapping[str, tuple[str, ...]] = {
    "abb": ("quaternion-wxyz", "moving-zyx"),
    "comau": ("moving-zyz",),
    "denso": ("fixed-xyz",),
    "doosan": ("moving-zyz",),
    "fanuc": ("fixed-xyz",),
    "kawasaki": ("moving-zyz",),
    "kuka": ("moving-zyx",),
    "mitsubishi": ("fixed-xyz",),
    "staubli": ("moving-xyz",),
    "ur": ("rotation-vector",),
    "yaskawa": ("fixed-xyz",),
}
"""What controllers write, after Basler's and Mech-Mind's tables of pose formats (docs/import.md)."""

BRANDS = tuple(_BRANDS)


def convention_named(name: str, n_numbers: int) -> Convention:
    """The convention of a name, or of a controller's make, for so many numbers.

    Raises:
        SettingsError: an unknown name, or one for another number of numbers.
    """
    wanted = name.strip().lower().replace("_", "-")
    by_name = {convention.name: convention for convention in CONVENTIONS}
    choices = [by_name[choice] for choice in _BRANDS.get(wanted, (wanted,)) if choice in by_name]
    if not choices:
        remedy = f"Choose {', '.join((*BRANDS, *(c.name for c in CONVENTIONS if not c.order)))}, or fixed- or moving- with an order, as fixed-xyz."
        raise SettingsError(f"the rotation convention {name!r} is not known", where="--rotation", remedy=remedy)
    fitting = [choice for choice in choices if choice.n_numbers == n_numbers]
    if not fitting:
        needs = " or ".join(str(choice.n_numbers) for choice in choices)
        message = f"{name} is written in {needs} numbers, and the rotations here have {n_numbers}"
        raise SettingsError(message, where="--rotation", remedy="Name the convention of these numbers, or the columns with --columns.")
    return fitting[0]


def conventions_of(n_numbers: int) -> tuple[Convention, ...]:
    """All that are written in so many numbers."""
    return tuple(convention for convention in CONVENTIONS if convention.n_numbers == n_numbers)


def rotations_of(convention: Convention, numbers: ArrayLike) -> FloatArray:
    """Rotations (m, 3, 3) of numbers (m, k) in the convention's own order, angles in rad.

    Raises:
        DataError: a quaternion or a matrix that is no rotation by far; the message names the row, from 1.
    """
    values = np.asarray(numbers, dtype=np.float64)
    if convention.kind == "rotation-vector":
        return se3.exp_so3(values)
    if convention.kind == "matrix":
        return _of_matrices(values.reshape(-1, 3, 3))
    if convention.n_numbers == 4:
        return _of_quaternions(values if convention.kind == "quaternion-wxyz" else np.roll(values, 1, axis=1))
    turns = [se3.exp_so3(values[:, i : i + 1] * np.eye(3)["xyz".index(letter)]) for i, letter in enumerate(convention.order)]
    return np.asarray(turns[0] @ turns[1] @ turns[2] if convention.kind == "moving" else turns[2] @ turns[1] @ turns[0])


def _of_quaternions(wxyz: FloatArray) -> FloatArray:
    norms = np.linalg.norm(wxyz, axis=1)
    if (bad := np.flatnonzero(~(np.abs(norms - 1) <= _UNIT_NORM))).size:
        raise DataError(f"the quaternion of row {bad[0] + 1} has length {norms[bad[0]]:.4g}, not 1", remedy="Check which columns hold it.")
    unit = wxyz / norms[:, None]
    w, k = unit[:, :1, None], se3.hat(unit[:, 1:])
    return np.asarray(np.eye(3) + 2 * w * k + 2 * k @ k)


def _of_matrices(matrices: FloatArray) -> FloatArray:
    off = np.abs(matrices @ np.swapaxes(matrices, -1, -2) - np.eye(3)).max(axis=(1, 2))
    if (bad := np.flatnonzero(~(off <= _ORTHONORMAL) | ~(np.linalg.det(matrices) > 0))).size:
        message = f"the matrix of row {bad[0] + 1} is no rotation"
        raise DataError(message, remedy="Give r11 r12 r13 r21 ... r33: columns are the flange's axes in the base.")
    return se3.nearest_rotation(matrices)


def fixed_xyz_rad(rotation: ArrayLike) -> FloatArray:
    """Angles (..., 3) about the fixed axes x, y, z of rotations (..., 3, 3), to be shown; the second lies within a quarter turn."""
    r = np.asarray(rotation, dtype=np.float64)
    about_y = np.arctan2(-r[..., 2, 0], np.hypot(r[..., 2, 1], r[..., 2, 2]))
    # where y stands at a quarter turn only the difference of the others is known: all of it is given to z
    level = np.hypot(r[..., 2, 1], r[..., 2, 2]) > 1e-9
    about_x = np.where(level, np.arctan2(r[..., 2, 1], r[..., 2, 2]), 0.0)
    about_z = np.where(level, np.arctan2(r[..., 1, 0], r[..., 0, 0]), np.arctan2(-r[..., 0, 1], r[..., 1, 1]))
    return np.stack([about_x, about_y, about_z], axis=-1)
