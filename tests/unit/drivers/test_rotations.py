"""Rotations by every convention, against SciPy; laws that hold whatever the convention."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drivers.errors import DataError, SettingsError
from drivers.kinematics.rotations import BRANDS, CONVENTIONS, Convention, convention_named, conventions_of, fixed_xyz_rad, rotations_of

ANGLES = [c for c in CONVENTIONS if c.order]
THREE = st.lists(st.tuples(*[st.floats(-7, 7)] * 3), min_size=1, max_size=5)


def test_there_are_all_the_conventions() -> None:
    assert len(ANGLES) == len({c.name for c in ANGLES}) == 24
    assert [len(conventions_of(k)) for k in (3, 4, 9)] == [25, 2, 1]


@pytest.mark.parametrize("convention", ANGLES, ids=lambda c: c.name)
@settings(max_examples=15)
@given(THREE)
def test_angles_are_what_scipy_makes_of_them(convention: Convention, rows: list[tuple[float, float, float]]) -> None:
    """SciPy: small letters are fixed axes, capitals move."""
    sequence = convention.order if convention.kind == "fixed" else convention.order.upper()
    np.testing.assert_allclose(rotations_of(convention, rows), Rotation.from_euler(sequence, rows).as_matrix(), atol=1e-12)


@given(st.lists(st.tuples(*[st.floats(-1, 1)] * 4), min_size=1, max_size=5))
def test_quaternions_and_vectors_are_what_scipy_makes_of_them(rows: list[tuple[float, ...]]) -> None:
    numbers = np.array(rows)
    np.testing.assert_allclose(
        rotations_of(Convention("rotation-vector"), 3 * numbers[:, :3]), Rotation.from_rotvec(3 * numbers[:, :3]).as_matrix(), atol=1e-12
    )
    numbers = numbers[np.linalg.norm(numbers, axis=1) > 0.1]
    unit = numbers / np.linalg.norm(numbers, axis=1, keepdims=True)
    if len(unit):
        # a controller that rounds to three digits
        np.testing.assert_allclose(rotations_of(Convention("quaternion-xyzw"), 1.003 * unit), Rotation.from_quat(unit).as_matrix(), atol=1e-12)
        wxyz = rotations_of(Convention("quaternion-wxyz"), np.roll(unit, 1, axis=1))
        np.testing.assert_allclose(wxyz, Rotation.from_quat(unit).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(rotations_of(Convention("matrix"), wxyz.reshape(-1, 9)), wxyz, atol=1e-12)


@settings(max_examples=30)
@given(THREE)
def test_fixed_axes_are_moving_axes_backwards(rows: list[tuple[float, float, float]]) -> None:
    for convention in ANGLES:
        other = Convention("moving" if convention.kind == "fixed" else "fixed", convention.order[::-1])
        np.testing.assert_allclose(rotations_of(convention, rows), rotations_of(other, np.array(rows)[:, ::-1]), atol=1e-12)


@given(THREE, st.sampled_from([None, np.pi / 2, -np.pi / 2]))
def test_shown_angles_make_the_rotation_again(rows: list[tuple[float, float, float]], quarter: float | None) -> None:
    numbers = np.array(rows)
    if quarter is not None:
        numbers[:, 1] = quarter
    rotation = rotations_of(Convention("fixed", "xyz"), numbers)
    np.testing.assert_allclose(rotations_of(Convention("fixed", "xyz"), fixed_xyz_rad(rotation)), rotation, atol=1e-8)


@pytest.mark.parametrize(
    ("make", "n_numbers", "name"),
    [
        ("abb", 4, "quaternion-wxyz"),
        ("ABB", 3, "moving-zyx"),
        ("kuka", 3, "moving-zyx"),
        ("Fanuc", 3, "fixed-xyz"),
        ("yaskawa", 3, "fixed-xyz"),
        ("staubli", 3, "moving-xyz"),
        ("kawasaki", 3, "moving-zyz"),
        ("ur", 3, "rotation-vector"),
        ("quaternion_xyzw", 4, "quaternion-xyzw"),
    ],
)
def test_makes_and_names(make: str, n_numbers: int, name: str) -> None:
    assert convention_named(make, n_numbers).name == name


def test_every_name_leads_back_to_its_convention() -> None:
    assert [convention_named(c.name, c.n_numbers) for c in CONVENTIONS] == list(CONVENTIONS)
    assert all(convention_named(brand, 3).n_numbers == 3 for brand in BRANDS)


def test_what_is_no_rotation_or_no_convention_is_told() -> None:
    with pytest.raises(SettingsError, match="'xzz' is not known"):
        convention_named("xzz", 3)
    with pytest.raises(SettingsError, match="ur is written in 3 numbers, and the rotations here have 4"):
        convention_named("ur", 4)
    with pytest.raises(DataError, match=r"row 2 has length 0\.9"):
        rotations_of(Convention("quaternion-wxyz"), [[1.0, 0, 0, 0], [0.9, 0, 0, 0]])
    with pytest.raises(DataError, match="row 1 is no rotation"):
        rotations_of(Convention("matrix"), [[1, 0, 0, 0, 1, 0, 0, 0, -1]])
    with pytest.raises(DataError, match="row 1 has length nan"):
        rotations_of(Convention("quaternion-wxyz"), [[np.nan, 0, 0, 0]])
