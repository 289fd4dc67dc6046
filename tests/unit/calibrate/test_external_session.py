"""Sessions with external points from disk to calibration.yaml: robot alone, with spheres, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate import Calibration
from calibrate.solve import CalibrationSettings, calibrate
from drivers.errors import DataError, FileError, SettingsError
from drivers.files.session import read_session
from drivers.kinematics import mdh, se3
from drivers.simulated.truth import RobotTruth
from tests.support.once import once_a_run
from tests.support.solving import draw_shots
from tests.support.synthetic import SyntheticShot, abb_robot, paper_cell, with_table_1_errors
from tests.support.synthetic_session import write_session
from tests.support.tracker import (
    LIMITS,
    TrackedRobot,
    add_tracker_lines,
    pose_errors_mm,
    tracked_robot,
    tracker_cell_data,
    unseen_rms_mm,
    write_tracker_session,
)

PLACES = {"A": (900.0, 100.0, 300.0), "B": (820.0, -250.0, 380.0)}


@pytest.fixture(scope="module")
def robot() -> TrackedRobot:
    return tracked_robot(31)


@pytest.fixture(scope="module")
def alone(robot: TrackedRobot, tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    folder = tmp_path_factory.mktemp("tracker") / "s"
    shots = robot.shots(np.random.default_rng(32), 40)
    shots[7] = replace(shots[7], point_in_reference_mm=shots[7].point_in_reference_mm + 4.0)
    return calibrate([read_session(write_tracker_session(folder, shots, tracker_cell_data("abb_irb1410")))])


def test_a_robot_is_calibrated_without_camera_or_sphere(robot: TrackedRobot, alone: Calibration) -> None:
    told = alone.to_json_dict()
    assert (told["method"], told["camera_error"], told["n_shots"], told["used"]) == ("clouds", "none", 40, 39)
    assert [(shot.index, shot.reason[:7]) for shot in alone.rejected] == [(7, "outlier")]
    assert (alone.statistics.rank, alone.statistics.n_parameters) == (18, 36)
    assert alone.verdict == "pass"
    assert alone.hand_eye == "none"
    after, before = unseen_rms_mm(alone, robot, np.random.default_rng(33))
    assert after < 0.1
    assert after < before / 5
    assert alone.statistics.train_rms_mm < alone.statistics.cross_validated_rms_mm < 0.12


def test_the_base_is_the_best_fit_to_the_nominal_robot(robot: TrackedRobot, alone: Calibration) -> None:
    """The datum: no motion of the base brings the calibrated robot nearer to the nominal one, flange shift apart."""
    assert alone.datum.kind == "nominal_robot"
    joints = alone.datum.references.joints_rad
    nominal = mdh.base_from_flange(robot.model, joints)
    moved = pose_errors_mm(alone.base_from_flange(joints), nominal)
    plain = np.linalg.norm(se3.apply(alone.base_from_flange(joints), [0, 0, 150.0]) - se3.apply(nominal, [0, 0, 150.0]), axis=1)
    assert np.sqrt((plain**2).mean()) < np.sqrt((moved**2).mean()) + 0.5


def test_frames_and_targets_are_told_with_their_covariance(robot: TrackedRobot, alone: Calibration) -> None:
    external = alone.external
    assert external is not None
    frame, target = external.references["tracker"], external.targets["reflector"]
    # the stated base is not the robot's own: what counts is the target as the tracker sees it from the calibrated arm
    shot = external.shots[0]
    seen = se3.apply(frame.base_from_reference, shot.point_in_reference_mm)
    assert np.linalg.norm(seen) > 100
    assert np.linalg.norm(shot.residual_mm) < 0.5
    for covariance in (frame.covariance, target.covariance_mm2):
        np.testing.assert_allclose(covariance, covariance.T, atol=1e-15)
        assert (np.linalg.eigvalsh(covariance) > -1e-15).all()
    assert 1e-3 < np.sqrt(np.trace(target.covariance_mm2)) < 3.0
    names = alone.parameter_names
    assert names[-9:] == (*(f"reference.tracker.{p}" for p in ("rho_x_mm", "rho_y_mm", "rho_z_mm", "phi_x_rad", "phi_y_rad", "phi_z_rad")),
                          *(f"target.reflector.{axis}_mm" for axis in "xyz"))  # fmt: skip
    assert len(names) == len(set(names)) == len(alone.covariance)


def test_the_file_holds_it_all(alone: Calibration, tmp_path: Path) -> None:
    alone.save(tmp_path / "c.yaml")
    loaded = Calibration.load(tmp_path / "c.yaml")
    assert loaded.id == alone.id
    assert loaded.hand_eye == "none"
    assert loaded.external is not None
    assert alone.external is not None
    assert loaded.external.to_json_dict() == alone.external.to_json_dict()
    assert loaded.noise == alone.noise
    np.testing.assert_array_equal(loaded.external.references["tracker"].covariance, alone.external.references["tracker"].covariance)
    q = np.array([0.2, -0.1, 0.3, 0.4, -0.5, 0.6])
    np.testing.assert_array_equal(loaded.base_from_flange(q), alone.base_from_flange(q))


def test_points_of_a_camera_that_nobody_calibrated_are_refused(alone: Calibration) -> None:
    with pytest.raises(SettingsError, match="robot alone"):
        alone.points_in_base_mm([[0.0, 0.0, 300.0]], joints_rad=np.zeros(6))


def test_a_hand_eye_of_the_cell_is_handed_on_as_good_as_unknown(robot: TrackedRobot, tmp_path: Path) -> None:
    hand_eye = se3.from_rotation_translation(np.eye(3), [10.0, 20.0, 80.0])
    cell = tracker_cell_data("abb_irb1410", flange_from_camera=hand_eye.tolist())
    calibration = calibrate([read_session(write_tracker_session(tmp_path / "s", robot.shots(np.random.default_rng(3), 25), cell))])
    assert calibration.hand_eye == "cell"
    np.testing.assert_allclose(calibration.flange_from_camera, hand_eye, atol=1e-12)
    sigma = np.sqrt(np.trace(calibration.point_covariance_in_base_mm2([[0.0, 0.0, 300.0]], joints_rad=np.zeros(6))[0]))
    assert sigma > 100


@pytest.mark.parametrize(
    ("change", "reason"),
    [("few", "too few"), ("one axis", "axes 2, 3, 4, 5, 6 moved less"), ("no limits", "no limits given"), ("tight", "missed by")],
)
def test_a_session_that_cannot_tell_says_why(robot: TrackedRobot, tmp_path: Path, change: str, reason: str) -> None:
    rng = np.random.default_rng(41)
    joints = robot.poses(rng, 9 if change == "few" else 30)
    if change == "one axis":
        joints[:, 1:] = joints[0, 1:]
    limits = None if change == "no limits" else LIMITS | ({"centre_rms_mm": 0.01} if change == "tight" else {})
    folder = write_tracker_session(tmp_path / "s", robot.shots(rng, 0, joints_rad=joints), tracker_cell_data("abb_irb1410", limits=limits))
    calibration = calibrate([read_session(folder)])
    assert calibration.verdict == ("marginal" if change == "no limits" else "fail")
    assert any(reason in told for told in calibration.reasons), calibration.reasons
    assert calibration.statistics.rank < 18 if change == "one axis" else calibration.statistics.rank >= 17


def test_a_failed_point_is_counted_and_a_skipped_one_is_not(robot: TrackedRobot, tmp_path: Path) -> None:
    folder = write_tracker_session(tmp_path / "s", robot.shots(np.random.default_rng(5), 25), tracker_cell_data("abb_irb1410"))
    lines = [json.loads(line) for line in (folder / "shots.jsonl").read_text().splitlines()]
    lines[3] |= {"status": "failed", "reason": "beam broken"}
    lines[4] |= {"status": "skipped"}
    (folder / "shots.jsonl").write_text("\n".join(json.dumps(line) for line in lines) + "\n")
    calibration = calibrate([read_session(folder)])
    assert (calibration.statistics.n_shots, calibration.statistics.used) == (24, 23)
    assert [(shot.index, shot.reason) for shot in calibration.rejected] == [(3, "marked failed: beam broken")]


def test_other_methods_say_that_they_take_no_external_points(robot: TrackedRobot, tmp_path: Path) -> None:
    folder = write_tracker_session(tmp_path / "s", robot.shots(np.random.default_rng(5), 25), tracker_cell_data("abb_irb1410"))
    with pytest.raises(SettingsError, match="external reference points alone"):
        calibrate([read_session(folder)], CalibrationSettings(method="centres"))


def test_a_cell_without_a_robot_model_is_told_to_name_one(robot: TrackedRobot, tmp_path: Path) -> None:
    folder = write_tracker_session(tmp_path / "s", robot.shots(np.random.default_rng(5), 25), tracker_cell_data("abb_irb1410"))
    (folder / "robot_model.yaml").unlink()
    (folder / "cell.yaml").write_text((folder / "cell.yaml").read_text().replace("abb_irb1410", "null"))
    with pytest.raises(FileError, match="no robot model"):
        calibrate([read_session(folder)])


def mixed_cell() -> tuple[TrackedRobot, dict[str, list[SyntheticShot]]]:
    """Two spheres and a tracker at the same true robot."""
    cell, rng = replace(paper_cell(), nominal=abb_robot(), true=with_table_1_errors(abb_robot())), np.random.default_rng(51)
    spheres = {name: draw_shots(replace(cell, centre_in_base_mm=np.array(place)), rng, 14, n_points=100) for name, place in PLACES.items()}
    nominal, true = cell.nominal, cell.true
    truth = RobotTruth(
        a_error_mm=tuple(true.a_mm - nominal.a_mm),
        alpha_error_rad=tuple(true.alpha_rad - nominal.alpha_rad),
        d_error_mm=tuple(true.d_mm - nominal.d_mm),
        theta_error_rad=tuple(true.theta_offset_rad - nominal.theta_offset_rad),
        pose_noise_mm=0.01,
        pose_noise_rad=1e-4,
    )
    return replace(tracked_robot(52), truth=truth), spheres


@pytest.fixture(scope="module")
def together(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Calibration, float]]:
    """The same robot by spheres, by a tracker, and by both, with the error of its unseen poses."""
    return once_a_run(tmp_path_factory, "together", calibrate_together)


def calibrate_together(folder: Path) -> dict[str, tuple[Calibration, float]]:
    """All four from sessions in a folder."""
    robot, spheres = mixed_cell()
    rng = np.random.default_rng(53)
    shots = robot.shots(rng, 24)
    cell = paper_cell(coupled=True)
    found = {
        "spheres": write_session(folder / "spheres", cell, spheres, flange_from_camera=None, extra_cell={"limits": LIMITS}),
        "tracker": write_tracker_session(folder / "tracker", shots, tracker_cell_data("abb_irb1410")),
        "both": add_tracker_lines(write_session(folder / "both", cell, spheres, flange_from_camera=None, extra_cell={"limits": LIMITS}), shots),
        "shuffled": add_tracker_lines(
            write_session(
                folder / "shuffled", cell, spheres, flange_from_camera=None, extra_cell={"limits": LIMITS}, order=rng.permutation(28).tolist()
            ),
            [shots[i] for i in rng.permutation(24)],
        ),
    }
    settings = CalibrationSettings(camera_error="pillow")
    calibrations = {name: calibrate([read_session(path)], settings) for name, path in found.items()}
    return {name: (c, unseen_rms_mm(c, robot, np.random.default_rng(54))[0]) for name, c in calibrations.items()}


def test_both_together_are_better_than_either(together: dict[str, tuple[Calibration, float]]) -> None:
    spheres, tracker, both = (together[name][1] for name in ("spheres", "tracker", "both"))
    assert both < 0.5 * spheres
    assert both < 1.02 * tracker
    assert both < 0.05


def test_the_order_of_both_kinds_of_shot_changes_nothing(together: dict[str, tuple[Calibration, float]]) -> None:
    first, second = together["both"][0], together["shuffled"][0]
    q = np.random.default_rng(55).uniform(-0.8, 0.8, (30, 6))
    assert np.abs(first.base_from_flange(q)[:, :3, 3] - second.base_from_flange(q)[:, :3, 3]).max() < 1e-6
    for name in "AB":
        np.testing.assert_allclose(first.sphere_centres_in_base_mm[name], second.sphere_centres_in_base_mm[name], atol=1e-6)


def test_spheres_keep_what_a_tracker_cannot_tell(together: dict[str, tuple[Calibration, float]]) -> None:
    both = together["both"][0]
    assert both.hand_eye == "calibrated"
    assert (both.statistics.n_shots, both.statistics.used) == (52, 52)
    assert both.statistics.rank == together["spheres"][0].statistics.rank == 27
    assert both.external is not None
    assert both.external.cross_validated_rms_mm is not None
    assert both.external.cross_validated_rms_mm < 0.12
    assert not any("certified length" in reason for reason in both.reasons)
    assert any("certified length" in reason for reason in together["spheres"][0].reasons)


def test_a_tracker_brings_the_length_between_spheres(together: dict[str, tuple[Calibration, float]]) -> None:
    true = float(np.linalg.norm(np.subtract(PLACES["A"], PLACES["B"])))
    errors = {}
    for name in ("spheres", "both"):
        calibration = together[name][0]
        a, b = (calibration.sphere_centres_in_base_mm[sphere] for sphere in "AB")
        errors[name] = abs(float(np.linalg.norm(a - b)) - true)
    assert errors["both"] < 0.05
    sigma = {}
    for name in errors:
        calibration = together[name][0]
        at = [calibration.parameter_names.index(f"sphere.{sphere}.x_mm") for sphere in "AB"]
        row = np.zeros(len(calibration.parameter_names))
        between = np.subtract(*(calibration.sphere_centres_in_base_mm[sphere] for sphere in "AB"))
        row[at[0] : at[0] + 3], row[at[1] : at[1] + 3] = between, -between
        sigma[name] = float(np.sqrt(row @ calibration.covariance @ row) / np.linalg.norm(between))
    assert sigma["both"] < 0.8 * sigma["spheres"]
    assert errors["both"] < 3 * sigma["both"]


def test_a_file_of_both_is_read_back(together: dict[str, tuple[Calibration, float]], tmp_path: Path) -> None:
    both = together["both"][0]
    both.save(tmp_path / "c.yaml")
    assert Calibration.load(tmp_path / "c.yaml").id == both.id


def test_an_external_file_of_nonsense_is_refused(together: dict[str, tuple[Calibration, float]], tmp_path: Path) -> None:
    from calibrate.result_file import calibration_data, content_id
    from drivers.files.yaml import dump_yaml

    data = calibration_data(together["both"][0])
    data["external"] = {"references": 3}
    (tmp_path / "c.yaml").write_text(dump_yaml({**data, "id": content_id(data)}))
    with pytest.raises(FileError, match="incomplete"):
        Calibration.load(tmp_path / "c.yaml")


def test_points_of_another_robot_are_no_calibration_of_this_one(tmp_path: Path) -> None:
    other = tracked_robot(61, model_name="ur10e")
    folder = write_tracker_session(tmp_path / "s", other.shots(np.random.default_rng(62), 25), tracker_cell_data("ur5e"))
    with pytest.raises(DataError, match="no frame brings"):
        calibrate([read_session(folder)])
