"""The contract of `drivers.protocols.Robot` as a pytest class.

Subclass it and give a fixture `rig`:

    class TestMyRobot(RobotContract):
        @pytest.fixture
        def rig(self) -> Iterator[RobotRig]:
            yield RobotRig(make=lambda: MyRobot("192.168.0.9"), targets_rad=np.array([...]))

Tests whose means a rig does not have are skipped, and say which. The robot moves between the rig's targets.
"""

from __future__ import annotations

import time
from itertools import pairwise

import numpy as np

from drivers.contract.checks import (
    SLACK_S,
    NoCamera,
    arrived,
    fault_of,
    go,
    in_time,
    is_at,
    motions_of,
    opened,
    require,
    require_raises,
    require_still,
    skip_without,
    start,
    stop_if_possible,
    until_it_raises,
    wait_for,
)
from drivers.contract.rig import RobotRig
from drivers.errors import LinkLost, MotionRefused, RobotError, RobotNotReached, RobotTimeout, SafetyStop, StaleReading
from drivers.kinematics import mdh
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import CONNECT_S, MAX_AGE_S, SILENCE_S, Devices, Robot, Safety

__all__ = ["RobotContract", "RobotRig"]

_FACTORY_CALIBRATED_MM = 20.0


class RobotContract:
    """One test per promise of the protocol."""

    def test_it_is_a_robot_that_says_what_it_is(self, rig: RobotRig) -> None:
        """The protocol's methods are there; `close` may be called at any time, any number of times."""
        robot = rig.make()
        require(isinstance(robot, Robot), "does not satisfy drivers.protocols.Robot")
        robot.close()
        with opened(rig) as robot:
            pass
        require(bool(robot.open().adapter), "RobotInfo.adapter is empty")
        robot.close()
        robot.close()

    def test_no_reading_without_a_link(self, rig: RobotRig) -> None:
        """Before `open` and after `close` there is nothing to read."""
        robot = rig.make()
        require_raises(robot.read_state, RobotNotReached)
        with opened(rig) as robot:
            robot.read_state()
        require_raises(robot.read_state, RobotNotReached)

    def test_readings_are_fresh_and_time_goes_on(self, rig: RobotRig) -> None:
        """Thirty readings: finite, of the right size, young, and each later than the one before."""
        with opened(rig) as robot:
            states = [robot.read_state() for _ in range(30)]
        for state in states:
            require(0 <= state.age_s <= MAX_AGE_S, f"a reading is {state.age_s} s old")
            require(state.safety in (Safety.NORMAL, Safety.REDUCED), f"the robot is in {state.safety}")
            if state.joints_rad is not None:
                require(state.joints_rad.shape == rig.targets_rad.shape[1:], f"{state.joints_rad.size} axes")
                require(bool(np.isfinite(state.joints_rad).all()), "axis angles that are not finite")
        times = [state.time_s for state in states]
        require(all(later > earlier for earlier, later in pairwise(times)), "time does not rise from reading to reading")

    def test_joints_and_flange_pose_agree(self, rig: RobotRig) -> None:
        """What it reports is within a factory calibration of the nominal model: units, order, coupling, tool."""
        model = rig.model
        if model is None:
            skip_without("a robot model")
            return
        with opened(rig) as robot:
            for target in rig.targets_rad:
                state = go(robot, rig, target)
                if state.joints_rad is None or state.base_from_flange is None:
                    skip_without("both axis angles and flange pose")
                    return
                off_mm = np.linalg.norm(state.base_from_flange[:3, 3] - mdh.base_from_flange(model, state.joints_rad)[:3, 3])
                require(bool(off_mm < _FACTORY_CALIBRATED_MM), f"the flange pose is {off_mm:.1f} mm from the model's")

    def test_a_move_starts_at_once_ends_at_its_target_and_keeps_its_speed(self, rig: RobotRig) -> None:
        """`start_move` returns while the robot moves; it then stands still at the target, not before its time."""
        with opened(rig) as robot:
            begin = go(robot, rig, rig.targets_rad[0])
            began_s = time.monotonic()
            robot.start_move(rig.targets_rad[1], speed_rad_s=rig.speed_rad_s)
            require(time.monotonic() - began_s < SILENCE_S + SLACK_S, "start_move waits for the motion")
            end = arrived(robot, rig, rig.targets_rad[1])
            after = [robot.read_state() for _ in range(5)]
        require(not any(state.moving for state in after), "it still moves at its target")
        if begin.joints_rad is not None:
            shortest_s = float(np.abs(rig.targets_rad[1] - begin.joints_rad).max()) / rig.speed_rad_s
            took_s = end.time_s - begin.time_s
            require(took_s > 0.8 * shortest_s, f"{took_s:.2f} s for a way that takes {shortest_s:.2f} s at the speed that was asked")

    def test_what_must_not_be_sent_is_refused_and_nothing_moves(self, rig: RobotRig) -> None:
        """Number of axes, finiteness, limits and speed are checked before anything is sent."""
        good = rig.targets_rad[1]
        wrong: list[tuple[FloatArray, float]] = [(good[:-1], 0.1), (np.append(good, 0.0), 0.1), (np.full_like(good, np.nan), 0.1)]
        wrong += [(good, speed) for speed in (0.0, -1.0, float("nan"), float("inf"))]
        if rig.model is not None and np.isfinite(rig.model.joint_limits_rad[:, 1]).all():
            wrong.append((rig.model.joint_limits_rad[:, 1] + 0.01, 0.1))
        with opened(rig) as robot:
            before = robot.read_state()
            count = motions_of(rig)
            for target, speed in wrong:
                require_raises(lambda target=target, speed=speed: robot.start_move(target, speed_rad_s=speed), MotionRefused)  # type: ignore[misc]
            require(not robot.read_state().moving, "a refused target moves the robot")
            require_still(robot, before)
        require(motions_of(rig) == count, "the controller saw a motion")

    def test_one_motion_at_a_time(self, rig: RobotRig) -> None:
        """A second target during a motion is refused, and the first motion goes on."""
        with opened(rig) as robot:
            go(robot, rig, rig.targets_rad[0])
            robot.start_move(rig.targets_rad[1], speed_rad_s=rig.speed_rad_s)
            require_raises(lambda: robot.start_move(rig.targets_rad[0], speed_rad_s=rig.speed_rad_s), MotionRefused)
            arrived(robot, rig, rig.targets_rad[1])

    def test_stop_stops_and_the_next_motion_works(self, rig: RobotRig) -> None:
        """Stopped half-way it stands; twice is no harm; then it can be moved."""
        with opened(rig) as robot:
            go(robot, rig, rig.targets_rad[0])
            start(robot, rig, rig.targets_rad[1])
            robot.stop()
            robot.stop()
            stands = wait_for(robot, lambda state: not state.moving, 2.0, "stand after a stop")
            if stands.joints_rad is not None:
                require_still(robot, stands)
            require(not is_at(stands, rig.targets_rad[1], rig), "the motion went on to its target")
            go(robot, rig, rig.targets_rad[1])

    def test_an_exception_in_the_program_stops_the_robot(self, rig: RobotRig) -> None:
        """`Devices` is left by an exception: the arm must not go on."""
        robot = rig.make()
        with opened(rig) as mover:
            go(mover, rig, rig.targets_rad[0])
        try:
            with Devices(robot, NoCamera()):
                start(robot, rig, rig.targets_rad[1])
                raise _ProgramError
        except _ProgramError:
            pass
        with opened(rig) as robot:
            state = wait_for(robot, lambda state: not state.moving, 2.0, "stand")
            require(not is_at(state, rig.targets_rad[1], rig), "the motion went on without its program")

    def test_nobody_at_the_address(self, rig: RobotRig) -> None:
        """Refused or swallowed: `open` ends in time, and other threads run on meanwhile."""
        if not rig.nobody:
            skip_without("addresses where nobody is")
        for make in rig.nobody.values():
            robot = make()
            with in_time(CONNECT_S):
                require_raises(robot.open, RobotNotReached, RobotTimeout)
            robot.close()

    def test_silence(self, rig: RobotRig) -> None:
        """A controller that says nothing ends every call in time; nothing is pretended; it can be opened again."""
        self._lost(rig, "silence", RobotNotReached, RobotTimeout)

    def test_a_link_that_drops(self, rig: RobotRig) -> None:
        """The same for a link that is cut: LinkLost."""
        self._lost(rig, "drop", LinkLost)

    def _lost(self, rig: RobotRig, fault: str, *expected: type[RobotError]) -> None:
        break_it = fault_of(rig, fault)
        with opened(rig) as robot:
            go(robot, rig, rig.targets_rad[0])
            start(robot, rig, rig.targets_rad[1])
            count = motions_of(rig)
            break_it()
            with in_time(SILENCE_S + CONNECT_S):
                until_it_raises(robot, *expected)
            with in_time(SILENCE_S):
                require_raises(robot.read_state, *expected)
            with in_time(SILENCE_S):
                require_raises(lambda: robot.start_move(rig.targets_rad[0], speed_rad_s=rig.speed_rad_s), *expected)
            with in_time(2 * SILENCE_S):
                stop_if_possible(robot)
            with in_time(2 * SILENCE_S):
                robot.close()
        rig.clear()
        with opened(rig) as robot:
            stands = wait_for(robot, lambda state: not state.moving, 10.0, "stand")
            robot.wait(0.3)
            require_still(robot, stands)
            require(motions_of(rig) == count, "a motion was sent again after the link came back")

    def test_old_readings_are_refused(self, rig: RobotRig) -> None:
        """Readings come, and are old: StaleReading, whatever they say."""
        break_it = fault_of(rig, "stale")
        with opened(rig) as robot:
            robot.read_state()
            break_it()
            time.sleep(2 * MAX_AGE_S)
            with in_time(SILENCE_S):
                require_raises(robot.read_state, StaleReading)
            rig.clear()

    def test_a_protective_stop(self, rig: RobotRig) -> None:
        """In mid-motion: told, motions refused, never cleared, nothing replayed."""
        self._stopped(rig, "protective_stop", Safety.PROTECTIVE_STOP)

    def test_an_emergency_stop(self, rig: RobotRig) -> None:
        """The same."""
        self._stopped(rig, "emergency_stop", Safety.EMERGENCY_STOP)

    def _stopped(self, rig: RobotRig, fault: str, safety: Safety) -> None:
        break_it = fault_of(rig, fault)
        with opened(rig) as robot:
            go(robot, rig, rig.targets_rad[0])
            start(robot, rig, rig.targets_rad[1])
            count = motions_of(rig)
            break_it()
            state = wait_for(robot, lambda state: state.safety is safety and not state.moving, SILENCE_S + SLACK_S, f"tell of a {safety.value}")
            with in_time(SILENCE_S):
                require_raises(lambda: robot.start_move(rig.targets_rad[0], speed_rad_s=rig.speed_rad_s), SafetyStop)
            with in_time(2 * SILENCE_S):
                stop_if_possible(robot)
        with opened(rig) as robot:
            require(robot.read_state().safety is safety, "the stop was cleared by the program")
        rig.clear()
        with opened(rig) as robot:
            robot.wait(0.5)
            require_still(robot, state)
            require(motions_of(rig) == count, "an old motion was replayed")
            go(robot, rig, rig.targets_rad[1])


class _ProgramError(Exception):
    """Any exception of a program."""
