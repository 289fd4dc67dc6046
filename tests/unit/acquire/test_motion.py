"""Motion, stillness and the way through a plan."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.motion import MotionSettings, change_rad, halt, move, settle
from acquire.plan import PlannedPose
from acquire.way import Way
from drivers.errors import RobotTimeout
from drivers.kinematics import se3
from drivers.protocols import RobotState
from tests.support.fake_devices import FakeRobot

SETTINGS = MotionSettings(speed_rad_s=0.5, settle_s=0.3)


def test_the_last_reading_of_a_move_is_at_its_target() -> None:
    robot = FakeRobot()
    states = list(move(robot, np.array([0.4, -0.2]), SETTINGS))
    assert states[-1].joints_rad is not None
    np.testing.assert_allclose(states[-1].joints_rad, [0.4, -0.2])
    assert not states[-1].moving
    assert all(state.moving for state in states[:-1])
    assert robot.clock_s == pytest.approx(0.8, abs=0.11)


def test_a_controller_that_is_late_to_say_that_it_moves_is_waited_for() -> None:
    class Late(FakeRobot):
        def read_state(self) -> RobotState:
            state = super().read_state()
            idle = self.clock_s - self.start_s < 0.3
            return RobotState(np.zeros(2) if idle else state.joints_rad, None, state.time_s, moving=state.moving and not idle)

    states = list(move(Late(), np.array([0.4, 0.0]), SETTINGS))
    assert states[-1].joints_rad is not None
    np.testing.assert_allclose(states[-1].joints_rad, [0.4, 0.0])


@given(st.floats(0.01, 3.0), st.floats(0.05, 2.0))
def test_a_stuck_robot_is_given_up_after_a_time_that_fits_the_distance(distance_rad: float, speed_rad_s: float) -> None:
    robot = FakeRobot()
    robot.stuck = True
    with pytest.raises(RobotTimeout):
        list(move(robot, np.array([distance_rad, 0.0]), MotionSettings(speed_rad_s=speed_rad_s)))
    assert distance_rad / speed_rad_s < robot.clock_s < 4 * distance_rad / speed_rad_s + 6
    assert not robot.moving


def test_halt_waits_until_the_robot_stands_and_says_so_if_it_does_not() -> None:
    robot = FakeRobot()
    robot.start_move(np.array([1.0, 0.0]), speed_rad_s=0.5)
    halt(robot, SETTINGS)
    assert not robot.moving
    runaway = FakeRobot()
    runaway.stop = lambda: None  # type: ignore[method-assign]
    runaway.start_move(np.array([1e3, 0.0]), speed_rad_s=0.5)
    with pytest.raises(RobotTimeout, match="emergency"):
        halt(runaway, SETTINGS)


def test_settling_waits_for_a_swing_to_die_down() -> None:
    robot = FakeRobot()

    def swing(self: FakeRobot) -> None:
        self.tremble_rad = 1e-3 * np.exp(-self.clock_s)

    robot.on_read = swing
    stillness = settle(robot, SETTINGS)
    assert stillness.settled
    assert 0 < stillness.stillness_rad <= SETTINGS.still_tolerance_rad
    assert stillness.seconds > 1
    assert stillness.joints_rad is not None
    np.testing.assert_allclose(stillness.joints_rad, 0, atol=1e-4)


def test_settling_gives_up() -> None:
    robot = FakeRobot()
    robot.tremble_rad = 1e-3
    stillness = settle(robot, SETTINGS)
    assert not stillness.settled
    assert stillness.stillness_rad == pytest.approx(2e-3)
    assert stillness.seconds == pytest.approx(SETTINGS.settle_timeout_s, abs=0.5)


@pytest.mark.parametrize("settle_s", [0.0, 0.5])
def test_at_least_three_readings_even_without_a_settling_time(settle_s: float) -> None:
    robot = FakeRobot()
    assert settle(robot, MotionSettings(settle_s=settle_s)).settled
    assert robot.n_reads >= 3


def test_without_axis_angles_the_flange_pose_tells() -> None:
    pose = se3.exp([0.0, 0.5, 0.0, 0.0, 0.0, 2e-4])
    first, second = (RobotState(None, flange, 0.0, moving=False) for flange in (np.eye(4), pose))
    assert change_rad(first, first) == 0
    assert change_rad(second, first) == pytest.approx(5e-4, rel=0.01)


POSES = [PlannedPose(f"p{i}", None, np.array([2.0 * i + 1]), (np.array([2.0 * i]),)) for i in range(5)]


@given(st.lists(st.tuples(st.integers(0, 4), st.booleans()), max_size=12), st.sampled_from([None, 0.0, 3.0, 9.0, 77.0]))
def test_the_way_never_leaves_the_planned_path(visits: list[tuple[int, bool]], start: float | None) -> None:
    way = Way(POSES)
    way.locate(None if start is None else np.array([start]), 1e-3)
    at: float | None = start if start is not None and start <= 9 else None
    for number, broken_off in visits:
        target = None
        for target in way.to(POSES[number]):
            # neighbours on the way, or its beginning where the robot stood nobody knows where
            assert abs(float(target[0]) - at) <= 1 if at is not None else float(target[0]) == 0
            if broken_off:
                at = None if at is None else (at + float(target[0])) / 2
                break
            at = float(target[0])
        if not broken_off:
            assert target is not None
            assert float(target[0]) == POSES[number].joints_rad[0]


def test_a_plan_without_via_points_goes_straight() -> None:
    way = Way([PlannedPose(f"p{i}", None, np.array([1.0 * i])) for i in range(5)])
    assert [float(target[0]) for target in way.to(PlannedPose("p3", None, np.array([3.0])))] == [3.0]
