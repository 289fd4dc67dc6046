"""Units, axes and holes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from drivers.cameras.frames import frame_problems, settings_digest
from drivers.cameras.points import NAMED_AXES, UNITS_MM, optical_points_mm, parse_axes, unit_interval
from drivers.errors import SettingsError
from tests.support.scan_scene import ScanScene

POINTS = hnp.arrays(np.float32, st.tuples(st.integers(1, 5), st.integers(1, 5), st.just(3)), elements=st.floats(width=32, allow_nan=True))


@given(POINTS, st.sampled_from(sorted(UNITS_MM)), st.sampled_from(sorted(NAMED_AXES)))
def test_a_hole_is_nan_in_all_three_and_the_source_is_left_alone(source: np.ndarray, unit: str, axes: str) -> None:
    before = source.copy()
    points = optical_points_mm(source, unit_mm=UNITS_MM[unit], axes=parse_axes(axes))
    assert np.array_equal(source, before, equal_nan=True)
    assert not np.shares_memory(points, source)
    assert points.dtype == np.float32
    assert points.flags.c_contiguous
    holes = ~np.isfinite(source).all(axis=-1) | ~source.any(axis=-1)
    assert np.isnan(points[holes]).all()
    assert not np.isnan(points[~holes]).any()


@given(st.permutations("xyz"), st.lists(st.sampled_from(["", "-", "+"]), min_size=3, max_size=3))
def test_axes_are_picked_and_signed_exactly(order: list[str], signs: list[str]) -> None:
    source = np.array([[1.25, -2.5, 3.75]])
    (point,) = optical_points_mm(source, unit_mm=1.0, axes=parse_axes([sign + axis for sign, axis in zip(signs, order, strict=True)]))
    expected = [(-1 if sign == "-" else 1) * source[0]["xyz".index(axis)] for sign, axis in zip(signs, order, strict=True)]
    assert point.tolist() == expected


@pytest.mark.parametrize("name", NAMED_AXES)
def test_named_axes_put_a_point_ahead_to_the_right_and_below(name: str) -> None:
    ahead_right_below = {"optical": (1, 2, 3), "graphics": (1, -2, -3), "unity": (1, -2, 3), "robot": (3, -1, -2)}[name]
    assert optical_points_mm([ahead_right_below], unit_mm=1.0, axes=parse_axes(name)).tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("axes", ["opticle", "", ["x", "y"], ["x", "y", "x"], ["x", "y", "2z"], ["x", "y", "z", "z"]])
def test_other_axes_are_refused(axes: str | list[str]) -> None:
    with pytest.raises(SettingsError, match="names no axes"):
        parse_axes(axes)


@pytest.mark.parametrize("unit", UNITS_MM)
def test_units_lose_no_more_than_float32_does(unit: str) -> None:
    true_mm = np.random.default_rng(1).uniform(-400, 400, (500, 3))
    for source in (true_mm / UNITS_MM[unit], (true_mm / UNITS_MM[unit]).astype(np.float32)):
        assert np.abs(optical_points_mm(source, unit_mm=UNITS_MM[unit]) - true_mm).max() < 6e-5


def test_brightness_is_between_0_and_1() -> None:
    assert unit_interval(np.array([[0, 255]], dtype=np.uint8)).tolist() == [[0, 1]]
    assert unit_interval(np.array([[0, 65535]], dtype=np.uint16)).tolist() == [[0, 1]]
    assert unit_interval(np.array([[0.25, 1.0]])).tolist() == [[0.25, 1]]
    assert unit_interval(np.full((2, 2, 4), 51, dtype=np.uint8)).tolist() == [[pytest.approx(0.2)] * 2] * 2


TURNS = {"as it is": (1, 1), "turned by 180 degrees": (-1, -1)}
MIRRORS = {"x": (-1, 1), "y": (1, -1)}


@pytest.mark.parametrize("turn", TURNS)
def test_a_camera_mounted_upside_down_is_no_mirror(turn: str) -> None:
    assert not frame_problems(ScanScene().expose() * np.array([*TURNS[turn], 1], dtype=np.float32))
    assert not frame_problems(ScanScene().expose()[::-1, ::-1])


@pytest.mark.parametrize("axis", MIRRORS)
def test_a_mirror_image_is_told(axis: str) -> None:
    (problem,) = frame_problems(ScanScene().expose() * np.array([*MIRRORS[axis], 1], dtype=np.float32))
    assert "mirror" in problem
    (problem,) = frame_problems(ScanScene().expose()[::-1])
    assert "mirror" in problem


def test_nothing_in_view_and_clouds_without_a_grid_are_no_fault() -> None:
    assert not frame_problems(np.full((4, 5, 3), np.nan, dtype=np.float32))
    assert not frame_problems(ScanScene().expose().reshape(1, -1, 3)[:, ::-1])


def test_a_digest_depends_on_values_and_not_on_order() -> None:
    assert settings_digest({"a": 1, "b": (2.0, None)}) == settings_digest({"b": [2.0, None], "a": 1})
    assert settings_digest({"a": 1}) != settings_digest({"a": 2})
