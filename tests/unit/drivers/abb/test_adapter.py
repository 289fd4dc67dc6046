"""The adapter against the simulated IRC5 over real sockets and a real pty: faults, stops, frames, and nothing frozen."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from drivers.abb.settings import parse_settings
from drivers.errors import (
    LinkLost,
    MotionInterrupted,
    MotionRefused,
    MotorsOff,
    RobotError,
    RobotNotReached,
    RobotTimeout,
    SettingsError,
    StaleReading,
    WrongController,
)
from drivers.protocols import CONNECT_S, SILENCE_S, Mode, Robot, Safety
from drivers.simulated.controllers.abb import AbbController
from tests.support.abb import SPEED_RAD_S, TARGETS_DEG, controller, robot_over_pty, robot_over_tcp

TARGETS_RAD = np.radians(TARGETS_DEG)
SLACK_S = 0.7


@pytest.fixture
def made() -> Iterator[AbbController]:
    with controller() as started:
        yield started


@contextmanager
def in_time(seconds: float) -> Iterator[None]:
    """The block ends in time, and another thread runs on meanwhile."""
    ticks, ends = [0], threading.Event()

    def tick() -> None:
        while not ends.wait(0.01):
            ticks[0] += 1

    thread = threading.Thread(target=tick)
    thread.start()
    began_s = time.monotonic()
    try:
        yield
    finally:
        took_s = time.monotonic() - began_s
        ends.set()
        thread.join()
    assert took_s <= seconds + SLACK_S
    assert ticks[0] >= took_s / 0.01 * 0.2 - 2


def moving(robot: Robot, place: int = 1, speed_rad_s: float = 0.2) -> None:
    """Start towards a target and see it move."""
    robot.start_move(TARGETS_RAD[place], speed_rad_s=speed_rad_s)
    end_s = time.monotonic() + 2
    while not robot.read_state().moving:
        assert time.monotonic() < end_s


def arrive(robot: Robot, place: int) -> None:
    robot.start_move(TARGETS_RAD[place], speed_rad_s=SPEED_RAD_S)
    end_s = time.monotonic() + 5
    while robot.read_state().moving:
        assert time.monotonic() < end_s
        robot.wait(0.03)
    joints = robot.read_state().joints_rad
    assert joints is not None
    np.testing.assert_allclose(joints, TARGETS_RAD[place], atol=1e-6)


def test_the_same_over_a_pty(made: AbbController) -> None:
    robot = robot_over_pty(made)
    info = robot.open()
    assert info.model == "IRB 1410-5/1.44"
    arrive(robot, 1)
    moving(robot, 0)
    robot.stop()
    assert not robot.read_state().moving
    robot.close()


def test_two_programs_cannot_have_one_serial_port(made: AbbController) -> None:
    first, second = robot_over_pty(made), robot_over_pty(made)
    first.open()
    with in_time(CONNECT_S), pytest.raises(RobotNotReached):
        second.open()
    first.close()


WIRE = {
    "refuse": LinkLost,
    "black_hole": RobotTimeout,
    "half_lines": RobotTimeout,
    "wrong_checksum": WrongController,
    "stale": StaleReading,
}


@pytest.mark.parametrize("name", WIRE)
def test_a_fault_of_the_line_is_told_in_time_and_the_robot_stands_afterwards(name: str, made: AbbController) -> None:
    robot = robot_over_tcp(made, state=False, watchdog_s=1.0)
    robot.open()
    moving(robot, speed_rad_s=0.1)
    count = made.n_motions()
    made.fault(name)
    with in_time(SILENCE_S), pytest.raises(WIRE[name]):
        robot.read_state()
    with in_time(SILENCE_S):
        try:
            robot.stop()
        except RobotError:
            assert name in WIRE
    robot.close()
    made.clear()
    with in_time(CONNECT_S):
        robot.open()
    state = robot.read_state()
    assert not state.moving
    assert made.n_motions() == count
    robot.close()


@pytest.mark.parametrize("name", ["lost_replies", "wrong_checksum"])
def test_a_few_spoilt_replies_are_survived(name: str, made: AbbController) -> None:
    robot = robot_over_tcp(made)
    robot.open()
    made.fault(name, "1")
    robot.start_move(TARGETS_RAD[1], speed_rad_s=SPEED_RAD_S)
    assert made.n_motions() == 1
    robot.close()


@pytest.mark.parametrize("name", ["two_halves", "doubled_replies", "slow"])
def test_odd_but_right_replies_are_no_fault(name: str, made: AbbController) -> None:
    made.fault(name)
    robot = robot_over_tcp(made)
    robot.open()
    arrive(robot, 1)
    robot.close()


def test_a_link_that_drops_in_mid_move_stops_the_robot(made: AbbController) -> None:
    robot = robot_over_tcp(made, state=False)
    robot.open()
    made.fault("drop_mid_move")
    robot.start_move(TARGETS_RAD[1], speed_rad_s=0.1)
    time.sleep(0.3)
    with pytest.raises(LinkLost):
        robot.read_state()
    robot.stop()  # over a link of its own, which is not kept
    with pytest.raises(LinkLost):
        robot.read_state()
    made.clear()
    robot.open()
    assert not robot.read_state().moving
    robot.close()


def test_a_silent_computer_is_a_dead_man(made: AbbController) -> None:
    robot = robot_over_tcp(made, watchdog_s=1.0)
    robot.open()
    moving(robot, speed_rad_s=0.05)
    time.sleep(1.4)
    state = robot.read_state()
    assert not state.moving
    assert state.reason == "the motion was given up because the computer said nothing"
    robot.close()


@pytest.mark.parametrize(("button", "safety"), [("emergency_stop", Safety.EMERGENCY_STOP), ("guard_stop", Safety.SAFEGUARD_STOP)])
def test_stops_are_told_by_the_second_program(button: str, safety: Safety, made: AbbController) -> None:
    robot = robot_over_tcp(made)
    robot.open()
    moving(robot)
    made.fault(button)
    with in_time(SILENCE_S):
        state = robot.read_state()
    assert (state.safety, state.moving) == (safety, False)
    assert state.motors_on is False
    robot.close()


def test_without_a_second_program_a_stop_is_silence_and_the_motion_never_goes_on(made: AbbController) -> None:
    robot = robot_over_tcp(made, state=False)
    robot.open()
    moving(robot)
    made.fault("emergency_stop")
    with in_time(SILENCE_S), pytest.raises(RobotTimeout) as caught:
        robot.read_state()
    assert "emergency stop" in str(caught.value).lower()
    stood = made.program.cell.joints_rad()
    made.fault("start_button")
    time.sleep(0.4)
    np.testing.assert_array_equal(made.program.cell.joints_rad(), stood)
    robot.open()
    assert not robot.read_state().moving
    robot.close()


def test_motors_off_are_told_apart_from_a_stop(made: AbbController) -> None:
    robot = robot_over_tcp(made)
    robot.open()
    with made._lock:
        made.program.hold("N", motors_on=False)
    state = robot.read_state()
    assert (state.safety, state.motors_on, state.moving) == (Safety.NORMAL, False, False)
    with pytest.raises(MotorsOff):
        robot.start_move(TARGETS_RAD[1], speed_rad_s=0.5)
    robot.close()


def test_a_program_that_is_started_anew_ends_the_link_and_nothing_moves(made: AbbController) -> None:
    robot = robot_over_tcp(made, state=False)
    robot.open()
    moving(robot)
    made.fault("restart")
    with pytest.raises((LinkLost, MotionInterrupted)):
        robot.read_state()
    robot.open()
    assert not robot.read_state().moving
    arrive(robot, 0)
    robot.close()


def test_tool_and_work_object_must_be_the_bare_ones_or_named(made: AbbController) -> None:
    made.program.use(tool="gripper", work_object="table")
    with pytest.raises(RobotError, match="gripper"):
        robot_over_tcp(made, state=False).open()
    with pytest.raises(RobotError, match="table"):
        robot_over_tcp(made, state=False, tool="Gripper").open()
    robot = robot_over_tcp(made, state=False, tool="gripper", work_object="table")
    robot.open()
    state = robot.read_state()
    assert (state.active_tool, state.active_work_object) == ("tool0", "wobj0")  # what its poses refer to
    robot.close()


def test_the_mode_is_told(made: AbbController) -> None:
    made.fault("manual")
    robot = robot_over_tcp(made)
    robot.open()
    assert robot.read_state().mode == Mode.MANUAL
    robot.close()


def test_a_speed_that_the_program_would_refuse_is_not_sent(made: AbbController) -> None:
    robot = robot_over_tcp(made)
    robot.open()
    with pytest.raises(MotionRefused, match=r"1\.05 rad/s"):
        robot.start_move(TARGETS_RAD[1], speed_rad_s=1.1)
    assert made.n_motions() == 0
    robot.close()


def test_another_program_at_the_port_is_told() -> None:
    """An echo, as of a terminal server: HELLO comes back as it went."""
    listening = socket.create_server(("127.0.0.1", 0))

    def echo() -> None:
        connection, _ = listening.accept()
        with connection:
            while data := connection.recv(4096):
                connection.sendall(data)

    thread = threading.Thread(target=echo)
    thread.start()
    from drivers.abb.adapter import AbbRobot

    robot = AbbRobot(parse_settings({"host": "127.0.0.1", "port": listening.getsockname()[1]}), None)
    with in_time(CONNECT_S), pytest.raises(WrongController):
        robot.open()
    thread.join()
    listening.close()


def test_a_serial_port_that_is_not_there() -> None:
    from drivers.abb.adapter import AbbRobot

    robot = AbbRobot(parse_settings({"serial_port": "/dev/ttyNOTHING"}), None)
    with in_time(0.5), pytest.raises(RobotNotReached) as caught:
        robot.open()
    assert caught.value.where == "/dev/ttyNOTHING"


def test_an_unplugged_serial_line() -> None:
    with controller() as made:
        robot = robot_over_pty(made)
        robot.open()
    with in_time(SILENCE_S), pytest.raises((LinkLost, RobotTimeout)):
        robot.read_state()
    robot.close()


WRONG: dict[str, dict[str, object]] = {
    "neither": {},
    "both": {"host": "h", "serial_port": "/dev/x"},
    "unknown": {"host": "h", "speed": 1},
    "slow baud": {"serial_port": "/dev/x", "baud": 9600},
    "port": {"host": "h", "port": 70000},
    "flag": {"host": "h", "flange_pose": "yes"},
    "watchdog": {"host": "h", "watchdog_s": 0.1},
    "empty": {"host": " "},
}


@pytest.mark.parametrize("settings", WRONG.values(), ids=list(WRONG))
def test_wrong_settings_are_refused_with_what_is_allowed(settings: dict[str, object]) -> None:
    with pytest.raises(SettingsError) as caught:
        parse_settings(settings)
    assert caught.value.remedy


def test_the_bench_speaks_of_faults_axes_and_motions(made: AbbController) -> None:
    from drivers.simulated.controllers.bench import BenchClient

    bench = BenchClient("127.0.0.1", made.bench_port)
    assert "black_hole" in bench.ask("faults")
    assert bench.ask("motions") == "0"
    np.testing.assert_array_equal(bench.axes().target_rad, made.program.cell.axes().target_rad)
    asks: list[Callable[[], str]] = [lambda: bench.ask("fault nonsense"), lambda: bench.ask("dance"), lambda: bench.ask("fault slow x")]
    for ask in asks:
        with pytest.raises(SettingsError):
            ask()
    bench.ask("quit")
    assert made.ended.wait(1)
