"""Corrected robots: forward kinematics of the exported text, by readers of others, against the calibration's own."""

from __future__ import annotations

import csv
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calibrate import Calibration
from calibrate.export import ROBOT_FORMATS, TARGET_FORMATS, export_text
from calibrate.export_residual import corners
from drivers.errors import SettingsError
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model, shipped_models
from tests.support.exporting import YieldingCalibration, assert_same_poses, calibration_of, seen_poses, shipped_calibration
from tests.support.foreign_readers import Urdf, from_xyz_rpy_m, load_plain_yaml, mdh_pose_mm, transform_mm
from tests.support.synthetic import paper_robot

UR_ROBOTS = ("ur5e", "ur10e")


def named(joints: FloatArray) -> dict[str, float]:
    return {f"joint_{i + 1}": float(q) for i, q in enumerate(joints)}


@pytest.mark.parametrize("name", shipped_models())
def test_urdf_is_the_corrected_robot(name: str) -> None:
    """The parallelogram robot too, and far outside what the calibration saw."""
    calibration = shipped_calibration(name)
    urdf = Urdf(export_text(calibration, "urdf").text)
    far = np.random.default_rng(1).uniform(-3, 3, (10, 6))
    for joints in [*seen_poses(calibration, 10), *far]:
        flange = calibration.base_from_flange(joints)
        assert_same_poses(urdf.pose_mm("flange", named(joints)), flange)
        assert_same_poses(urdf.pose_mm("camera", named(joints)), flange @ calibration.flange_from_camera)
        assert_same_poses(np.eye(4), urdf.pose_mm("base", {}))


def test_every_row_of_a_coupling_is_mimicked() -> None:
    """Gear ratios, signs and several axes in one row."""
    rng = np.random.default_rng(4)
    model = replace(load_robot_model("irb1410_paper"), coupling=rng.normal(size=(6, 6)) + 2 * np.eye(6), linear_limits=())
    calibration = calibration_of(model)
    urdf = Urdf(export_text(calibration, "urdf").text)
    for joints in rng.uniform(-1, 1, (5, 6)):
        assert_same_poses(urdf.pose_mm("flange", named(joints)), calibration.base_from_flange(joints))


def test_urdf_tells_what_it_cannot_hold() -> None:
    text = export_text(shipped_calibration("abb_irb1410"), "urdf").text
    assert "coupled axes: joint_3" in text
    assert "URDF cannot hold this limit on several axes together" in text
    assert "TO BE FILLED" in text
    uncoupled = export_text(shipped_calibration("ur5e"), "urdf").text
    assert "mimic" not in uncoupled


def test_urdf_limits_are_those_of_the_model() -> None:
    model = load_robot_model("abb_irb1410")
    root = ET.fromstring(export_text(calibration_of(model), "urdf").text)
    limits = {joint.attrib["name"]: limit.attrib for joint in root.findall("joint") for limit in joint.findall("limit")}
    for i, (lower, upper) in enumerate(model.joint_limits_rad):
        assert float(limits[f"joint_{i + 1}"]["lower"]) == pytest.approx(lower, abs=1e-12)
        assert float(limits[f"joint_{i + 1}"]["upper"]) == pytest.approx(upper, abs=1e-12)
    unlimited = ET.fromstring(export_text(calibration_of(paper_robot()), "urdf").text)
    assert {joint.attrib["type"] for joint in unlimited.findall("joint")} == {"continuous", "fixed"}


@pytest.mark.parametrize("name", shipped_models())
@pytest.mark.parametrize("kind", [Calibration, YieldingCalibration])
@pytest.mark.parametrize("file_format", ["mdh", "mdh-full"])
def test_an_mdh_table_is_as_near_as_it_says(name: str, kind: type[Calibration], file_format: str) -> None:
    model = load_robot_model(name)
    calibration = calibration_of(model, kind=kind)
    exported = export_text(calibration, file_format)
    joints = seen_poses(calibration, 60)
    table = np.stack([mdh_pose_mm(exported.text, q, model.coupling) for q in joints])
    assert_as_near_as_said(calibration, table, joints, exported.text)
    residual = exported.residual
    assert residual is not None
    if file_format == "mdh-full" and kind is Calibration:
        assert residual.arm_max_mm < 1e-6
        assert_same_poses(table, calibration.base_from_flange(joints))
    if file_format == "mdh":
        nominal = np.stack([mdh_pose_mm(nominal_mdh(calibration), q, model.coupling) for q in joints])
        off = np.linalg.norm(corners(nominal) - corners(calibration.base_from_flange(joints)), axis=-1)
        assert residual.arm_rms_mm < 0.6 * np.sqrt((off**2).mean())


def assert_as_near_as_said(calibration: Calibration, flange: FloatArray, joints: FloatArray, text: str) -> None:
    off = np.linalg.norm(corners(flange) - corners(calibration.base_from_flange(joints)), axis=-1)
    found = re.search(r"flange origin rms (\S+) mm, max (\S+) mm; 400 mm from it rms (\S+) mm, max (\S+) mm", text)
    assert found
    origin_rms, origin_max, arm_rms, arm_max = map(float, found.groups())
    # of other poses than those it was said of
    assert off[:, 0].max() <= 1.1 * origin_max + 1e-9
    assert off[:, 1:].max() <= 1.1 * arm_max + 1e-9
    assert np.sqrt((off[:, 0] ** 2).mean()) == pytest.approx(origin_rms, rel=0.4, abs=1e-9)
    assert np.sqrt((off[:, 1:] ** 2).mean()) == pytest.approx(arm_rms, rel=0.4, abs=1e-9)


def nominal_mdh(calibration: Calibration) -> str:
    """The table of the nominal robot, by hand."""
    model = calibration.model
    assert model is not None
    rows = [f"{i + 1},{model.alpha_rad[i]},{model.a_mm[i]},0,{model.theta_offset_rad[i]},{model.d_mm[i]}" for i in range(model.n_joints)]
    return "\n".join(["row,alpha_rad,a_mm,beta_rad,theta_offset_rad,d_mm", *rows])


def test_parallel_axes_keep_their_d() -> None:
    """Without beta, d of nearly parallel axes runs away by hundreds of mm."""
    calibration = shipped_calibration("ur5e")
    for file_format in ("mdh", "mdh-full"):
        text = export_text(calibration, file_format).text
        rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
        rows = [row for row in rows if row["row"].isdigit()]
        assert [row["row"] for row in rows if float(row["beta_rad"])] == ["3", "4"]
        assert calibration.model is not None
        assert np.abs([float(row["d_mm"]) for row in rows] - calibration.model.d_mm).max() < 10


def ur_flange_mm(data: Any, joints: FloatArray) -> FloatArray:
    pose = np.eye(4)
    for link, q in zip(("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"), joints, strict=True):
        pose = pose @ read_link(data["kinematics"][link]) @ transform_mm(from_z(q), [0, 0, 0])
    return pose


def from_z(angle: float) -> Any:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec([0, 0, angle])


def read_link(link: Any) -> FloatArray:
    return from_xyz_rpy_m([link[c] for c in "xyz"], [link[c] for c in ("roll", "pitch", "yaw")])


@pytest.mark.parametrize("name", UR_ROBOTS)
def test_ur_kinematics_are_the_corrected_robot(name: str) -> None:
    calibration = shipped_calibration(name)
    data: Any = load_plain_yaml(export_text(calibration, "ur-kinematics").text)
    assert isinstance(data["kinematics"]["hash"], str)
    behind = read_link(data["spherecal"]["tool0_from_flange"])
    camera = read_link(data["spherecal"]["tool0_from_camera"])
    for joints in seen_poses(calibration, 10):
        tool0, flange = ur_flange_mm(data, joints), calibration.base_from_flange(joints)
        assert_same_poses(tool0 @ behind, flange)
        assert_same_poses(tool0 @ camera, flange @ calibration.flange_from_camera)


@pytest.mark.parametrize("name", UR_ROBOTS)
def test_ur_dh_changes_are_as_near_as_they_say(name: str) -> None:
    calibration = shipped_calibration(name)
    model = calibration.model
    assert model is not None
    data: Any = load_plain_yaml(export_text(calibration, "ur-kinematics").text)["spherecal"]
    deltas = np.array([data[f"delta_{parameter}"] for parameter in ("theta", "a", "d", "alpha")])
    assert np.abs(deltas[1:3]).max() < 0.01
    nominal = np.array([np.zeros(6), np.append(model.a_mm[1:], 0) / 1e3, model.d_mm / 1e3, np.append(model.alpha_rad[1:], 0)])
    theta, a, d, alpha = deltas + nominal
    joints = seen_poses(calibration, 60)
    flange = np.stack([standard_dh_mm(theta + q, a, d, alpha) for q in joints])
    assert_as_near_as_said(calibration, flange, joints, data["dh_residual"])


def standard_dh_mm(theta: FloatArray, a_m: FloatArray, d_m: FloatArray, alpha: FloatArray) -> FloatArray:
    pose = np.eye(4)
    for t, a, d, al in zip(theta, a_m * 1e3, d_m * 1e3, alpha, strict=True):
        ct, st, ca, sa = np.cos(t), np.sin(t), np.cos(al), np.sin(al)
        pose = pose @ np.array([[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]])
    return pose


@pytest.mark.parametrize("name", ["abb_irb1410", "irb1410_paper"])
def test_ur_kinematics_are_for_ur_robots(name: str) -> None:
    with pytest.raises(SettingsError, match="no Universal Robots arm"):
        export_text(shipped_calibration(name), "ur-kinematics")


@pytest.mark.parametrize("name", ["abb_irb1410", "ur5e"])
def test_a_robot_that_yields_is_exported_as_near_as_constant_transforms_can_be(name: str) -> None:
    """All numbers of every origin are free, so that URDF holds what the full table holds; the text says what remains."""
    model = load_robot_model(name)
    calibration = calibration_of(model, kind=YieldingCalibration)
    exported = export_text(calibration, "urdf")
    joints = seen_poses(calibration, 60)
    urdf = Urdf(exported.text)
    flange = np.stack([urdf.pose_mm("flange", named(q)) for q in joints])
    assert_as_near_as_said(calibration, flange, joints, exported.text)
    assert "not exact" in exported.text
    stiff = np.linalg.norm((calibration_of(model).base_from_flange(joints) - calibration.base_from_flange(joints))[:, :3, 3], axis=1)
    left = np.linalg.norm((flange - calibration.base_from_flange(joints))[:, :3, 3], axis=1)
    assert np.sqrt((left**2).mean()) < 0.2 * np.sqrt((stiff**2).mean())
    table = export_text(calibration, "mdh-full").residual
    assert exported.residual is not None
    assert table is not None
    assert exported.residual.arm_rms_mm <= 1.01 * table.arm_rms_mm


@pytest.mark.parametrize("file_format", ROBOT_FORMATS)
def test_every_format_says_unit_frame_and_calibration(file_format: str) -> None:
    calibration = shipped_calibration("ur5e")
    text = export_text(calibration, file_format).text
    assert all(word in text for word in (calibration.id, "unit: ", "frame: ", "base: datum nominal_robot", "verdict marginal"))
    assert text.isascii()


@pytest.mark.parametrize("file_format", [*ROBOT_FORMATS, *TARGET_FORMATS])
def test_a_pose_only_calibration_has_no_robot_to_export(file_format: str) -> None:
    with pytest.raises(SettingsError, match="pose-only") as caught:
        export_text(calibration_of(None), file_format, targets=() if file_format in TARGET_FORMATS else None)
    assert "hand-eye" in str(caught.value.remedy)


def test_formats_and_targets_must_fit() -> None:
    calibration = shipped_calibration("ur5e")
    with pytest.raises(SettingsError, match="no export format 'dxf'"):
        export_text(calibration, "dxf")
    with pytest.raises(SettingsError, match="needs targets"):
        export_text(calibration, "targets-csv")
    with pytest.raises(SettingsError, match="takes no targets"):
        export_text(calibration, "urdf", targets=())


def test_a_calibration_that_hides_its_axis_ranges_is_told() -> None:
    with pytest.raises(SettingsError, match="which axis angles it saw"):
        export_text(replace(shipped_calibration("ur5e"), seen_joints_rad=None), "mdh")
