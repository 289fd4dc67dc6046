"""Steps and judgements of the contract tests; a broken promise is an AssertionError that says which."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

import numpy as np

from drivers.contract.rig import RobotRig
from drivers.errors import CameraError, RobotError, SpherecalError
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import CameraInfo, Frame3D, Robot, RobotState

SLACK_S = 0.7
"""What a busy machine may add to a deadline."""
_TICK_S = 0.01
_LONGEST_GAP_S = 0.5
_POLL_S = 0.01
_STILL_RAD = 1e-3


class ContractBroken(AssertionError):
    """An adapter does not keep a promise."""


def require(good: bool, what_is_wrong: str) -> None:
    """Nothing, if good.

    Raises:
        ContractBroken: otherwise.
    """
    if not good:
        raise ContractBroken(what_is_wrong)


def require_raises(action: Callable[[], object], *kinds: type[SpherecalError]) -> SpherecalError:
    """The error that the action ends in, which must be of one of the kinds and say what to do.

    Raises:
        ContractBroken: no error, another one, or one without a remedy.
    """
    try:
        action()
    except (RobotError, CameraError) as error:
        require(isinstance(error, kinds), f"{type(error).__name__} ({error}) instead of {_names(kinds)}")
        require(bool(error.remedy), f"{type(error).__name__} without a remedy: {error}")
        return error
    raise ContractBroken(f"no error, expected {_names(kinds)}")


def skip_without(what: str) -> NoReturn:
    """Skip the running test."""
    import pytest

    pytest.skip(f"this rig has not: {what}")


@contextmanager
def in_time(deadline_s: float) -> Iterator[None]:
    """The block ends in time, and another thread of the process was never held up for long meanwhile.

    Raises:
        ContractBroken: it took longer, or another thread stood still.
    """
    done, gaps = threading.Event(), [0.0]

    def tick() -> None:
        last_s = time.monotonic()
        while not done.wait(_TICK_S):
            now_s = time.monotonic()
            gaps[0], last_s = max(gaps[0], now_s - last_s), now_s
        gaps[0] = max(gaps[0], time.monotonic() - last_s)

    thread = threading.Thread(target=tick, daemon=True)
    began_s = time.monotonic()
    thread.start()
    try:
        yield
    finally:
        took_s = time.monotonic() - began_s
        done.set()
        thread.join()
    require(took_s <= deadline_s + SLACK_S, f"took {took_s:.2f} s, allowed {deadline_s:.2f} s")
    require(gaps[0] < _LONGEST_GAP_S, f"another thread of the application stood still for {gaps[0]:.2f} s")


@contextmanager
def opened(rig: RobotRig) -> Iterator[Robot]:
    """A new adapter of the rig, open; closed on the way out."""
    robot = rig.make()
    try:
        robot.open()
        yield robot
    finally:
        robot.close()


def go(robot: Robot, rig: RobotRig, target_rad: FloatArray) -> RobotState:
    """Move to a target and see the robot there."""
    state = robot.read_state()
    if is_at(state, target_rad, rig) and not state.moving:
        return state
    robot.start_move(target_rad, speed_rad_s=rig.speed_rad_s)
    return arrived(robot, rig, target_rad)


def start(robot: Robot, rig: RobotRig, target_rad: FloatArray) -> RobotState:
    """Start a motion and see it under way."""
    begin = robot.read_state()
    robot.start_move(target_rad, speed_rad_s=rig.speed_rad_s)
    return wait_for(robot, lambda state: state.moving and _moved_rad(state, begin) > 0, 3.0, "begin to move")


def arrived(robot: Robot, rig: RobotRig, target_rad: FloatArray) -> RobotState:
    """Wait until the robot stands at a target."""
    way_rad = np.ptp(np.vstack([rig.targets_rad, target_rad]), axis=0).max()
    patience_s = 4 * float(way_rad) / rig.speed_rad_s + 5
    return wait_for(robot, lambda state: not state.moving and is_at(state, target_rad, rig), patience_s, "arrive")


def wait_for(robot: Robot, good: Callable[[RobotState], bool], patience_s: float, what: str) -> RobotState:
    """The first reading that is good, on the robot's own time.

    Raises:
        ContractBroken: none came in time.
    """
    begin = state = robot.read_state()
    waited_s = 0.0
    while not good(state):
        require(max(waited_s, state.time_s - begin.time_s) <= patience_s, f"did not {what} within {patience_s:.1f} s: {state}")
        robot.wait(_POLL_S)
        waited_s += _POLL_S
        state = robot.read_state()
    return state


def until_it_raises(robot: Robot, *kinds: type[RobotError]) -> SpherecalError:
    """Read until a reading fails, which must be with one of the kinds."""

    def read_on() -> None:
        for _ in range(10_000):
            robot.read_state()
            robot.wait(_POLL_S)

    return require_raises(read_on, *kinds)


def stop_if_possible(robot: Robot) -> None:
    """A stop through a broken link may fail, with an error of ours."""
    try:
        robot.stop()
    except RobotError as error:
        require(bool(error.remedy), f"a failed stop without a remedy: {error}")


def motions_of(rig: RobotRig) -> int | None:
    """How many motions the controller has begun, None where it does not tell."""
    return None if rig.n_motions is None else rig.n_motions()


def fault_of(rig: RobotRig, name: str) -> Callable[[], None]:
    """How to break the rig's controller; skips the test where the rig cannot."""
    if name not in rig.faults:
        skip_without(f"the fault {name}")
    return rig.faults[name]


def is_at(state: RobotState, target_rad: FloatArray, rig: RobotRig) -> bool:
    """Whether a reading is at a target."""
    return state.joints_rad is None or float(np.abs(state.joints_rad - target_rad).max()) <= rig.arrival_tolerance_rad


def require_still(robot: Robot, before: RobotState) -> None:
    """The robot stands where it stood.

    Raises:
        ContractBroken: it does not.
    """
    moved_rad = _moved_rad(robot.read_state(), before)
    require(moved_rad < _STILL_RAD, f"an axis has moved by {moved_rad:.4f} rad")


def _moved_rad(state: RobotState, before: RobotState) -> float:
    if state.joints_rad is None or before.joints_rad is None:
        return 0.0 if state.base_from_flange is None or before.base_from_flange is None else _flange_change(state, before)
    return float(np.abs(state.joints_rad - before.joints_rad).max())


def _flange_change(state: RobotState, before: RobotState) -> float:
    if state.base_from_flange is None or before.base_from_flange is None:
        return 0.0
    return float(np.linalg.norm(state.base_from_flange[:3, 3] - before.base_from_flange[:3, 3])) / 1000


def _names(kinds: tuple[type[SpherecalError], ...]) -> str:
    return " or ".join(kind.__name__ for kind in kinds)


class NoCamera:
    """A camera that nobody asks."""

    def open(self) -> CameraInfo:
        """Nothing to connect to."""
        return CameraInfo("none")

    def capture(self, *, timeout_s: float) -> Frame3D:
        """Never called."""
        raise NotImplementedError

    def close(self) -> None:
        """Nothing to close."""
