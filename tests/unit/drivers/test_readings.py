"""Readings that must not be used, and targets that must not be sent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acquire.motion import MotionSettings, move, read_safely
from drivers.errors import EmergencyStop, MotionInterrupted, MotionRefused, ProtectiveStop, SafeguardStop, SafetyStop, StaleReading
from drivers.models import load_robot_model
from drivers.protocols import MAX_AGE_S, FloatArray, RobotState, Safety
from drivers.readings import check_age, check_safety, checked_target
from tests.support.fake_devices import FakeRobot

STATE = RobotState(np.zeros(6), np.eye(4), 0.0, moving=False)


@pytest.mark.parametrize(
    ("safety", "error"),
    [
        (Safety.PROTECTIVE_STOP, ProtectiveStop),
        (Safety.SAFEGUARD_STOP, SafeguardStop),
        (Safety.EMERGENCY_STOP, EmergencyStop),
        (Safety.FAULT, SafetyStop),
    ],
)
def test_every_stop_is_told_apart_with_the_controllers_word(safety: Safety, error: type[SafetyStop]) -> None:
    assert safety.stops_motion
    with pytest.raises(error, match="C153A0") as caught:
        check_safety(replace(STATE, safety=safety, reason="C153A0 collision"))
    assert type(caught.value) is error
    assert caught.value.remedy


@pytest.mark.parametrize("safety", [Safety.NORMAL, Safety.REDUCED, Safety.UNKNOWN])
def test_other_states_pass(safety: Safety) -> None:
    assert not safety.stops_motion
    check_safety(replace(STATE, safety=safety))


@pytest.mark.parametrize("age_s", [MAX_AGE_S * 1.01, 1.0, float("inf"), float("nan")])
def test_an_old_reading_is_none(age_s: float) -> None:
    check_age(replace(STATE, age_s=MAX_AGE_S))
    with pytest.raises(StaleReading):
        check_age(replace(STATE, age_s=age_s))

    class Old(FakeRobot):
        def read_state(self) -> RobotState:
            return replace(super().read_state(), age_s=age_s)

    with pytest.raises(StaleReading):
        read_safely(Old())


def test_an_interrupted_motion_says_what_the_controller_says() -> None:
    class Interrupted(FakeRobot):
        def read_state(self) -> RobotState:
            return replace(super().read_state(), reason="program stopped by the pendant")

    robot = Interrupted()
    robot.stops_short_rad = 0.1
    with pytest.raises(MotionInterrupted, match="program stopped by the pendant"):
        list(move(robot, np.array([0.4, 0.0]), MotionSettings()))


GOOD = np.zeros(6)


@pytest.mark.parametrize(
    ("target", "speed_rad_s"),
    [
        (GOOD[:5], 0.3),
        (np.zeros(7), 0.3),
        (np.zeros((1, 6)), 0.3),
        (np.array([0, 0, np.nan, 0, 0, 0]), 0.3),
        (np.array([0, 0, 0, 0, 0, 90.0]), 0.3),
        (GOOD, 0.0),
        (GOOD, -1.0),
        (GOOD, float("nan")),
        (GOOD, float("inf")),
    ],
)
def test_a_target_that_must_not_be_sent(target: FloatArray, speed_rad_s: float) -> None:
    model = load_robot_model("ur5e")
    with pytest.raises(MotionRefused) as caught:
        checked_target(model, target, speed_rad_s=speed_rad_s)
    assert caught.value.remedy
    np.testing.assert_array_equal(checked_target(model, GOOD, speed_rad_s=0.3), GOOD)
