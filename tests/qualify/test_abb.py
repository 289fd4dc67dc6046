"""The ABB line at length: 200 moves over TCP and over a pty, and thousands of orders of commands, faults and buttons."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import settings
from hypothesis.stateful import run_state_machine_as_test

from acquire.motion import MotionSettings, move, settle
from drivers.protocols import MAX_AGE_S
from tests.support.abb import controller, robot_over_pty, robot_over_tcp
from tests.unit.drivers.abb.test_stateful import AbbUnderFaults

pytestmark = pytest.mark.qualify
SEED = 20261122


@pytest.mark.parametrize("line", ["tcp", "pty"])
def test_two_hundred_moves_lose_nothing(line: str) -> None:
    rng = np.random.default_rng(SEED)
    settings_ = MotionSettings(speed_rad_s=0.8, settle_s=0.0, poll_s=0.02)
    with controller(speed_up=30) as made:
        robot = robot_over_tcp(made) if line == "tcp" else robot_over_pty(made)
        robot.open()
        for i in range(200):
            target_rad = np.radians(rng.uniform(-60, 60, 6) * [1, 0.5, 0.5, 1, 1, 2])
            ages_s = [state.age_s for state in move(robot, target_rad, settings_)]
            stillness = settle(robot, settings_)
            assert stillness.settled
            assert stillness.joints_rad is not None
            np.testing.assert_allclose(stillness.joints_rad, target_rad, atol=1e-6)
            assert max(ages_s) <= MAX_AGE_S
            assert made.n_motions() == i + 1
        robot.close()


def test_any_order_of_commands_faults_and_buttons() -> None:
    run_state_machine_as_test(AbbUnderFaults, settings=settings(max_examples=2000, stateful_step_count=60, deadline=None))
