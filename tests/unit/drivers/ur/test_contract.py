"""The UR adapter keeps the contract, with the real ur_rtde client against a controller in a process of its own."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import numpy as np
import pytest

from drivers.contract.robot import RobotContract, RobotRig
from drivers.simulated.controllers.holes import BlackHole
from tests.support.fake_ur import FakeUr, own_address
from tests.unit.drivers.ur.conftest import AWAY, HOME, MODEL, robot_at


@pytest.fixture(scope="module")
def black_hole() -> Iterator[str]:
    with BlackHole(own_address(1), 30004) as hole:
        yield hole.host


class TestUrRobot(RobotContract):
    @pytest.fixture
    def rig(self, controller: FakeUr, black_hole: str) -> RobotRig:
        names = ("silence", "drop", "stale", "protective_stop", "emergency_stop")
        return RobotRig(
            make=lambda: robot_at(controller.host),
            targets_rad=np.array([HOME, AWAY]),
            speed_rad_s=1.2,
            model=MODEL,
            nobody={"refuses": lambda: robot_at(own_address(2)), "black_hole": lambda: robot_at(black_hole)},
            faults={name: lambda name=name: controller.fault(name) for name in names},  # type: ignore[misc]
            clear=controller.clear,
            n_motions=controller.n_motions,
        )


def test_the_black_hole_swallows(black_hole: str) -> None:
    with pytest.raises(TimeoutError):
        socket.create_connection((black_hole, 30004), 0.2)
