"""The child process with a stand-in for ur_rtde: which readings are fresh, which late, and that no socket can be opened."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass, field

import pytest

from drivers.ur import child
from drivers.ur.child import Failure, Robot, answer


@dataclass
class Receive:
    """Readings as they come: the controller's clock, and how late its data is."""

    period_s: float = 0.004
    late_s: float = 0.0
    frozen: bool = False
    connected: bool = True
    began_s: float = field(default_factory=time.monotonic)
    speed_rad_s: float = 0.0
    stood_still_at_s: float = 0.0

    def getTimestamp(self) -> float:
        if not self.frozen:
            self.stood_still_at_s = time.monotonic() - self.began_s - self.late_s
        return 100.0 + int(self.stood_still_at_s / self.period_s) * self.period_s

    def isConnected(self) -> bool:
        return self.connected

    def getActualQ(self) -> list[float]:
        return [0.1] * 6

    def getActualQd(self) -> list[float]:
        return [self.speed_rad_s] * 6

    def getActualTCPPose(self) -> list[float]:
        return [0.0] * 6

    def getSafetyMode(self) -> int:
        return 1

    def getRobotMode(self) -> int:
        return 7

    def getRuntimeState(self) -> int:
        return 2


@dataclass
class Operation:
    """State of an asynchronous motion."""

    number: int
    running: bool

    def operationId(self) -> int:
        return self.number

    def isAsyncOperationRunning(self) -> bool:
        return self.running


@dataclass
class Control:
    """Counts what it is told."""

    operation: Operation = field(default_factory=lambda: Operation(0, False))
    obeys: bool = True
    moves: int = 0
    stops: int = 0

    def isConnected(self) -> bool:
        return True

    def kickWatchdog(self) -> bool:
        return True

    def getAsyncOperationProgressEx(self) -> Operation:
        return self.operation

    def moveJ(self, q: list[float], speed: float, acceleration: float, asynchronous: bool) -> bool:
        assert asynchronous
        del q, speed, acceleration
        self.moves += 1
        if self.obeys:
            self.operation = Operation(self.operation.number + 1, True)
        return self.obeys

    def stopJ(self, deceleration: float) -> None:
        del deceleration
        self.stops += 1
        self.operation.running = False


def robot_with(receive: Receive, control: Control | None = None) -> Robot:
    robot = Robot("nowhere", 125.0, 0)
    robot._receive, robot._control = receive, control
    return robot


def test_readings_appear_while_they_are_waited_for() -> None:
    receive = Receive()
    robot = robot_with(receive)
    for _ in range(20):
        asked_s = time.monotonic()
        reading = robot.state()
        assert float(str(reading["at_s"])) >= asked_s - 0.002
        assert time.monotonic() - float(str(reading["at_s"])) < 0.05


def test_data_that_waited_in_a_buffer_is_late() -> None:
    receive = Receive()
    robot = robot_with(receive)
    for _ in range(10):
        robot.state()
    receive.late_s = 0.03
    assert time.monotonic() - float(str(robot.state()["at_s"])) >= 0.02
    receive.late_s = 0.2
    with pytest.raises(Failure) as caught:
        robot.state()
    assert caught.value.kind == "stale"
    receive.late_s = 0.0
    robot.state()


def test_a_clock_that_drifts_makes_no_reading_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """50 ppm for an hour between readings, as two quartzes may."""
    robot = robot_with(Receive())
    for i in range(10):
        robot._seen_s = 3600.0 * i
        assert robot._late_s(3600.0 * i * (1 - 5e-5)) < 1e-6
    robot._seen_s += 1.0
    assert robot._late_s(3600.0 * 9 * (1 - 5e-5) + 0.8) > 0.15
    del monkeypatch


def test_a_timestamp_that_stands_and_a_lost_link_are_told_apart() -> None:
    receive = Receive()
    robot = robot_with(receive)
    robot.state()
    receive.frozen = True
    began_s = time.monotonic()
    assert answer(robot, b'{"do": "state"}')["kind"] == "stale"
    assert 0.4 < time.monotonic() - began_s < 0.9
    receive.connected = False
    assert answer(robot, b'{"do": "state"}')["kind"] == "lost"
    assert answer(robot, b'{"do": "stop"}')["kind"] in ("lost", "no_control")


def test_one_motion_at_a_time_and_its_deadline() -> None:
    control = Control()
    robot = robot_with(Receive(), control)
    robot.move([0.0] * 6, 0.1, 1.0, 5.0)
    assert robot.state()["moving"] is True
    with pytest.raises(Failure) as caught:
        robot.move([0.0] * 6, 0.1, 1.0, 5.0)
    assert caught.value.kind == "busy"
    assert control.moves == 1
    assert robot.motion_ends_s is not None
    read, write = os.pipe()
    out_read, out_write = os.pipe()
    robot.motion_ends_s = time.monotonic() + 0.1
    os.write(write, b'{"do": "state"}\n')
    watcher = __import__("threading").Timer(0.4, os.close, args=(write,))
    watcher.start()
    child.serve(robot, read, out_write)
    watcher.join()
    assert control.stops == 1
    assert robot.motion_ends_s is None
    assert os.read(out_read, 4096).count(b"\n") == 1
    for descriptor in (read, out_read, out_write):
        os.close(descriptor)


def test_a_declined_motion_and_nonsense_are_replies_and_no_end() -> None:
    robot = robot_with(Receive(), Control(obeys=False))
    assert answer(robot, b'{"do": "move", "q": [0], "speed": 1, "acceleration": 1, "deadline_s": 1}')["kind"] == "refused"
    for line in (b"", b"{}", b"[]", b'{"do": "dance"}', b'{"do": "move"}', b"\xff\xfe"):
        assert answer(robot, line)["kind"] == "exception"


FROZEN = """
import os, socket, sys
from drivers.ur.child import connections_allowed, freeze_connections
open_before = socket.create_server(("127.0.0.1", 0))
client = socket.create_connection(open_before.getsockname())
server, _ = open_before.accept()
freeze_connections()
def can_open():
    try:
        socket.socket().close()
    except OSError:
        return False
    return True
assert not can_open()
client.close()
assert not can_open()  # a number that became free does not help
assert server.recv(1) == b""
with connections_allowed():
    assert can_open()
assert not can_open()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the limit on descriptors is Linux's")
def test_a_frozen_process_opens_no_socket_and_keeps_those_it_has() -> None:
    done = subprocess.run([sys.executable, "-c", FROZEN], capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 0, done.stderr
