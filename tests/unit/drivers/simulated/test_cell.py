"""Robot and camera of one simulated cell: clock, motions, refusals, what is reported and what is true, determinism."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import CameraNotReached, CameraTimeout, MotionRefused, RobotNotReached, SettingsError
from drivers.kinematics import mdh, se3
from drivers.models import load_robot_model
from drivers.protocols import Camera3D, Frame3D, Robot
from drivers.registry import DriverContext, make_devices
from drivers.simulated import make_camera, make_robot
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.cell import Motion, SimulatedCell
from drivers.simulated.draws import TABLE_1_ERRORS, paper_truth, random_truth
from drivers.simulated.robot import SimulatedRobot
from drivers.simulated.truth import RobotTruth, Truth
from drivers.simulated.truth_file import write_truth
from tests.support.simulated import CENTRE_IN_CAMERA_MM, JOINTS_RAD, cell_at, exact_camera, paper_model, truth_with_sphere


def opened(cell: SimulatedCell) -> SimulatedRobot:
    robot = SimulatedRobot(cell)
    robot.open()
    return robot


def moved_to(robot: SimulatedRobot, joints_rad: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> None:
    robot.start_move(joints_rad, speed_rad_s=0.5)
    while robot.read_state().moving:
        robot.wait(0.05)


def test_devices_satisfy_the_protocols() -> None:
    cell = SimulatedCell(Truth(), paper_model())
    assert isinstance(SimulatedRobot(cell), Robot)
    assert isinstance(SimulatedCamera(cell), Camera3D)


def test_a_motion_takes_its_time_on_the_cells_clock_and_no_other() -> None:
    cell = SimulatedCell(Truth(), paper_model())
    robot = opened(cell)
    robot.start_move(np.full(6, 0.5), speed_rad_s=0.25)
    duration = 0.5 / 0.25 + 0.25 / 3.0  # distance / speed + speed / acceleration
    robot.wait(duration - 0.01)
    assert robot.read_state().moving
    robot.wait(0.01)
    state = robot.read_state()
    assert not state.moving
    assert state.joints_rad is not None
    np.testing.assert_array_equal(state.joints_rad, np.full(6, 0.5))
    assert state.time_s == pytest.approx(duration, abs=0.01)


def test_polling_alone_lets_a_motion_end() -> None:
    robot = opened(SimulatedCell(Truth(), paper_model()))
    robot.start_move(np.full(6, 0.01), speed_rad_s=1.0)
    readings = 0
    while robot.read_state().moving:
        readings += 1
    assert 0 < readings < 1000


@given(
    distance=st.floats(1e-6, 6.0),
    speed=st.floats(1e-3, 3.0),
    times=st.lists(st.floats(0.0, 1.0), min_size=2, max_size=20),
)
@settings(deadline=None)
def test_motion_law_keeps_speed_and_acceleration(distance: float, speed: float, times: list[float]) -> None:
    motion = Motion.between(np.zeros(2), np.array([distance, -distance / 2]), start_s=1.0, speed_rad_s=speed, acceleration_rad_s2=3.0)
    at = 1.0 + np.sort(times) * motion.duration_s
    way = np.array([motion.joints_rad(t) for t in at])
    steps = np.diff(way[:, 0])
    assert (steps >= -1e-12).all()
    assert (steps <= speed * np.diff(at) + 1e-9).all()
    np.testing.assert_allclose(way[:, 1], -way[:, 0] / 2, atol=1e-12)
    np.testing.assert_allclose(motion.joints_rad(1.0 + motion.duration_s * (1 - 1e-12))[0], distance, rtol=1e-6)
    assert abs(motion.joints_rad(1.0)[0]) < 1e-12
    half = motion.joints_rad(1.0 + motion.duration_s / 2)[0]
    assert half == pytest.approx(distance / 2, rel=1e-9)


def test_stop_leaves_the_robot_midway() -> None:
    robot = opened(SimulatedCell(Truth(), paper_model()))
    robot.start_move(np.full(6, 0.8), speed_rad_s=0.2)
    robot.wait(2.0)
    robot.stop()
    stopped = robot.read_state()
    robot.wait(10.0)
    later = robot.read_state()
    assert stopped.joints_rad is not None
    assert later.joints_rad is not None
    assert not stopped.moving
    assert 0.3 < stopped.joints_rad[0] < 0.5
    np.testing.assert_array_equal(later.joints_rad, stopped.joints_rad)


@pytest.mark.parametrize(
    ("target", "found"),
    [
        (np.full(6, np.nan), "not finite"),
        (np.full(6, np.inf), "not finite"),
        (np.zeros(5), "shape"),
        (np.array([0, 0, 0, 0, 0, 50.0]), "axis 6 at 50"),
    ],
)
def test_impossible_targets_are_refused_and_nothing_moves(target: np.ndarray[tuple[int, ...], np.dtype[np.float64]], found: str) -> None:
    robot = opened(SimulatedCell(Truth(), paper_model()))
    with pytest.raises(MotionRefused, match=found):
        robot.start_move(target, speed_rad_s=0.3)
    assert not robot.read_state().moving


def test_the_parallelograms_limit_is_refused() -> None:
    model = load_robot_model("abb_irb1410")
    limit = model.linear_limits[0]
    target = limit.row * (limit.upper_rad + 0.05) / (limit.row @ limit.row)
    assert (np.abs(target) < np.abs(model.joint_limits_rad[:, 1])).all()
    with pytest.raises(MotionRefused, match="linear limit"):
        opened(SimulatedCell(Truth(), model)).start_move(target, speed_rad_s=0.3)


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_a_speed_that_is_none_is_refused(speed: float) -> None:
    with pytest.raises(MotionRefused, match="speed"):
        opened(SimulatedCell(Truth(), paper_model())).start_move(np.zeros(6), speed_rad_s=speed)


def test_a_second_motion_waits_for_the_first() -> None:
    robot = opened(SimulatedCell(Truth(), paper_model()))
    robot.start_move(np.full(6, 0.5), speed_rad_s=0.3)
    with pytest.raises(MotionRefused, match="under way"):
        robot.start_move(np.zeros(6), speed_rad_s=0.3)


def test_the_controller_reports_the_nominal_model_and_knows_no_errors() -> None:
    model = paper_model()
    cell = SimulatedCell(Truth(robot=replace(TABLE_1_ERRORS, pose_noise_mm=0.01)), model)
    robot = opened(cell)
    moved_to(robot, JOINTS_RAD)
    state = robot.read_state()
    assert state.joints_rad is not None
    assert state.base_from_flange is not None
    np.testing.assert_array_equal(state.joints_rad, JOINTS_RAD)
    np.testing.assert_allclose(state.base_from_flange, mdh.base_from_flange(model, JOINTS_RAD), atol=1e-12)
    assert np.linalg.norm((cell.true_base_from_flange() - state.base_from_flange)[:3, 3]) > 0.1


def test_encoder_noise_is_fresh_with_every_reading() -> None:
    robot = opened(SimulatedCell(Truth(robot=RobotTruth(encoder_noise_rad=1e-6)), paper_model()))
    readings = np.array([robot.read_state().joints_rad for _ in range(500)])
    assert readings.std() == pytest.approx(1e-6, rel=4 / np.sqrt(2 * readings.size))


def test_backlash_remembers_where_the_robot_came_from() -> None:
    play = 1e-4
    cell = SimulatedCell(Truth(robot=RobotTruth(backlash_rad=(play,) * 6)), paper_model())
    robot = opened(cell)
    flanges = []
    for start in (JOINTS_RAD - 0.1, JOINTS_RAD + 0.1):
        moved_to(robot, start)
        moved_to(robot, JOINTS_RAD)
        flanges.append(cell.true_base_from_flange())
    expected = [mdh.base_from_flange(cell.model, JOINTS_RAD - sign * play / 2) for sign in (1, -1)]
    np.testing.assert_allclose(flanges, expected, atol=1e-9)
    # an axis that does not move keeps its side
    moved_to(robot, JOINTS_RAD)
    np.testing.assert_allclose(cell.true_base_from_flange(), flanges[1], atol=1e-12)


def test_drift_goes_by_the_cells_clock() -> None:
    cell = SimulatedCell(Truth(robot=RobotTruth(drift_per_hour=(0.02, 0, 0, 0, 0, 0))), paper_model())
    before = cell.true_base_from_flange()[0, 3]
    opened(cell).wait(7200.0)
    assert cell.true_base_from_flange()[0, 3] - before == pytest.approx(0.04, abs=1e-9)


def test_repeated_visits_scatter_and_a_standing_robot_does_not() -> None:
    cell = SimulatedCell(Truth(robot=RobotTruth(pose_noise_mm=0.01)), paper_model())
    robot = opened(cell)
    visits = []
    for _ in range(3):
        moved_to(robot, JOINTS_RAD - 0.05)
        moved_to(robot, JOINTS_RAD)
        visits.append(cell.true_base_from_flange()[:3, 3])
        robot.wait(1.0)
        np.testing.assert_array_equal(cell.true_base_from_flange()[:3, 3], visits[-1])
    assert np.linalg.norm(visits[0] - visits[1]) > 1e-4
    assert np.linalg.norm(visits[1] - visits[2]) > 1e-4


def test_closed_devices_refuse() -> None:
    cell = SimulatedCell(Truth(), paper_model())
    robot, camera = SimulatedRobot(cell), SimulatedCamera(cell)
    with pytest.raises(RobotNotReached):
        robot.read_state()
    with pytest.raises(CameraNotReached):
        camera.capture(timeout_s=1.0)
    robot.open()
    robot.close()
    robot.close()
    camera.close()
    with pytest.raises(RobotNotReached):
        robot.start_move(np.zeros(6), speed_rad_s=0.1)


def captured(cell: SimulatedCell) -> Frame3D:
    camera = SimulatedCamera(cell)
    camera.open()
    return camera.capture(timeout_s=5.0)


def test_a_frame_shows_the_sphere_where_it_is() -> None:
    frame = captured(cell_at(truth_with_sphere()))
    assert frame.xyz_mm.dtype == np.float32
    assert frame.xyz_mm.shape == (100, 160, 3)
    seen = frame.xyz_mm[np.isfinite(frame.xyz_mm[..., 0])].astype(np.float64)
    assert len(seen) > 200
    assert np.abs(np.linalg.norm(seen - CENTRE_IN_CAMERA_MM, axis=1) - 19.05).max() < 1e-4
    invalid = ~np.isfinite(frame.xyz_mm)
    assert (invalid.all(axis=-1) == invalid.any(axis=-1)).all()


def test_frame_noise_has_its_sigma_on_the_sphere() -> None:
    truth = truth_with_sphere(camera=exact_camera(resolution_px=(640, 400), range_noise_mm=0.05))
    clean, noisy = captured(cell_at(truth_with_sphere(camera=exact_camera(resolution_px=(640, 400))))), captured(cell_at(truth))
    shift = np.linalg.norm(noisy.xyz_mm, axis=-1) - np.linalg.norm(clean.xyz_mm, axis=-1)
    shift = shift[np.isfinite(shift)]
    assert shift.std() == pytest.approx(0.05, rel=4 / np.sqrt(2 * len(shift)))


def test_points_outside_the_working_range_are_not_delivered() -> None:
    frame = captured(cell_at(truth_with_sphere(camera=exact_camera(working_range_mm=(200.0, 335.0)))))
    z = frame.xyz_mm[..., 2]
    assert np.nanmax(z) <= 335.0
    assert 0 < np.isfinite(z).sum() < np.isfinite(captured(cell_at(truth_with_sphere())).xyz_mm[..., 2]).sum()


def test_frames_count_up_and_take_time() -> None:
    cell = cell_at(truth_with_sphere())
    camera = SimulatedCamera(cell)
    camera.open()
    first, second = camera.capture(timeout_s=5.0), camera.capture(timeout_s=5.0)
    assert second.sequence == first.sequence + 1
    assert second.time_s - first.time_s == pytest.approx(0.2)
    with pytest.raises(CameraTimeout):
        camera.capture(timeout_s=0.1)


def story(truth: Truth, *, extra_readings: int = 0, run: int = 0) -> list[np.ndarray[tuple[int, ...], np.dtype[np.float32]]]:
    """Two frames from two poses."""
    cell = SimulatedCell(truth, paper_model(), run=run)
    robot, camera = opened(cell), SimulatedCamera(cell)
    camera.open()
    frames = []
    for joints in (JOINTS_RAD, JOINTS_RAD + 0.02):
        moved_to(robot, joints)
        for _ in range(extra_readings):
            robot.read_state()
        frames.append(camera.capture(timeout_s=5.0).xyz_mm)
    return frames


def noisy_truth(seed: int) -> Truth:
    exact = truth_with_sphere()
    return replace(paper_truth(paper_model(), seed=seed, spheres=exact.spheres, resolution_px=(160, 100)), seed=seed)


def without_drift(truth: Truth) -> Truth:
    return replace(truth, robot=replace(truth.robot, drift_per_hour=(0.0,) * 6))


def test_the_same_seed_gives_the_same_story_however_often_the_robot_is_read() -> None:
    truth = without_drift(noisy_truth(4))
    once, again = story(truth), story(truth, extra_readings=7)
    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(a, b)


def test_another_seed_or_run_gives_other_noise() -> None:
    reference = story(noisy_truth(4))[0]
    seed, run = story(replace(noisy_truth(4), seed=5))[0], story(noisy_truth(4), run=1)[0]
    for other in (seed, run):
        both = np.isfinite(reference[..., 2]) & np.isfinite(other[..., 2])
        assert both.sum() > 100
        assert (reference[both] != other[both]).any(axis=-1).mean() > 0.9


def test_random_truths_follow_their_generator() -> None:
    model = paper_model()
    assert random_truth(model, np.random.default_rng(1)) == random_truth(model, np.random.default_rng(1))
    assert random_truth(model, np.random.default_rng(1)) != random_truth(model, np.random.default_rng(2))
    for name in ("abb_irb1410", "ur5e"):
        other = load_robot_model(name)
        SimulatedCell(random_truth(other, np.random.default_rng(3)), other)


def test_the_paper_truth_starts_from_a_guess_2_mm_and_7_mrad_off() -> None:
    truth = paper_truth(paper_model(), seed=8)
    guess = np.array(exact_camera().flange_from_camera)
    twist = se3.log(se3.inverse(guess) @ np.array(truth.camera.flange_from_camera))
    assert np.linalg.norm(twist[3:]) == pytest.approx(7e-3, rel=1e-9)
    assert np.linalg.norm(twist[:3]) == pytest.approx(2.0, rel=1e-9)
    with pytest.raises(SettingsError, match="six axes"):
        paper_truth(replace(paper_model(), a_mm=np.zeros(5)))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_truth(truth_with_sphere(), tmp_path / "truth.yaml")
    return tmp_path


def test_robot_and_camera_of_a_cell_file_share_one_cell(folder: Path) -> None:
    devices = make_devices(
        robot_driver="simulated",
        robot_settings={"truth": "truth.yaml"},
        camera_driver="simulated",
        camera_settings={},
        robot_model=paper_model(),
        folder=folder,
    )
    with devices:
        devices.robot.start_move(JOINTS_RAD, speed_rad_s=0.5)
        devices.robot.wait(20.0)
        frame = devices.camera.capture(timeout_s=5.0)
    assert np.isfinite(frame.xyz_mm).any()
    assert frame.time_s >= 20.0


@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        ({}, "no truth"),
        ({"truth": "truth.yaml", "speed": 3}, "unknown setting 'speed'"),
        ({"truth": "truth.yaml", "instant": "yes"}, "'yes' is not allowed"),
        ({"truth": "truth.yaml", "run": True}, "True is not allowed"),
        ({"truth": "truth.yaml", "run": -1}, "-1 is not allowed"),
    ],
)
def test_wrong_settings_name_what_is_allowed(folder: Path, wrong: dict[str, object], found: str) -> None:
    with pytest.raises(SettingsError, match=found):
        make_robot(DriverContext(wrong, paper_model(), folder))


def test_a_missing_model_and_differing_settings_are_told(folder: Path) -> None:
    with pytest.raises(SettingsError, match="robot model"):
        make_robot(DriverContext({"truth": "truth.yaml"}, None, folder))
    shared: dict[str, object] = {}
    make_robot(DriverContext({"truth": "truth.yaml"}, paper_model(), folder, shared))
    with pytest.raises(SettingsError, match="differ"):
        make_camera(DriverContext({"truth": "other.yaml"}, paper_model(), folder, shared))


def test_real_time_is_the_computers() -> None:
    cell = SimulatedCell(Truth(), paper_model(), instant=False, clock_start_s=100.0)
    before = cell.clock_s
    cell.advance(0.02)
    assert 100.0 <= before < cell.clock_s
    assert cell.clock_s - before >= 0.02
