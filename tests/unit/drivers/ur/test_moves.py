"""Many moves in a row lose nothing; the real clients, as anybody would use them, get on with the simulated controller."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from acquire.motion import MotionSettings, move, read_safely
from drivers.protocols import MAX_AGE_S
from tests.support.fake_ur import FakeUr, fake_ur, own_address
from tests.unit.drivers.ur.conftest import HOME, robot_at

SETTINGS = MotionSettings(speed_rad_s=2.0, poll_s=0.002)


@pytest.fixture(scope="module")
def fast() -> Iterator[FakeUr]:
    """A controller a hundred times as fast as a real one."""
    with fake_ur(own_address(7), speed_up=100) as running:
        yield running


@pytest.mark.parametrize("n", [12, pytest.param(200, marks=pytest.mark.qualify)])
def test_moves_in_a_row_lose_nothing(fast: FakeUr, n: int) -> None:
    """Every one is carried out once, arrives exactly, and every reading on the way is fresh."""
    rng = np.random.default_rng(8)
    before = fast.n_motions()
    ages: list[float] = []
    robot = robot_at(fast.host)
    robot.open()
    try:
        for _ in range(n):
            target = HOME + rng.uniform(-0.5, 0.5, 6)
            ages.extend(state.age_s for state in move(robot, target, SETTINGS))
            state = read_safely(robot)
            np.testing.assert_allclose(np.asarray(state.joints_rad), target, atol=1e-12)
    finally:
        robot.close()
    assert fast.n_motions() == before + n
    assert max(ages) <= MAX_AGE_S


REAL_CLIENTS = """
import sys, time
from rtde_receive import RTDEReceiveInterface
from rtde_control import RTDEControlInterface
from dashboard_client import DashboardClient
host = sys.argv[1]

def soon(good):
    # the reading client has a connection of its own, which may lag behind the commanding one
    until = time.monotonic() + 3
    while not good():
        assert time.monotonic() < until
        time.sleep(0.01)

receive = RTDEReceiveInterface(host)
dashboard = DashboardClient(host)
dashboard.connect()
assert dashboard.robotmode() == "Robotmode: RUNNING" and dashboard.isInRemoteControl() and not dashboard.running()
control = RTDEControlInterface(host)
assert control.isProgramRunning()
soon(dashboard.running)
home = receive.getActualQ()
away = [angle + 0.2 for angle in home]
assert control.moveJ(away, 1.0, 2.0)
soon(lambda: max(abs(a - b) for a, b in zip(receive.getActualQ(), away)) < 1e-9)
assert control.moveJ(home, 0.01, 2.0, True)
time.sleep(0.1)
control.stopJ(5.0)
assert not control.getAsyncOperationProgressEx().isAsyncOperationRunning()
soon(control.isSteady)
pose = control.getForwardKinematics(away, [0, 0, 1e-12, 0, 0, 0])
assert control.moveJ(away, 1.0, 2.0)
soon(lambda: max(abs(a - b) for a, b in zip(receive.getActualTCPPose(), pose)) < 1e-9)
assert control.setTcp([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]) and abs(control.getTCPOffset()[2] - 0.1) < 1e-12
assert control.setTcp([0.0] * 6) and control.setPayload(1.5, [0.0, 0.0, 0.05])
assert control.isJointsWithinSafetyLimits(home) and not control.isJointsWithinSafetyLimits([9.0] * 6)
assert control.teachMode() and control.getFreedriveStatus() == 1 and control.endTeachMode()
try:
    RTDEControlInterface(host)
except RuntimeError as error:
    assert "already in use" in str(error), error
else:
    raise AssertionError("two commanding clients")
control.stopScript()
dashboard.stop()
soon(lambda: not dashboard.running())
"""


def test_the_real_clients_accept_the_controller(fast: FakeUr) -> None:
    """In a process of their own: their constructors hold Python's global lock."""
    done = subprocess.run([sys.executable, "-c", REAL_CLIENTS, fast.host], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
