"""One simulated controller for the UR tests of a module, and a robot at it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from drivers.models import load_robot_model
from drivers.simulated.truth import RobotTruth, Truth
from drivers.simulated.truth_file import write_truth
from drivers.ur_rtde import UrRobot, UrSettings
from tests.support.fake_ur import FakeUr, fake_ur, own_address

MODEL = load_robot_model("ur5e")
HOME = np.array([0.0, -1.57, 1.2, -1.2, -1.57, 0.0])
AWAY = HOME + 0.3


@pytest.fixture(scope="package")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakeUr]:
    """A nimble arm in real time, at a controller with a calibration of its own."""
    truth = tmp_path_factory.mktemp("ur") / "truth.yaml"
    write_truth(Truth(robot=RobotTruth(home_rad=tuple(HOME.tolist()), acceleration_rad_s2=20.0)), truth)
    with fake_ur(own_address(0), "--truth", str(truth), "--factory-calibration", "1") as controller:
        yield controller


@pytest.fixture
def controller(running: FakeUr) -> Iterator[FakeUr]:
    """The controller, mended before and after."""
    running.clear()
    yield running
    running.clear()


def robot_at(host: str, **settings: bool) -> UrRobot:
    """A robot at an address."""
    return UrRobot(UrSettings(host, **settings), MODEL)


@pytest.fixture
def robot(controller: FakeUr) -> Iterator[UrRobot]:
    """An open robot."""
    robot = robot_at(controller.host)
    robot.open()
    yield robot
    robot.close()
