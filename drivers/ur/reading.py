"""From a child's raw reading to a `RobotState`, and from states to reasons and errors."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from drivers.errors import (
    ChannelTaken,
    LinkLost,
    MotionRefused,
    MotorsOff,
    NotInRemoteControl,
    RobotError,
    RobotTimeout,
    StaleReading,
    WrongController,
)
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import Mode, RobotState, Safety
from drivers.readings import check_safety
from drivers.ur.arm import Arm, pose_transform

_SAFETY = {
    1: Safety.NORMAL,
    2: Safety.REDUCED,
    3: Safety.PROTECTIVE_STOP,
    4: Safety.FAULT,
    5: Safety.SAFEGUARD_STOP,
    6: Safety.EMERGENCY_STOP,
    7: Safety.EMERGENCY_STOP,
    8: Safety.FAULT,
    9: Safety.FAULT,
    10: Safety.SAFEGUARD_STOP,
    11: Safety.SAFEGUARD_STOP,
}
_SAFETY_NAMES = {
    1: "NORMAL",
    2: "REDUCED",
    3: "PROTECTIVE_STOP",
    4: "RECOVERY",
    5: "SAFEGUARD_STOP",
    6: "SYSTEM_EMERGENCY_STOP",
    7: "ROBOT_EMERGENCY_STOP",
    8: "VIOLATION",
    9: "FAULT",
    10: "AUTOMATIC_MODE_SAFEGUARD_STOP",
    11: "SYSTEM_THREE_POSITION_ENABLING_STOP",
}
_ROBOT_MODES = {
    -1: "NO_CONTROLLER",
    0: "DISCONNECTED",
    1: "CONFIRM_SAFETY",
    2: "BOOTING",
    3: "POWER_OFF",
    4: "POWER_ON",
    5: "IDLE",
    6: "BACKDRIVE",
    7: "RUNNING",
    8: "UPDATING_FIRMWARE",
}
_RUNTIMES = {0: "STOPPING", 1: "STOPPED", 2: "PLAYING", 3: "PAUSING", 4: "PAUSED", 5: "RESUMING"}
_RUNNING, _PLAYING, _NORMAL = 7, 2, (1, 2)
_SAME_TOOL_MM, _SAME_TOOL_RAD = 1e-3, 1e-6
# a UR's axes turn twice round at most; lengths of a pose are in m, its rotation vector in rad; simulated arms may be 1000 times as fast
_LARGEST_RAD, _LARGEST_RAD_S, _LARGEST_POSE = 13.0, 1e4, 100.0
_LOOK = "Look at the pendant, then continue with --resume."


def state_of(raw: Mapping[str, Any], arm: Arm | None, remote: bool | None) -> RobotState:
    """The state that a child's reading is."""
    tool = None if arm is None else arm.flange_from_tcp
    return RobotState(
        joints_rad=np.array(raw["q"], dtype=np.float64),
        base_from_flange=None if tool is None else pose_transform(np.array(raw["pose"])) @ se3.inverse(tool),
        time_s=float(raw["at_s"]),
        moving=bool(raw["moving"]),
        safety=_SAFETY.get(raw["safety_mode"], Safety.UNKNOWN),
        mode=Mode.UNKNOWN if remote is None else Mode.AUTOMATIC if remote else Mode.LOCAL,
        age_s=max(time.monotonic() - float(raw["at_s"]), 0.0),
        motors_on=raw["robot_mode"] == _RUNNING,
        reason=reason_of(raw),
        active_tool=tool_name(tool),
        active_work_object="wobj0",  # UR reports in the base frame, whatever feature is active
    )


def check_sound(raw: Mapping[str, Any]) -> None:
    """Nothing, if a child's reading can be one.

    Raises:
        WrongController: not six axis angles, speeds and components of a pose, or impossible ones.
    """
    for key, largest in (("q", _LARGEST_RAD), ("qd", _LARGEST_RAD_S), ("pose", _LARGEST_POSE)):
        values = np.array(raw[key], dtype=np.float64)
        if values.shape != (6,) or not (np.abs(values) <= largest).all():
            found = f"a reading makes no sense: {key} is {[float(f'{value:.3g}') for value in values]}"
            raise WrongController(found, remedy="Is this a UR, and nothing between it and this computer that changes what is sent? Open it again.")


def tool_fits(arm: Arm, raw: Mapping[str, Any]) -> bool | None:
    """Whether the pose of a child's reading is that of the arm's tool; None where that cannot be told."""
    return arm.tool_fits(pose_transform(np.array(raw["pose"])), np.array(raw["q"]))


def reason_of(raw: Mapping[str, Any]) -> str | None:
    """Why the robot cannot move, in the controller's words; None if nothing is in the way."""
    found = []
    if raw["safety_mode"] not in _NORMAL:
        found.append(f"safety mode {_SAFETY_NAMES.get(raw['safety_mode'], raw['safety_mode'])}")
    if raw["robot_mode"] != _RUNNING:
        found.append(f"robot mode {_ROBOT_MODES.get(raw['robot_mode'], raw['robot_mode'])}")
    if raw["controlled"] and raw["runtime"] != _PLAYING:
        found.append(f"program {_RUNTIMES.get(raw['runtime'], raw['runtime'])}")
    return ", ".join(found) or None


def tool_name(flange_from_tcp: FloatArray | None) -> str | None:
    """`tool0` for the bare flange, else the tool by its numbers, None where unknown."""
    if flange_from_tcp is None:
        return None
    twist = se3.log(flange_from_tcp)
    if np.linalg.norm(flange_from_tcp[:3, 3]) < _SAME_TOOL_MM and np.linalg.norm(twist[3:]) < _SAME_TOOL_RAD:
        return "tool0"
    numbers = [*flange_from_tcp[:3, 3], *np.degrees(se3.log_so3(flange_from_tcp[:3, :3]))]
    return "tcp " + " ".join(f"{number:.3f}" for number in numbers) + " (mm, degrees)"


def check_can_move(state: RobotState) -> None:
    """Nothing, if safety and power allow a motion.

    Raises:
        SafetyStop: a stop is active, each kind its own error.
        MotorsOff: no power, or brakes closed.
        NotInRemoteControl: the pendant is the master.
    """
    check_safety(state)
    if not state.motors_on:
        raise MotorsOff(f"the arm is not ready: {state.reason}", remedy="Switch the arm on and release its brakes at the pendant.")
    if state.mode == Mode.LOCAL:
        raise NotInRemoteControl("the robot is in local control", remedy="Switch it to remote control at the pendant (top right).")


def failure_of(reply: Mapping[str, Any], last_words: str) -> RobotError:
    """The error that a failed reply of the child stands for."""
    kind, text = reply["kind"], " ".join(str(reply["text"]).split())
    match kind:
        case "lost":
            return LinkLost(f"the link to the controller is lost: {text}", remedy="Look at the network and the pendant, then continue with --resume.")
        case "stale":
            return StaleReading(f"the controller's readings stand still: {text}", remedy=_LOOK)
        case "busy":
            return MotionRefused(text, remedy="Wait until the robot stands, or stop it first.")
        case "exception":
            return _exception(text)
        case _:
            said = f" ({last_words})" if last_words else ""
            return MotionRefused(f"the controller declines: {text}{said}", remedy=_LOOK)


def _exception(text: str) -> RobotError:
    lower = text.lower()
    if "already in use" in lower:
        remedy = "Switch EtherNet/IP, PROFINET, MODBUS or the other RTDE client off, or set `upper_registers: true` in the cell file."
        return ChannelTaken(f"somebody else holds the registers: {text}", remedy=remedy)
    if "remote control" in lower:
        return NotInRemoteControl(text, remedy="Switch the robot to remote control at the pendant (top right).")
    if "timeout" in lower or "start control script" in lower:
        return RobotTimeout(text, remedy=_LOOK)
    if "connect" in lower:
        return LinkLost(text, remedy=_LOOK)
    return MotionRefused(text, remedy=_LOOK)
