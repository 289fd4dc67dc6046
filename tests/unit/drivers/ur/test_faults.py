"""Each fault ends within its deadline, in the error that fits it, with the robot told to stop and nothing replayed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from acquire.motion import MotionSettings, move
from drivers.contract.checks import in_time, require_raises
from drivers.errors import (
    ChannelTaken,
    EmergencyStop,
    LinkLost,
    MotionInterrupted,
    MotionRefused,
    MotorsOff,
    NotInRemoteControl,
    ProtectiveStop,
    RobotError,
    RobotNotReached,
    RobotTimeout,
    SafeguardStop,
    SafetyStop,
    SpherecalError,
    StaleReading,
    WrongController,
)
from drivers.models import load_robot_model
from drivers.protocols import CONNECT_S, MAX_AGE_S, SILENCE_S, Mode, Safety
from drivers.ur.link import Child
from drivers.ur.net import Deadline
from drivers.ur_rtde import UrRobot, UrSettings
from tests.support.fake_ur import FakeUr
from tests.unit.drivers.ur.conftest import AWAY, HOME, robot_at

SPEED_RAD_S = 0.5
FAST = MotionSettings(speed_rad_s=2.0, poll_s=0.01)


def under_way(robot: UrRobot) -> None:
    """Start a motion away from where it stands, and see it move."""
    joints = robot.read_state().joints_rad
    assert joints is not None
    robot.start_move(HOME if np.abs(joints - AWAY).max() < np.abs(joints - HOME).max() else AWAY, speed_rad_s=SPEED_RAD_S)
    until_s = time.monotonic() + 2
    while not robot.read_state().moving:
        assert time.monotonic() < until_s
    time.sleep(0.05)


def stands(controller: FakeUr) -> bool:
    """Whether the axes truly stand."""
    axes = controller.bench.axes()
    return axes.clock_s >= axes.start_s + axes.duration_s


def first_error(action: Callable[[], object], *kinds: type[RobotError]) -> SpherecalError:
    """Repeat until it fails, which has to be soon."""

    def repeat() -> None:
        until_s = time.monotonic() + 3 * SILENCE_S
        while time.monotonic() < until_s:
            action()
            time.sleep(0.01)

    return require_raises(repeat, *kinds)


@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        ("silence", RobotTimeout),
        # the contract has these two at addresses where nobody is
        pytest.param("refuse", RobotNotReached, marks=pytest.mark.qualify),
        pytest.param("black_hole", RobotNotReached, marks=pytest.mark.qualify),
    ],
)
def test_open(controller: FakeUr, fault: str, kind: type[RobotError]) -> None:
    controller.fault(fault)
    robot = robot_at(controller.host)
    with in_time(CONNECT_S):
        require_raises(robot.open, kind)
    require_raises(robot.read_state, RobotNotReached)


@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        ("drop", LinkLost),
        pytest.param("half_packets", RobotTimeout, marks=pytest.mark.qualify),
        # what is wrong shows in the values, in the time stamp, or in ur_rtde's end
        ("garbage", (WrongController, RobotTimeout, LinkLost)),
        pytest.param("noise", (WrongController, RobotTimeout, LinkLost), marks=pytest.mark.qualify),
        pytest.param("refuse", LinkLost, marks=pytest.mark.qualify),
        pytest.param("restart 60", LinkLost, marks=pytest.mark.qualify),
        pytest.param("lag 0.2", StaleReading, marks=pytest.mark.qualify),
        # the contract has silence and stale in the ordinary suite
        pytest.param("silence", RobotTimeout, marks=pytest.mark.qualify),
        pytest.param("black_hole", RobotTimeout, marks=pytest.mark.qualify),
        pytest.param("stale", StaleReading, marks=pytest.mark.qualify),
        pytest.param("slow 0.3", RobotTimeout, marks=pytest.mark.qualify),
    ],
)
def test_in_mid_move(controller: FakeUr, robot: UrRobot, fault: str, kind: type[RobotError] | tuple[type[RobotError], ...]) -> None:
    """The next reading fails in time; the motion is at its end soon after, by our stop or by the controller's watchdog."""
    under_way(robot)
    count = controller.n_motions()
    controller.fault(fault)
    with in_time(2 * SILENCE_S):
        first_error(robot.read_state, *(kind if isinstance(kind, tuple) else (kind,)))
    with in_time(2 * SILENCE_S):
        told: list[str] = []
        try:
            robot.stop()
        except RobotError as error:
            told.append(str(error))
    assert all("emergency stop" in text for text in told)
    robot.close()
    until_s = time.monotonic() + 3
    while not stands(controller):
        assert time.monotonic() < until_s
        time.sleep(0.02)
    controller.clear()
    time.sleep(0.1)
    assert controller.n_motions() == count


@pytest.mark.qualify
def test_packages_in_pieces_do_no_harm(controller: FakeUr, robot: UrRobot) -> None:
    controller.fault("fragments")
    list(move(robot, AWAY, FAST))
    list(move(robot, HOME, FAST))


def test_a_command_whose_confirmation_is_lost_is_not_sent_again(controller: FakeUr, robot: UrRobot) -> None:
    robot.start_move(AWAY, speed_rad_s=SPEED_RAD_S)
    robot.stop()
    count = controller.n_motions()
    controller.fault("drop_at_command")
    with in_time(SILENCE_S):
        require_raises(lambda: robot.start_move(HOME, speed_rad_s=SPEED_RAD_S), LinkLost, RobotTimeout)
    with in_time(SILENCE_S):
        require_raises(lambda: robot.start_move(HOME, speed_rad_s=SPEED_RAD_S), LinkLost, RobotTimeout)
    robot.close()
    time.sleep(0.3)
    assert controller.n_motions() == count + 1
    assert stands(controller)
    # the command still lies in the controller's registers: the next script must not find it there
    controller.clear()
    robot.open()
    here = robot.read_state().joints_rad
    assert here is not None
    list(move(robot, here + 0.02, FAST))
    assert controller.n_motions() == count + 2


def test_ctrl_c_while_a_reading_is_waited_for_stops_the_robot(controller: FakeUr, robot: UrRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its reply comes later; it must not be taken for that of the stop, nor the stop's for a reading."""
    under_way(robot)

    def interrupted(*_: object) -> None:
        monkeypatch.undo()
        raise KeyboardInterrupt

    monkeypatch.setattr("drivers.ur.link.select", SimpleNamespace(select=interrupted))
    with pytest.raises(KeyboardInterrupt):
        robot.read_state()
    robot.stop()
    assert stands(controller)
    assert not robot.read_state().moving
    list(move(robot, HOME, FAST))


def test_a_reading_that_grew_old_in_our_own_pipe_is_asked_for_again(robot: UrRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy computer holds up the process between the child's clock and ours: once is no error, always is one."""
    ask, held_s = Child.ask, [2 * MAX_AGE_S]

    def late(child: Child, what: str, deadline: Deadline, **arguments: object) -> dict[str, Any]:
        reply = ask(child, what, deadline, **arguments)
        time.sleep(held_s.pop() if held_s else 0)
        return reply

    monkeypatch.setattr(Child, "ask", late)
    assert robot.read_state().age_s <= MAX_AGE_S
    assert not held_s
    held_s.extend([2 * MAX_AGE_S] * 100)
    with in_time(SILENCE_S):
        require_raises(robot.read_state, StaleReading)


def test_a_cut_commanding_link_stays_cut(controller: FakeUr, robot: UrRobot) -> None:
    """ur_rtde by itself would connect anew within milliseconds, put a new script on the controller and say nothing."""
    under_way(robot)
    count = controller.n_motions()
    log = controller.bench.ask("log")
    controller.fault("drop_commanding")
    time.sleep(1.0)  # nobody looks meanwhile
    require_raises(robot.read_state, LinkLost)
    assert "begins" not in controller.bench.ask("log").removeprefix(log)
    require_raises(lambda: robot.start_move(HOME, speed_rad_s=SPEED_RAD_S), LinkLost)
    robot.stop()
    assert stands(controller)
    assert controller.n_motions() == count


@pytest.mark.parametrize(
    ("button", "safety", "kind"),
    [
        ("protective_stop", Safety.PROTECTIVE_STOP, ProtectiveStop),
        ("safeguard_stop", Safety.SAFEGUARD_STOP, SafeguardStop),
        pytest.param("emergency_stop", Safety.EMERGENCY_STOP, EmergencyStop, marks=pytest.mark.qualify),
        pytest.param("safety_fault", Safety.FAULT, SafetyStop, marks=pytest.mark.qualify),
    ],
)
def test_stops_in_mid_move(controller: FakeUr, robot: UrRobot, button: str, safety: Safety, kind: type[SafetyStop]) -> None:
    """Told with UR's own name; refused; and when everything is mended and Play pressed, the old motion does not go on."""
    under_way(robot)
    count = controller.n_motions()
    controller.fault(button)
    state = robot.read_state()
    while state.safety is Safety.NORMAL:
        state = robot.read_state()
    assert state.safety is safety
    assert state.reason is not None
    assert "safety mode" in state.reason
    error = require_raises(lambda: robot.start_move(HOME, speed_rad_s=SPEED_RAD_S), kind)
    assert type(error) is kind
    robot.stop()
    controller.clear()
    time.sleep(0.1)
    assert stands(controller)
    assert controller.n_motions() == count
    list(move(robot, HOME, FAST))  # the same link goes on, with a new script


def test_a_motion_held_by_a_person_is_told_and_does_not_go_on_later(controller: FakeUr, robot: UrRobot) -> None:
    for button in ("pendant_stop", "pendant_pause"):
        list(move(robot, HOME, FAST))
        count = controller.n_motions()

        def press_in_mid_move(button: str = button) -> None:
            for i, _ in enumerate(move(robot, AWAY, MotionSettings(speed_rad_s=SPEED_RAD_S, start_grace_s=0.3))):
                if i == 2:
                    controller.fault(button)

        error = require_raises(press_in_mid_move, MotionInterrupted)
        assert "program" in str(error)
        robot.stop()
        controller.fault("pendant_play")
        time.sleep(0.1)
        assert stands(controller)
        assert controller.n_motions() == count + 1


@pytest.mark.parametrize(
    ("fault", "kind", "word"),
    [
        ("local", NotInRemoteControl, "remote control"),
        ("power_off", MotorsOff, "POWER_OFF"),
        ("foreign_program", ChannelTaken, "production"),
        ("registers_taken", ChannelTaken, "upper_registers"),
    ],
)
def test_motions_are_refused_each_for_its_own_reason(controller: FakeUr, robot: UrRobot, fault: str, kind: type[RobotError], word: str) -> None:
    count = controller.n_motions()
    controller.fault(fault)
    with in_time(SILENCE_S):
        error = require_raises(lambda: robot.start_move(AWAY, speed_rad_s=SPEED_RAD_S), kind)
    assert type(error) is kind
    assert word in str(error)
    robot.read_state()  # reading needs none of it
    robot.stop()
    assert controller.n_motions() == count


def test_a_foreign_program_survives_us(controller: FakeUr) -> None:
    controller.fault("foreign_program")
    log = controller.bench.ask("log")
    robot = robot_at(controller.host)
    robot.open()
    require_raises(lambda: robot.start_move(AWAY, speed_rad_s=SPEED_RAD_S), ChannelTaken)
    robot.stop()
    robot.close()
    assert controller.bench.ask("log") == log
    robot.open()
    require_raises(lambda: robot.start_move(AWAY, speed_rad_s=SPEED_RAD_S), ChannelTaken)
    robot.close()


def test_taken_registers_are_left_to_their_owner(controller: FakeUr) -> None:
    controller.fault("registers_taken")
    robot = robot_at(controller.host, upper_registers=True)
    robot.open()
    try:
        list(move(robot, HOME, FAST))
    finally:
        robot.close()


def test_a_restarted_controller_comes_back_with_its_motors_off(controller: FakeUr, robot: UrRobot) -> None:
    controller.fault("restart 0.3")
    first_error(robot.read_state, LinkLost)
    require_raises(robot.read_state, LinkLost)
    time.sleep(0.5)
    robot.open()
    assert robot.read_state().motors_on is False
    require_raises(lambda: robot.start_move(AWAY, speed_rad_s=SPEED_RAD_S), MotorsOff)


def test_a_wrong_model_is_not_moved(controller: FakeUr) -> None:
    robot = UrRobot(UrSettings(controller.host), load_robot_model("ur10e"))
    info = robot.open()
    try:
        assert any("ur10e" in note for note in info.notes)
        error = require_raises(lambda: robot.start_move(HOME, speed_rad_s=SPEED_RAD_S), MotionRefused)
        assert "not a ur10e" in str(error)
    finally:
        robot.close()


def test_an_active_tool_is_named_and_the_flange_stays_the_flange(controller: FakeUr) -> None:
    def reading() -> tuple[str | None, np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
        robot = robot_at(controller.host)
        robot.open()
        state = robot.read_state()
        robot.close()
        assert state.base_from_flange is not None
        return state.active_tool, state.base_from_flange

    name, bare = reading()
    assert name == "tool0"
    controller.fault("tool 0.01 -0.02 0.15 0.1 0.2 -0.3")
    try:
        name, with_tool = reading()
    finally:
        controller.fault("tool 0 0 0 0 0 0")
    assert name is not None
    assert "10.000 -20.000 150.000" in name
    np.testing.assert_allclose(with_tool, bare, atol=1e-9)


def test_a_tool_that_is_changed_in_mid_session_is_seen(controller: FakeUr, robot: UrRobot) -> None:
    """The flange pose stays the flange's at every reading, or is none; the tool's new name is told."""
    before = robot.read_state()
    assert before.base_from_flange is not None
    controller.fault("tool 0.01 -0.02 0.15 0.1 0.2 -0.3")
    try:
        until_s = time.monotonic() + 3 * SILENCE_S
        while (state := robot.read_state()).active_tool in ("tool0", None):
            assert time.monotonic() < until_s
            if state.base_from_flange is not None:
                np.testing.assert_allclose(state.base_from_flange, before.base_from_flange, atol=1e-6)
    finally:
        controller.fault("tool 0 0 0 0 0 0")
    assert state.base_from_flange is not None
    np.testing.assert_allclose(state.base_from_flange, before.base_from_flange, atol=1e-6)
    assert "10.000 -20.000 150.000" in str(state.active_tool)


def test_hand_guiding(controller: FakeUr, robot: UrRobot) -> None:
    robot.start_freedrive()
    controller.fault("push " + " ".join(str(angle) for angle in AWAY))
    until_s = time.monotonic() + 3
    while np.abs(np.asarray(robot.read_state().joints_rad) - AWAY).max() > 1e-6:
        assert time.monotonic() < until_s
    robot.end_freedrive()
    robot.end_freedrive()
    list(move(robot, HOME, FAST))


def test_local_control_is_a_mode(controller: FakeUr) -> None:
    controller.fault("local")
    robot = robot_at(controller.host)
    robot.open()
    assert robot.read_state().mode == Mode.LOCAL
    robot.close()


def is_gone(process: int) -> bool:
    """Whether a process has ended; nobody may have fetched its exit code."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


MOVES_UNTIL_KILLED = """
import sys, time
import numpy as np
from tests.unit.drivers.ur.conftest import AWAY, HOME, robot_at
robot = robot_at(sys.argv[1])
robot.open()
joints = robot.read_state().joints_rad
robot.start_move(HOME if np.abs(joints - AWAY).max() < 0.1 else AWAY, speed_rad_s=0.08)
print(robot._child._process.pid, flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("with_its_child", [pytest.param(False, marks=pytest.mark.qualify), True])
def test_a_killed_program_leaves_no_moving_arm(controller: FakeUr, with_its_child: bool) -> None:
    """Killed alone, its child stops the arm at once; killed with it, the controller's watchdog does, 2 s later."""
    program = subprocess.Popen([sys.executable, "-c", MOVES_UNTIL_KILLED, controller.host], stdout=subprocess.PIPE)
    assert program.stdout is not None
    with program.stdout:
        child = int(program.stdout.readline())
    time.sleep(0.1)
    assert not stands(controller)
    os.kill(program.pid, signal.SIGKILL)
    if with_its_child:
        os.kill(child, signal.SIGKILL)
    program.wait()
    began_s = time.monotonic()
    while not stands(controller):
        assert time.monotonic() - began_s < 3.0
        time.sleep(0.02)
    assert (time.monotonic() - began_s > 0.5) == with_its_child
    while not is_gone(child):
        assert time.monotonic() - began_s < 4.0
        time.sleep(0.02)
