"""Moving a robot and seeing it stand still: every reading is checked, every wait has an end.

Time is the robot's own (`wait`, `RobotState.time_s`), so that a simulated cell runs at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import MotionInterrupted, RobotTimeout
from drivers.kinematics import se3
from drivers.protocols import Robot, RobotState
from drivers.readings import check_age, check_safety

FloatArray = NDArray[np.float64]

# turns millimetres of a flange pose into radians of an axis where a robot reports no axis angles
_REACH_MM = 1000.0


class RobotUnsettled(RobotTimeout):
    """The robot is at its target and does not come to rest."""


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """How to move and to wait."""

    speed_rad_s: float = 0.3
    settle_s: float = 0.5
    """How long no axis may move by more than the tolerance."""
    still_tolerance_rad: float = 1e-4
    settle_timeout_s: float = 10.0
    arrival_tolerance_rad: float = 2e-3
    poll_s: float = 0.05
    start_grace_s: float = 1.0
    """How long a controller may take until it reports that it moves."""
    stop_timeout_s: float = 5.0
    slowest_share: float = 0.25
    """Share of the speed that the pendant's override may leave; slower motions are taken for stuck."""


@dataclass(frozen=True, slots=True, eq=False)
class Stillness:
    """What the readings of one settling time say."""

    settled: bool
    stillness_rad: float
    """Largest change of any axis over the readings."""
    joints_rad: FloatArray | None
    """(n,) mean of the readings."""
    last: RobotState
    seconds: float


def read_safely(robot: Robot) -> RobotState:
    """A reading of a robot in normal state.

    Raises:
        SafetyStop: a protective, safeguard or emergency stop is active.
        RobotNotReached: the robot does not answer.
        RobotTimeout: the same, late, or with an old reading.
    """
    state = robot.read_state()
    check_safety(state)
    check_age(state)
    return state


def move(robot: Robot, target_rad: FloatArray, settings: MotionSettings) -> Iterator[RobotState]:
    """Move to axis angles (n,), giving every reading on the way; the last one is of the robot at its target.

    The caller may leave at any reading, and then has to stop the robot.

    Raises:
        MotionRefused: the robot does not start.
        RobotTimeout: not there within the time that distance and speed allow; the robot was stopped.
        MotionInterrupted: it stands elsewhere.
        SafetyStop: a stop is active.
    """
    start = read_safely(robot)
    deadline_s = _deadline_s(start, target_rad, settings)
    robot.start_move(target_rad, speed_rad_s=settings.speed_rad_s)
    waited_s = 0.0
    while True:
        state = read_safely(robot)
        elapsed_s = max(state.time_s - start.time_s, waited_s)
        if not state.moving and (_at(state, target_rad, settings) or elapsed_s > settings.start_grace_s):
            break
        if elapsed_s > deadline_s:
            halt(robot, settings)
            raise RobotTimeout(
                f"the robot was not at its target within {deadline_s:.0f} s ({remaining_text(state, target_rad)}), and was stopped"
                f"{_controllers_word(state)}",
                remedy="Is the speed override very low, or the robot held? Continue with --resume.",
            )
        yield state
        robot.wait(settings.poll_s)
        waited_s += settings.poll_s
    if not _at(state, target_rad, settings):
        raise MotionInterrupted(
            f"the robot stands {remaining_text(state, target_rad)}{_controllers_word(state)}",
            remedy="Who stopped it? Look at the pendant, then continue with --resume.",
        )
    yield state


def halt(robot: Robot, settings: MotionSettings) -> None:
    """Stop and see the robot stand.

    Raises:
        RobotTimeout: it still moves after `stop_timeout_s`.
    """
    robot.stop()
    waited_s = 0.0
    while robot.read_state().moving:
        if waited_s > settings.stop_timeout_s:
            raise RobotTimeout(f"the robot still moves {waited_s:.1f} s after a stop", remedy="Press the emergency stop.")
        robot.wait(settings.poll_s)
        waited_s += settings.poll_s


def settle(robot: Robot, settings: MotionSettings) -> Stillness:
    """Read for `settle_s` again and again until all readings agree, or `settle_timeout_s` is over.

    Raises:
        SafetyStop: a stop is active.
    """
    waited_s = 0.0
    while True:
        states = [read_safely(robot)]
        window_s = 0.0
        while window_s < settings.settle_s or len(states) < 3:
            robot.wait(settings.poll_s)
            window_s += settings.poll_s
            states.append(read_safely(robot))
        waited_s += window_s
        change = max(change_rad(state, states[0]) for state in states)
        if settings.still_tolerance_rad >= change and not any(state.moving for state in states):
            return Stillness(True, change, _mean_joints(states), states[-1], waited_s)
        if waited_s >= settings.settle_timeout_s:
            return Stillness(False, change, _mean_joints(states), states[-1], waited_s)


def unsettled(stillness: Stillness) -> RobotUnsettled:
    """The error that tells of a robot that did not come to rest."""
    return RobotUnsettled(
        f"the robot did not come to rest within {stillness.seconds:.1f} s: its axes still move by {stillness.stillness_rad:.2g} rad",
        remedy="Is somebody leaning on it, or does its brake or tool vibrate?",
    )


def measured_joints(before: Stillness, after: RobotState) -> FloatArray | None:
    """Axis angles (n,) of the exposure: all readings that frame it, the settling ones weighing most."""
    if before.joints_rad is None or after.joints_rad is None:
        return before.joints_rad
    return np.asarray((2 * before.joints_rad + after.joints_rad) / 3)


def change_rad(state: RobotState, other: RobotState) -> float:
    """Largest difference of any axis between two readings; of the flange pose where there are no axis angles."""
    if state.joints_rad is not None and other.joints_rad is not None:
        return float(np.abs(state.joints_rad - other.joints_rad).max())
    if state.base_from_flange is not None and other.base_from_flange is not None:
        twist = se3.log(se3.inverse(other.base_from_flange) @ state.base_from_flange)
        return float(max(np.linalg.norm(twist[:3]) / _REACH_MM, np.linalg.norm(twist[3:])))
    return 0.0


def remaining_rad(state: RobotState, target_rad: FloatArray) -> float | None:
    """Largest axis distance to a target, None where the robot reports no axis angles."""
    return None if state.joints_rad is None else float(np.abs(state.joints_rad - target_rad).max())


def remaining_text(state: RobotState, target_rad: FloatArray) -> str:
    """Which axis is how far from a target, in words."""
    if state.joints_rad is None:
        return "position unknown"
    axis = int(np.argmax(np.abs(state.joints_rad - target_rad)))
    return f"axis {axis + 1} {np.degrees(abs(state.joints_rad[axis] - target_rad[axis])):.3f} degrees from its target"


def _controllers_word(state: RobotState) -> str:
    return "" if state.reason is None else f"; the controller says: {state.reason}"


def _mean_joints(states: Sequence[RobotState]) -> FloatArray | None:
    joints = [state.joints_rad for state in states if state.joints_rad is not None]
    return np.mean(joints, axis=0) if len(joints) == len(states) else None


def _at(state: RobotState, target_rad: FloatArray, settings: MotionSettings) -> bool:
    remaining = remaining_rad(state, target_rad)
    return remaining is None or remaining <= settings.arrival_tolerance_rad


def _deadline_s(state: RobotState, target_rad: FloatArray, settings: MotionSettings) -> float:
    distance = remaining_rad(state, target_rad)
    return (np.pi if distance is None else distance) / (settings.speed_rad_s * settings.slowest_share) + 5.0
