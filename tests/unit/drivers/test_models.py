"""Shipped robot models against foreign data and independent chains; the reader against broken files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import FileError
from drivers.files.yaml import dump_yaml, parse_yaml
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model, parse_robot_model, robot_model_data, robot_model_from_data, shipped_models
from tests.support.robotstudio import pairs

MISPRINTED_PAIR = 7

GOOD: dict[str, Any] = {
    "format": "spherecal-robot/1",
    "name": "two axes",
    "links": [{"a_mm": 0, "alpha_rad": 0, "d_mm": 300}, {"a_mm": 400, "alpha_rad": 1e-3, "d_mm": 0, "theta_offset_rad": 0.5}],
    "joint_limits_rad": [[-3, 3], [-2, 2]],
    "linear_limits_rad": [{"row": [1, -1], "min": -1, "max": 1}],
    "shape": [{"link": 1, "start_mm": [0, 0, 0], "end_mm": [0, 0, 100], "radius_mm": 50}],
}


def standard_dh(q: FloatArray, d: list[float], a: list[float], alpha: list[float]) -> FloatArray:
    """Denavit-Hartenberg as Universal Robots publishes it: RotZ TransZ TransX RotX."""
    result = np.eye(4)
    for i in range(6):
        c, s, ca, sa = np.cos(q[i]), np.sin(q[i]), np.cos(alpha[i]), np.sin(alpha[i])
        result = result @ np.array([[c, -s * ca, s * sa, a[i] * c], [s, c * ca, -c * sa, a[i] * s], [0, sa, ca, d[i]], [0, 0, 0, 1]])
    return result


def without_coupling(model: RobotModel) -> RobotModel:
    data = dict(robot_model_data(model))
    del data["coupling"]
    return robot_model_from_data(data, file="test")


def test_the_shipped_models_are_these() -> None:
    assert shipped_models() == ("abb_irb1410", "irb1410_paper", "ur10e", "ur5e")


@pytest.mark.parametrize("name", shipped_models())
def test_every_shipped_model_is_complete(name: str) -> None:
    model = load_robot_model(name)
    assert model.name == name
    assert model.source
    assert np.isfinite(model.joint_limits_rad).all()
    assert {capsule.link for capsule in model.shape} == set(range(7))
    assert parse_robot_model(model.text, file="copy").text == model.text


def test_irb1410_agrees_with_robotstudio() -> None:
    joints, position, quaternion = pairs()
    flange = mdh.base_from_flange(load_robot_model("abb_irb1410"), joints)
    error_mm = np.linalg.norm(flange[:, :3, 3] - position, axis=1)
    turn = np.abs((se3.quaternion_wxyz(flange[:, :3, :3]) * quaternion).sum(axis=1))
    others = np.arange(1, 21) != MISPRINTED_PAIR
    assert len(error_mm) == 20
    assert error_mm[others].max() < 0.11
    assert np.rad2deg(2 * np.arccos(np.minimum(turn[others], 1))).max() < 0.02
    assert error_mm[~others] > 4


def test_irb1410_agrees_with_the_misprinted_pair_once_it_is_corrected() -> None:
    joints, position, _ = pairs()
    corrected = joints[MISPRINTED_PAIR - 1].copy()
    corrected[0] = np.deg2rad(-133.735)
    flange = mdh.base_from_flange(load_robot_model("abb_irb1410"), corrected)
    assert np.linalg.norm(flange[:3, 3] - position[MISPRINTED_PAIR - 1]) < 0.11


def test_irb1410_needs_its_parallelogram() -> None:
    joints, position, _ = pairs()
    error_mm = np.linalg.norm(mdh.base_from_flange(without_coupling(load_robot_model("abb_irb1410")), joints)[:, :3, 3] - position, axis=1)
    assert np.median(error_mm) > 100


def test_robotstudio_poses_are_within_the_limits() -> None:
    joints, _, _ = pairs()
    assert mdh.within_limits(load_robot_model("abb_irb1410"), joints).all()


def test_the_papers_robot_is_the_real_one_in_another_convention() -> None:
    """METHOD.md, section 6; and the limits are moved by the same map."""
    paper, real = load_robot_model("irb1410_paper"), without_coupling(load_robot_model("abb_irb1410"))
    q = np.random.default_rng(0).uniform(real.joint_limits_rad[:, 0], real.joint_limits_rad[:, 1], (200, 6))
    sign, offset = np.array([1.0, -1, -1, 1, -1, 1]), np.array([0, 0, 0, 0, 0, np.pi])
    np.testing.assert_allclose(mdh.base_from_flange(paper, q * sign + offset), mdh.base_from_flange(real, q), atol=1e-9)
    moved = np.sort(real.joint_limits_rad * sign[:, None] + offset[:, None], axis=1)
    np.testing.assert_allclose(paper.joint_limits_rad, moved, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "d", "a"),
    [
        ("ur5e", [162.5, 0, 0, 133.3, 99.7, 99.6], [0, -425, -392.2, 0, 0, 0]),
        ("ur10e", [180.7, 0, 0, 174.15, 119.85, 116.55], [0, -612.7, -571.55, 0, 0, 0]),
    ],
)
def test_ur_models_equal_the_published_standard_dh(name: str, d: list[float], a: list[float]) -> None:
    model, alpha = load_robot_model(name), [np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0]
    for q in np.random.default_rng(1).uniform(-6, 6, (50, 6)):
        np.testing.assert_allclose(mdh.base_from_flange(model, q), standard_dh(q, d, a, alpha), atol=1e-9)


@pytest.mark.parametrize("name", shipped_models())
def test_plain_data_give_an_equal_model_back(name: str) -> None:
    model = load_robot_model(name)
    again = robot_model_from_data(parse_yaml(dump_yaml(robot_model_data(model)), file="copy"), file="copy")
    for field in ("a_mm", "alpha_rad", "d_mm", "theta_offset_rad", "coupling", "joint_limits_rad"):
        np.testing.assert_array_equal(getattr(again, field), getattr(model, field))
    assert (again.name, again.source, again.shape) == (model.name, model.source, model.shape)
    assert [(*limit.row, limit.lower_rad, limit.upper_rad) for limit in again.linear_limits] == [
        (*limit.row, limit.lower_rad, limit.upper_rad) for limit in model.linear_limits
    ]


def test_a_model_of_the_user_is_found_beside_the_cell_file(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(dump_yaml(GOOD), encoding="utf-8")
    assert load_robot_model("mine.yaml", relative_to=tmp_path).name == "two axes"
    assert load_robot_model(tmp_path / "mine.yaml").n_joints == 2


def test_an_unknown_name_is_told_with_the_choices(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"no robot model 'irb1410'.*abb_irb1410, irb1410_paper, ur10e, ur5e"):
        load_robot_model("irb1410", relative_to=tmp_path)


def changed(**changes: object) -> dict[str, Any]:
    return {key: value for key, value in {**GOOD, **changes}.items() if value != "gone"}


@pytest.mark.parametrize(
    ("data", "where", "found"),
    [
        (changed(links="gone"), "links", "missing"),
        (changed(format="spherecal-robot/2"), "format", "spherecal-robot/1"),
        (changed(axes=2), "axes (line", "unknown key.*Allowed: format"),
        (changed(links=[{"a_mm": 0, "alpha_rad": 90, "d_mm": 400}]), "links.0.alpha_rad", "degrees"),
        (changed(links=[{"a_mm": "0", "alpha_rad": 0, "d_mm": 400}]), "links.0.a_mm", "number"),
        (changed(links=[{"a_mm": 0, "alpha_rad": 0, "d_mm": float("nan")}]), "links.0.d_mm", "finite"),
        (changed(links=[{"a_mm": 0, "alpha_rad": True, "d_mm": 400}]), "links.0.alpha_rad", "number"),
        (changed(links=[{"a_mm": 0, "alpha_rad": 0, "d_mm": 0.4}, {"a_mm": 0.3, "alpha_rad": 0, "d_mm": 0}]), "", "metres"),
        (changed(coupling=[[1, 0]]), "", "coupling must be 2 rows of 2"),
        (changed(coupling=[[1, 1], [1, 1]]), "", "cannot be inverted"),
        (changed(joint_limits_rad=[[-170, 170], [-70, 70]]), "joint_limits_rad.0", "degrees"),
        (changed(joint_limits_rad=[[-1, 1]]), "", "1 pairs, the robot 2 axes"),
        (changed(joint_limits_rad=[[-1, 1], [2, 1]]), "joint_limits_rad.1", "2 is not below 1"),
        (changed(linear_limits_rad=[{"row": [1], "min": 0, "max": 1}]), "", r"linear_limits_rad\.0\.row has 1"),
        (changed(linear_limits_rad=[{"row": [1, 1], "min": 2, "max": 1}]), "linear_limits_rad.0", "not below"),
        (changed(shape=[{"link": 3, "start_mm": [0, 0, 0], "end_mm": [0, 0, 1], "radius_mm": 5}]), "", "last link is 2"),
        ([1, 2], "", "mapping"),
        (None, "", "mapping"),
    ],
)
def test_what_is_not_allowed_is_told_with_its_place(data: object, where: str, found: str) -> None:
    with pytest.raises(FileError, match=found) as caught:
        parse_robot_model(dump_yaml(data), file="robot.yaml")
    assert caught.value.file == "robot.yaml"
    assert where in (caught.value.where or "")
    assert caught.value.remedy


plain = st.recursive(
    st.none() | st.booleans() | st.integers(-1000, 1000) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@given(st.sampled_from(sorted({*GOOD, "coupling", "source", "other"})), plain)
def test_any_value_at_any_key_gives_a_model_or_a_file_error(key: str, value: object) -> None:
    try:
        model = robot_model_from_data({**GOOD, key: value}, file="robot.yaml")
    except FileError:
        return
    assert np.isfinite(mdh.base_from_flange(model, np.zeros(model.n_joints))).all()
