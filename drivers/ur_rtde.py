"""Universal Robots over RTDE (PolyScope 3.3 or later; 5 is what this was written against). Never run on hardware.

    robot: {driver: ur_rtde, model: ur5e, host: 192.168.0.10}

ur_rtde runs in a child process (`drivers.ur.child`), which is killed when it does not answer; kinematics are our own.
Reading needs no remote control and puts nothing on the controller. The first motion puts ur_rtde's script on it, and
only where no other program runs. Motions are asynchronous. Nothing is ever sent twice: once the link has failed, every
call fails until the robot is opened anew. Stops are never cleared and drives never switched on. While the script is on
the controller, the controller itself ends it (and the motion) 2 s after it last heard of us.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.errors import ChannelTaken, MotionRefused, RobotError, RobotNotReached, RobotTimeout, StaleReading, WrongController
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import CONNECT_S, MAX_AGE_S, SILENCE_S, RobotInfo, RobotState
from drivers.readings import check_age, checked_target
from drivers.registry import DriverContext
from drivers.ur import dashboard
from drivers.ur.arm import Arm, read_arm
from drivers.ur.link import Child
from drivers.ur.net import Deadline, address_of
from drivers.ur.preflight import preflight
from drivers.ur.reading import check_can_move, check_sound, failure_of, reason_of, state_of, tool_fits
from drivers.ur.settings import UrSettings, ur_settings

__all__ = ["UrRobot", "UrSettings", "make_robot"]

log = logging.getLogger(__name__)

_ARM_S = 0.5
_CHILD_S = 1.2
_CONTROL_S = 3.0
_FASTEST_RAD_S = 3.14
_WATCHDOG_S, _LOOK_S = 2.3, 0.1
_SCRIPTS = ("rtde_control", "unnamed")
"""In the names of programs that were sent to the controller, and not loaded from it."""
_LARGEST_DEVIATION_MM, _SAME_MM = 20.0, 0.01
# the share of the speed that a speed slider may leave before a motion is taken for stuck, and what ramps take
_SLOWEST_SHARE, _RAMPS_S = 0.2, 6.0


def make_robot(context: DriverContext) -> UrRobot:
    """The UR of a cell file.

    Raises:
        SettingsError: `host` is missing, or another key or value is not allowed.
    """
    return UrRobot(ur_settings(context.settings), context.robot_model)


class UrRobot:
    """A UR arm. Satisfies `drivers.protocols.Robot` and `HandGuided`.

    Args:
        settings: address and how to move.
        model: the nominal robot, for limits; without one no motion is made (hand guiding and reading work).
    """

    def __init__(self, settings: UrSettings, model: RobotModel | None) -> None:
        self._settings, self._model = settings, model
        self._address = ""
        self._child: Child | None = None
        self._controlled = self._touched = False
        self._broken: RobotError | None = None
        self._remote: bool | None = None
        self._arm: Arm | None = None
        self._sees_tool = False
        """Whether a change of tool shows: the controller's kinematics and tool, as told here, give its own pose."""

    def open(self) -> RobotInfo:
        """Knock, shake hands, ask who it is, and start reading.

        Raises:
            RobotNotReached: nobody is there within 3 s, or it is no UR controller (WrongController).
            RobotTimeout: it is there and says nothing.
        """
        self.close()
        deadline = Deadline.after(CONNECT_S)
        self._address = address_of(self._settings.host, deadline)
        version = preflight(self._address, deadline.within(CONNECT_S - _CHILD_S))
        who = dashboard.identity(self._address, deadline.within(SILENCE_S))
        self._remote = who.remote
        self._arm = read_arm(self._address, Deadline(deadline.end_s - _CHILD_S).within(_ARM_S))
        self._child = Child(self._address, self._settings.frequency_hz, self._settings.flags)
        try:
            self._ask("connect", deadline)
            self.read_state()
            self._sees_tool = self._arm is not None and tool_fits(self._arm, self._raw()) is True
        except BaseException:  # Ctrl-C among them
            self.close()
            raise
        return RobotInfo("ur_rtde", who.model or None, who.serial or None, f"PolyScope {version}", self._notes(who.program))

    def read_state(self) -> RobotState:
        """A reading that came while it was waited for; one that a busy computer has let grow old on the way is asked for again.

        Raises:
            LinkLost: the link has gone, now or earlier.
            StaleReading: the controller is there and its readings stand still or come late.
            RobotTimeout: it says nothing any more.
        """
        end_s = time.monotonic() + SILENCE_S / 2
        while (state := self._state(self._raw())).age_s > MAX_AGE_S:
            if time.monotonic() > end_s:
                check_age(state)
        return state

    def start_move(self, joints_rad: FloatArray, *, speed_rad_s: float) -> None:
        """Start a motion; the fastest axis keeps `speed_rad_s`, the axes arrive together.

        Raises:
            MotionRefused: a target or speed that is not allowed, a motion under way, a program of somebody else
                (ChannelTaken), local control, motors off, or the controller declines.
            SafetyStop: a stop is active.
            LinkLost: and RobotTimeout as `read_state`.
        """
        target = self._checked(joints_rad, speed_rad_s)
        state = self._take_control()
        if state.joints_rad is None or state.moving:
            raise MotionRefused("a motion is still under way", remedy="Wait until the robot stands, or stop it first.")
        way_rad = float(np.abs(target - state.joints_rad).max())
        patience_s = way_rad / (speed_rad_s * _SLOWEST_SHARE) + _RAMPS_S
        arguments = {"q": target.tolist(), "speed": float(speed_rad_s), "acceleration": self._settings.acceleration_rad_s2, "deadline_s": patience_s}
        self._command("move", **arguments)

    def stop(self) -> None:
        """Stop the motion; where that does not get through, end the program that makes it.

        Raises:
            RobotNotReached: or RobotTimeout, the robot could not be told.
        """
        if self._child is not None and self._broken is None and self._controlled:
            try:
                self._ask("stop", Deadline.after(SILENCE_S))
                if reason_of(self._raw()) is None:
                    return
            except RobotError as error:
                log.debug("stop through the script failed (%s), the program is ended instead", error)
        self._controlled = False
        if not self._touched:
            return  # nothing of ours runs there, and nobody else's program is ended
        try:
            dashboard.end_program(self._address, Deadline.after(dashboard.ASK_S))
        except RobotError as error:
            error.remedy = "Press the emergency stop if the robot moves: it could not be told to stop."
            raise

    def wait(self, seconds: float) -> None:
        """Sleep."""
        time.sleep(max(seconds, 0.0))

    def close(self) -> None:
        """Stop, take the script off the controller, and hang up."""
        child, self._child = self._child, None
        lost = self._touched and self._broken is not None
        self._controlled, self._touched, self._broken, self._sees_tool = False, False, None, False
        if child is not None and lost:
            child.kill()
        elif child is not None:
            child.close()
        if lost:  # the script can no longer be told; the watchdog would end it anyway
            with contextlib.suppress(RobotError):
                dashboard.end_program(self._address, Deadline.after(dashboard.ASK_S))

    def start_freedrive(self) -> None:
        """Let a person push the arm; raises as `start_move`."""
        self._take_control()
        self._command("freedrive", on=True)

    def end_freedrive(self) -> None:
        """Hold the arm where it is."""
        if self._controlled:
            self._command("freedrive", on=False)

    def _checked(self, joints_rad: FloatArray, speed_rad_s: float) -> FloatArray:
        if self._model is None:
            raise MotionRefused("the cell names no robot model, so no limits are known", remedy="Name one in the cell file, e.g. `model: ur5e`.")
        target = checked_target(self._model, joints_rad, speed_rad_s=speed_rad_s)
        if speed_rad_s > _FASTEST_RAD_S:
            raise MotionRefused(f"a speed of {speed_rad_s} rad/s", remedy=f"A UR's axes turn at {_FASTEST_RAD_S} rad/s at most.")
        deviation_mm = None if self._arm is None else self._arm.deviation_mm(self._model)
        if deviation_mm is not None and deviation_mm > _LARGEST_DEVIATION_MM:
            remedy = "Name the right model in the cell file: the way would be checked for another robot."
            raise MotionRefused(f"the arm is not a {self._model.name}: its flange is up to {deviation_mm:.0f} mm elsewhere", remedy=remedy)
        return target

    def _take_control(self) -> RobotState:
        """Make sure that the controller obeys us and nobody else; gives the state."""
        raw = self._raw()
        self._remote = dashboard.in_remote_control(self._address, Deadline.after(SILENCE_S))
        state = self._state(raw)
        check_can_move(state)
        if self._controlled:
            return state
        if raw["controlled"]:
            self._start_again()
        self._check_no_program()
        self._touched = True
        self._ask("control", Deadline.after(_CONTROL_S))
        self._controlled = True
        return state

    def _check_no_program(self) -> None:
        """Nobody's program is ended by us; a script of ours whose link was lost is ended by its watchdog, so it is waited for."""
        patience = Deadline.after(_WATCHDOG_S)
        while (program := dashboard.running_program(self._address, Deadline.after(SILENCE_S))) is not None:
            if patience.left_s == 0 or not any(name in program for name in _SCRIPTS):
                remedy = "Stop it at the pendant; spherecal ends nobody's program."
                raise ChannelTaken(f"the program {program!r} runs on the controller", remedy=remedy)
            time.sleep(_LOOK_S)

    def _start_again(self) -> None:
        """A new child: ur_rtde's script was ended, by us or at the pendant, and there is no motion to be repeated."""
        if self._child is not None:
            self._child.close()
        self._child = Child(self._address, self._settings.frequency_hz, self._settings.flags)
        self._ask("connect", Deadline.after(CONNECT_S))

    def _command(self, what: str, **arguments: object) -> None:
        """A command, with the state's own reason when it is declined."""
        try:
            self._ask(what, Deadline.after(SILENCE_S), **arguments)
        except MotionRefused:
            check_can_move(self.read_state())
            raise

    def _raw(self) -> dict[str, Any]:
        return self._ask("state", Deadline.after(SILENCE_S))

    def _state(self, raw: Mapping[str, Any]) -> RobotState:
        try:
            check_sound(raw)
        except WrongController as error:
            self._broken = error
            raise
        return state_of(raw, self._arm_now(raw), self._remote)

    def _arm_now(self, raw: Mapping[str, Any]) -> Arm | None:
        """The arm with the tool that a reading's pose is of: somebody may select another one at the pendant at any time."""
        if not self._sees_tool or self._arm is None or tool_fits(self._arm, raw):
            return self._arm
        anew = read_arm(self._address, Deadline.after(_ARM_S))
        if anew is not None and tool_fits(anew, raw):
            log.warning("another tool was selected on the controller; flange poses do without it")
            self._arm = anew
            return anew
        return replace(self._arm, flange_from_tcp=None)  # of the moment of the change: no flange pose rather than a wrong one

    def _ask(self, what: str, deadline: Deadline, **arguments: object) -> dict[str, Any]:
        if self._broken is not None:
            raise self._broken
        if self._child is None:
            raise RobotNotReached("the robot is not open", remedy="Open it first, e.g. in a `with devices:` block.")
        try:
            reply = self._child.ask(what, deadline, **arguments)
        except RobotError as error:
            self._broken = error
            raise
        if reply["ok"]:
            return reply
        raise self._failed(failure_of(reply, self._child.last_words))

    def _failed(self, error: RobotError) -> RobotError:
        """The same error, or that of a controller that has fallen silent; a lost link stays lost."""
        if isinstance(error, StaleReading) and not dashboard.answers(self._address):
            error = RobotTimeout("the controller says nothing any more", remedy=error.remedy)
        if isinstance(error, RobotNotReached | RobotTimeout) and not isinstance(error, StaleReading):
            self._broken = error
        return error

    def _notes(self, program: str | None) -> tuple[str, ...]:
        is_ours = program is None or any(name in program for name in _SCRIPTS)
        notes = [] if is_ours else [f"the program {program!r} runs on the controller: motions are refused until somebody stops it there"]
        if self._model is not None:
            deviation_mm = None if self._arm is None else self._arm.deviation_mm(self._model)
            if deviation_mm is None:
                notes.append(f"the controller's own kinematic calibration could not be read; the nominal {self._model.name} is used")
            elif deviation_mm > _SAME_MM:
                notes.append(f"the nominal {self._model.name} is used; the controller's own calibration is up to {deviation_mm:.2f} mm from it")
        for note in notes:
            log.warning("%s", note)
        if self._arm is None or self._arm.flange_from_tcp is None:
            notes.append("the active tool could not be read, so there is no flange pose")
        elif not self._sees_tool:
            notes.append("select no other tool (TCP) during a session: it would not be noticed")
        return tuple(notes)
