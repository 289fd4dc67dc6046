"""What integrators rely on: points into the base, their covariance, and every misuse told in words."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import ArrayLike

from calibrate import Calibration
from calibrate.datum import nominal_robot_datum
from drivers.errors import SettingsError
from drivers.kinematics import mdh, se3
from drivers.kinematics.se3 import FloatArray

POINTS = np.array([[10.0, -20.0, 300.0], [-60.0, 40.0, 260.0], [80.0, 10.0, 390.0], [0.0, 0.0, 330.0]])
JOINTS = np.array([0.2, -0.5, 0.1, -0.3, -1.2, 2.0])
POSE = se3.from_rotation_translation(se3.exp_so3([2.9, 0.2, -0.3]), [850.0, 60.0, 640.0])


def by_hand(calibration: Calibration, points: FloatArray, joints_rad: FloatArray) -> FloatArray:
    """DESIGN.md's chain written out, one point at a time."""
    result = []
    for point, q in zip(points, joints_rad, strict=True):
        corrected = calibration.corrected_points_in_camera_mm(point[None])[0]
        frame = calibration.base_from_flange(q) @ calibration.flange_from_camera
        result.append((frame @ [*corrected, 1.0])[:3])
    return np.array(result)


def test_points_with_one_pose_or_a_pose_each_are_the_chain(calibration: Calibration) -> None:
    many = JOINTS + 0.1 * np.arange(24).reshape(4, 6)
    np.testing.assert_allclose(calibration.points_in_base_mm(POINTS, joints_rad=JOINTS), by_hand(calibration, POINTS, np.tile(JOINTS, (4, 1))))
    np.testing.assert_allclose(calibration.points_in_base_mm(POINTS, joints_rad=many), by_hand(calibration, POINTS, many))
    from_lists = calibration.points_in_base_mm(POINTS.tolist(), joints_rad=JOINTS.tolist())
    np.testing.assert_array_equal(from_lists, calibration.points_in_base_mm(POINTS, joints_rad=JOINTS))


def test_the_corrected_robot_is_the_datum_times_the_chain_with_its_twists(calibration: Calibration) -> None:
    assert calibration.model is not None
    assert calibration.base_from_flange(JOINTS).shape == (4, 4)
    many = np.tile(JOINTS, (2, 3, 1))
    assert calibration.base_from_flange(many).shape == (2, 3, 4, 4)
    expected = calibration.datum.base_from_solver @ mdh.base_from_flange(calibration.model, JOINTS, calibration.link_twists)
    # deflection terms, where there are any, move a flange by hundredths of a mm
    np.testing.assert_allclose(calibration.base_from_flange(JOINTS), expected, atol=0.3)
    assert se3.is_rigid(calibration.base_from_flange(JOINTS))


def test_rows_that_are_not_there_stay_so(calibration: Calibration) -> None:
    holes = POINTS.copy()
    holes[[0, 2]] = np.nan
    whole = calibration.points_in_base_mm(POINTS, joints_rad=JOINTS)
    found = calibration.points_in_base_mm(holes, joints_rad=JOINTS)
    assert np.isnan(found[[0, 2]]).all()
    np.testing.assert_array_equal(found[[1, 3]], whole[[1, 3]])
    covariance = calibration.point_covariance_in_base_mm2(holes, joints_rad=JOINTS)
    assert np.isnan(covariance[[0, 2]]).all()
    np.testing.assert_allclose(covariance[[1, 3]], calibration.point_covariance_in_base_mm2(POINTS, joints_rad=JOINTS)[[1, 3]], rtol=1e-9)


def test_no_points_are_no_points(calibration: Calibration, pose_only_calibration: Calibration) -> None:
    none = np.zeros((0, 3))
    assert calibration.points_in_base_mm(none, joints_rad=JOINTS).shape == (0, 3)
    assert calibration.points_in_base_mm(none, joints_rad=np.zeros((0, 6))).shape == (0, 3)
    assert calibration.point_covariance_in_base_mm2(none, joints_rad=JOINTS).shape == (0, 3, 3)
    assert pose_only_calibration.points_in_base_mm(none, base_from_flange=POSE).shape == (0, 3)


def test_flange_poses_carry_points_of_a_pose_only_calibration(pose_only_calibration: Calibration) -> None:
    c = pose_only_calibration
    corrected = c.corrected_points_in_camera_mm(POINTS)
    np.testing.assert_allclose(c.points_in_base_mm(POINTS, base_from_flange=POSE), se3.apply(POSE @ c.flange_from_camera, corrected))


def _misuse(**arguments: ArrayLike | None) -> Callable[[Calibration], object]:
    points = arguments.pop("points", POINTS)
    return lambda c: c.points_in_base_mm(np.asarray(points), **arguments)


BENT = POSE.copy()
BENT[0] *= 1.01
Misuses = dict[str, Callable[[Calibration], object]]
WHOLE_ROBOT_MISUSES: Misuses = {
    "neither": _misuse(),
    "both": _misuse(joints_rad=JOINTS, base_from_flange=POSE),
    "a pose": _misuse(base_from_flange=POSE),
    "five axes": _misuse(joints_rad=JOINTS[:5]),
    "three poses for four points": _misuse(joints_rad=np.tile(JOINTS, (3, 1))),
    "three dimensions": _misuse(joints_rad=np.tile(JOINTS, (1, 4, 1))),
    "no number": _misuse(joints_rad=JOINTS * np.nan),
    "flat points": _misuse(points=POINTS[0], joints_rad=JOINTS),
    "organised points": _misuse(points=POINTS.reshape(2, 2, 3), joints_rad=JOINTS),
    "five axes of the robot": lambda c: c.base_from_flange(JOINTS[:5]),
    "a robot nowhere": lambda c: c.base_from_flange(JOINTS * np.inf),
}
POSE_ONLY_MISUSES: Misuses = {
    "neither": _misuse(),
    "both": _misuse(joints_rad=JOINTS, base_from_flange=POSE),
    "axis angles": _misuse(joints_rad=JOINTS),
    "a bent pose": _misuse(base_from_flange=BENT),
    "a pose each": _misuse(base_from_flange=np.tile(POSE, (4, 1, 1))),
    "no number": _misuse(base_from_flange=POSE * np.nan),
    "a robot that it does not hold": lambda c: c.base_from_flange(JOINTS),
}


@pytest.mark.parametrize("misuse", WHOLE_ROBOT_MISUSES)
def test_misuse_of_a_robot_calibration_is_a_settings_error(misuse: str, calibration: Calibration) -> None:
    with pytest.raises(SettingsError) as told:
        WHOLE_ROBOT_MISUSES[misuse](calibration)
    assert told.value.remedy


@pytest.mark.parametrize("misuse", POSE_ONLY_MISUSES)
def test_misuse_of_a_pose_only_calibration_is_a_settings_error(misuse: str, pose_only_calibration: Calibration) -> None:
    with pytest.raises(SettingsError) as told:
        POSE_ONLY_MISUSES[misuse](pose_only_calibration)
    assert told.value.remedy


def with_links(c: Calibration, link_twists: FloatArray) -> Calibration:
    """The calibration with other link twists, in the base that the datum then states."""
    if c.model is None:
        raise LookupError("a pose-only calibration has no links")
    return replace(c, link_twists=link_twists, datum=nominal_robot_datum(c.model, link_twists, c.datum.references))


def moved(c: Calibration, parameter: int, step: float) -> Calibration:
    """The calibration with one of its parameters moved, as `parameter_names` numbers them."""
    n_links = c.link_twists.size
    if parameter < n_links:
        return with_links(c, c.link_twists + step * np.eye(n_links)[parameter].reshape(-1, 6))
    if parameter < n_links + 6:
        return replace(c, flange_from_camera=se3.exp(step * np.eye(6)[parameter - n_links]) @ c.flange_from_camera)
    return replace(c, camera_mm=c.camera_mm + step * np.eye(len(c.camera_mm))[parameter - n_links - 6])


@pytest.mark.parametrize(("kind", "share"), [("solved", 2e-2), ("straight", 1e-6), ("pose only", 1e-6)])
def test_point_jacobian_is_the_derivative_of_rebuilt_calibrations(
    kind: str, share: float, calibration: Calibration, pose_only_calibration: Calibration
) -> None:
    """To first order also in what the datum's fit leaves, some tenths of a mm on a metre: exact for a straight robot."""
    pose_only = kind == "pose only"
    c = pose_only_calibration if pose_only else with_links(calibration, np.zeros((6, 6))) if kind == "straight" else calibration
    many = JOINTS + 0.1 * np.arange(24).reshape(4, 6)

    def place(some: Calibration) -> FloatArray:
        return some.points_in_base_mm(POINTS, base_from_flange=POSE) if pose_only else some.points_in_base_mm(POINTS, joints_rad=many)

    jacobian = c.point_jacobian(POINTS, base_from_flange=POSE) if pose_only else c.point_jacobian(POINTS, joints_rad=many)
    n = c.link_twists.size + 6 + len(c.camera_mm)
    assert jacobian.shape[:2] == (4, 3)
    assert n <= jacobian.shape[2] <= len(c.parameter_names)
    for p, name in enumerate(c.parameter_names[:n]):
        h = 1e-5 if name.endswith("_rad") else 1e-2
        numeric = (place(moved(c, p, h)) - place(moved(c, p, -h))) / (2 * h)
        np.testing.assert_allclose(jacobian[:, :, p], numeric, atol=share * (1000.0 if name.endswith("_rad") else 1.0), err_msg=name)
        # the datum takes out what moves the whole base about and along axis 1
        gauge = kind == "straight" and name in {"link1.rho_z_mm", "link1.phi_z_rad"}
        assert (np.abs(jacobian[:, :, p]).max() < 1e-9) == gauge, name


def test_the_gauge_of_the_solver_moves_no_point(calibration: Calibration) -> None:
    """The base turned about and slid along axis 1, and, in one base, the last link exchanged against the hand-eye transform."""
    c = calibration
    screw, six = np.array([0, 0, 30.0, 0, 0, 0.2]), np.array([4.0, -3.0, 2.0, 0.05, -0.02, 0.1])
    xi = c.link_twists.copy()
    xi[0] = se3.log(se3.exp(screw) @ se3.exp(xi[0]))
    shifted = with_links(c, xi)
    assert np.abs(shifted.datum.base_from_solver - c.datum.base_from_solver).max() > 10
    reference = c.points_in_base_mm(POINTS, joints_rad=JOINTS)
    np.testing.assert_allclose(shifted.points_in_base_mm(POINTS, joints_rad=JOINTS), reference, atol=1e-8)
    xi = c.link_twists.copy()
    xi[-1] = se3.log(se3.exp(xi[-1]) @ se3.exp(six))
    exchanged = replace(c, link_twists=xi, flange_from_camera=se3.exp(-six) @ c.flange_from_camera)
    np.testing.assert_allclose(exchanged.points_in_base_mm(POINTS, joints_rad=JOINTS), reference, atol=1e-8)


@pytest.mark.parametrize("pose_only", [False, True])
def test_covariances_are_symmetric_and_positive(pose_only: bool, calibration: Calibration, pose_only_calibration: Calibration) -> None:
    c = pose_only_calibration if pose_only else calibration
    scale = np.sqrt(np.diagonal(c.covariance))
    assert (scale > 0).all()
    correlation = c.covariance / scale / scale[:, None]
    np.testing.assert_allclose(correlation, correlation.T, atol=1e-9)
    assert np.linalg.eigvalsh(correlation).min() > -1e-9
    points = (
        c.point_covariance_in_base_mm2(POINTS, base_from_flange=POSE) if pose_only else c.point_covariance_in_base_mm2(POINTS, joints_rad=JOINTS)
    )
    np.testing.assert_allclose(points, np.swapaxes(points, -1, -2), rtol=1e-9)
    assert (np.linalg.eigvalsh(points) > 0).all()
    # nobody knows a point better than its own noise
    assert (np.trace(points, axis1=1, axis2=2) > c.noise.point_mm**2).all()


def test_covariance_of_many_points_is_that_of_each(calibration: Calibration, monkeypatch: pytest.MonkeyPatch) -> None:
    many = JOINTS + 0.1 * np.arange(24).reshape(4, 6)
    whole = calibration.point_covariance_in_base_mm2(POINTS, joints_rad=many)
    for i in range(4):
        one = calibration.point_covariance_in_base_mm2(POINTS[i : i + 1], joints_rad=many[i])
        np.testing.assert_allclose(whole[i], one[0], rtol=1e-9)
    monkeypatch.setattr("calibrate.result._CHUNK", 3)
    np.testing.assert_allclose(calibration.point_covariance_in_base_mm2(POINTS, joints_rad=many), whole, rtol=1e-12)


def test_far_from_what_was_seen_less_is_known(calibration: Calibration) -> None:
    """Of lengths: single points share what is not known of the base itself."""
    references = calibration.datum.references.joints_rad
    moved_away = references + np.array([0.0, 0.5, -0.5, 1.0, 1.0, 1.0])
    near, far = (np.median([_sigma_of_length(calibration, a, b) for a, b in pairwise(poses)]) for poses in (references, moved_away))
    assert far > 1.4 * near
    assert near < 0.3


def _sigma_of_length(c: Calibration, q_a: FloatArray, q_b: FloatArray) -> float:
    both, poses = np.tile(POINTS[3], (2, 1)), np.array([q_a, q_b])
    place, jacobian = c.points_in_base_mm(both, joints_rad=poses), c.point_jacobian(both, joints_rad=poses)
    row = (place[1] - place[0]) / np.linalg.norm(place[1] - place[0]) @ (jacobian[1] - jacobian[0])
    return float(np.sqrt(row @ c.covariance[: len(row), : len(row)] @ row))


def test_spheres_stand_where_they_stood(calibration: Calibration) -> None:
    a, b = calibration.sphere_centres_in_base_mm["A"], calibration.sphere_centres_in_base_mm["B"]
    true = np.linalg.norm(np.subtract([900.0, 100.0, 300.0], [820.0, -250.0, 380.0]))
    assert np.linalg.norm(a - b) == pytest.approx(true, abs=0.01)
    assert set(calibration.sphere_radius_offsets_mm) == {"A", "B"}


def test_json_holds_the_keys_that_stay_and_no_infinity(calibration: Calibration, pose_only_calibration: Calibration) -> None:
    stay = {"method", "camera_error", "n_shots", "used", "rejected", "rank", "n_parameters", "train_rms_mm", "cross_validated_rms_mm", "verdict"}
    for c in (calibration, pose_only_calibration):
        data = json.loads(json.dumps(c.to_json_dict(), allow_nan=False))
        assert set(data) >= stay | {"reasons", "seconds"}
        assert data["n_shots"] == data["used"] + len(data["rejected"])
        assert isinstance(data["n_shots"], int)
    assert calibration.verdict == "pass", calibration.reasons
