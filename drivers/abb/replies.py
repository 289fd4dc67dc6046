"""From replies of the line protocol to what the rest of spherecal understands: states, poses, refusals."""

from __future__ import annotations

import re

import numpy as np

from drivers.abb.line import Refusal, Reply, is_fault
from drivers.abb.protocol import FASTEST_DEG_S, BadLine, Fault, StateReply, numbers
from drivers.errors import MotionRefused, MotorsOff
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import Mode, RobotState, Safety
from drivers.readings import check_safety

_MODES = {"A": Mode.AUTOMATIC, "R": Mode.MANUAL, "F": Mode.MANUAL, "U": Mode.UNKNOWN}
# without the second program `-`: the program that answers runs, so no stop holds it
_STOPS = {"N": Safety.NORMAL, "E": Safety.EMERGENCY_STOP, "G": Safety.SAFEGUARD_STOP, "P": Safety.PROTECTIVE_STOP, "-": Safety.NORMAL}
_MOTORS = {"1": True, "0": False, "-": None}
_REFUSED = {
    Fault.EPOCH: "Its program was started anew since the robot was opened: open it again.",
    Fault.EXPIRED: "The line was silent between target and start: try again.",
    Fault.BUSY: "A motion is under way: wait for its end, or stop it.",
    Fault.SPEED: f"The program allows up to {FASTEST_DEG_S:g} degrees/s.",
    Fault.NOT_READY: "See the FlexPendant: motors on, no stop, program running.",
}

def refused(error: Refusal) -> MotionRefused:
    """The refusal of a motion, with what to do about it."""
    remedy = next((text for fault, text in _REFUSED.items() if is_fault(error, fault)), "See docs/abb_protocol.md for its error numbers.")
    return MotionRefused(error.message, remedy=remedy)


def check_free(state: RobotState) -> None:
    """Nothing, if the robot may move.

    Raises:
        SafetyStop: a stop is active.
        MotorsOff: the drives have no power.
    """
    check_safety(state)
    if state.motors_on is False:
        raise MotorsOff("the motors are off", remedy="Switch them on at the controller and start the program, then continue with --resume.")


def robot_state(state: StateReply, reply: Reply, pose: FloatArray | None, reason: str | None) -> RobotState:
    """A reading; its pose and the reason of an interruption are given beside it."""
    return RobotState(
        joints_rad=np.radians(np.array(state.joints_deg)),
        base_from_flange=pose,
        time_s=reply.asked_s,
        moving=state.motion == "M" and not _STOPS[state.stop].stops_motion,
        safety=_STOPS[state.stop],
        mode=_MODES[state.mode],
        age_s=reply.age_s,
        motors_on=_MOTORS[state.motors],
        reason=reason,
        active_tool="tool0",
        active_work_object="wobj0",
    )


def pose_of(reply: Reply) -> FloatArray:
    """(4, 4) of a `P` reply.

    Raises:
        BadLine: not seven numbers, or no unit quaternion.
    """
    values = np.array(numbers(reply.line.arguments, 7))
    norm = float(np.linalg.norm(values[3:]))
    if not abs(norm - 1.0) < 1e-3:
        raise BadLine(f"a quaternion of length {norm:.4g}", remedy="Do both sides speak the same version?")
    w, vector = values[3] / norm, se3.hat(values[4:] / norm)
    return se3.from_rotation_translation(np.eye(3) + 2 * w * vector + 2 * vector @ vector, values[:3])


def two_words(arguments: tuple[str, ...]) -> tuple[str, str]:
    """The two words of a `W` reply; ValueError for any other count."""
    first, second = arguments
    return first, second




def type_notes(kind: str | None, model_name: str) -> tuple[str, ...]:
    """What is to be said when the controller's robot type ("IRB 1410-5/1.44") has another number than the model's name."""
    told, believed = re.search(r"IRB\W*([0-9]+)", kind or "", re.IGNORECASE), re.search(r"irb_?([0-9]+)", model_name, re.IGNORECASE)
    if told is None or believed is None or told[1] == believed[1]:
        return ()
    return (f"the controller says that it is an {kind}, the cell's model is {model_name}",)
