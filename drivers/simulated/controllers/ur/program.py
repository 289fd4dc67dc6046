"""The programs of the simulated UR controller: ur_rtde's control script, as far as its registers show, and foreign ones.

Handshake, one pass per controller cycle: the script writes 1 (ready) to output integer 0; the client writes a command
number to input integer 0; the script does it and writes 2 (done); the client writes 0; the script writes 1.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from drivers.kinematics import mdh
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.controllers.ur.machine import Machine, pose_transform, pose_vector

_READY, _DONE = 1, 2
_STOP_SCRIPT = 255
# a new script must not read the command that stopped the one before it
_START_DELAY_S = 0.03
_FINISHED = 0x7FFF
_STEADY_RAD_S = 1e-3

class ForeignProgram:
    """Somebody's production program: it runs until it is stopped."""

    def __init__(self, name: str) -> None:
        self.name = name

    def cycle(self, machine: Machine) -> bool:
        """Nothing that could be seen."""
        del machine
        return True


class ControlScript:
    """ur_rtde's control script.

    Args:
        machine: the controller that it runs on.
        offset: first register that it uses, 0 or 24.
    """

    name = "rtde_control"

    def __init__(self, machine: Machine, offset: int = 0) -> None:
        self._machine, self._offset = machine, offset
        self._ready_at_s = machine.timestamp_s + _START_DELAY_S
        self._moves = self._executing = False
        self._operation = self._changes = 0
        self._running = False
        self._write_int(0, 0)
        self._write_async(_FINISHED)

    def cycle(self, machine: Machine) -> bool:
        """One pass of the main loop."""
        if machine.timestamp_s < self._ready_at_s:
            return True
        if self._running and not machine.cell.moving():
            self._end_async()
        if self._moves:
            if not machine.cell.moving():
                self._moves = False
                self._write_int(0, _DONE)
            return True
        command = machine.in_int(self._offset)
        if command == 0:
            self._executing = False
            self._write_int(0, _READY)
        elif not self._executing:
            if command == _STOP_SCRIPT:
                return False
            self._executing = True
            self._begin(command)
        return True

    def _begin(self, command: int) -> None:
        """Start a command; one that the script does not know is done at once."""
        action = self._actions().get(command)
        if action is not None:
            action()
        else:
            self._machine.messages.append(f"control script: command {command} is not simulated")
        if not self._moves:
            self._write_int(0, _DONE)

    def _actions(self) -> dict[int, Callable[[], None]]:
        """What the command numbers of ur_rtde's rtde.h do."""
        return {
            1: self._move_j,
            17: lambda: None,  # setPayload
            18: lambda: self._set_freedrive(True),
            19: lambda: self._set_freedrive(False),
            29: self._set_tcp,
            33: self._stop,
            34: self._stop,
            35: self._set_watchdog,
            37: self._joints_within_limits,
            40: self._tcp_offset,
            43: self._forward_kinematics_default,
            44: self._forward_kinematics,
            47: self._is_steady,
            52: lambda: self._set_freedrive(True),
            53: lambda: self._set_freedrive(False),
            54: lambda: self._write_int(1, int(self._machine.freedrive)),
        }

    def _move_j(self) -> None:
        target, speed_rad_s = self._doubles(0, 6), float(self._doubles(6, 1)[0])
        asynchronous = self._machine.in_int(self._offset + 1) == 1
        self._machine.start_motion(target, speed_rad_s)
        if asynchronous:
            self._operation = (self._operation + 1) % 128
            self._running = True
            self._write_async(0)
        else:
            self._moves = True

    def _stop(self) -> None:
        self._machine.cell.stop_motion()
        if self._running:
            self._end_async()

    def _end_async(self) -> None:
        self._running = False
        self._write_async(_FINISHED)

    def _set_freedrive(self, on: bool) -> None:
        self._machine.freedrive = on

    def _set_watchdog(self) -> None:
        frequency_hz = float(self._doubles(0, 1)[0])
        self._machine.watch(f"input_int_register_{self._offset}", 1 / frequency_hz)

    def _set_tcp(self) -> None:
        self._machine.flange_from_tcp = pose_transform(self._doubles(0, 6))

    def _tcp_offset(self) -> None:
        self._write_doubles(pose_vector(self._machine.flange_from_tcp))

    def _forward_kinematics(self) -> None:
        # with no tool given the real script, too, takes whatever an earlier command has left in registers 6 to 11
        flange = mdh.base_from_flange(self._machine.own_model, self._doubles(0, 6))
        self._write_doubles(pose_vector(flange @ pose_transform(self._doubles(6, 6))))

    def _forward_kinematics_default(self) -> None:
        self._write_doubles(self._machine.tcp_pose())

    def _joints_within_limits(self) -> None:
        self._write_int(1, int(mdh.within_limits(self._machine.own_model, self._doubles(0, 6))))

    def _is_steady(self) -> None:
        self._write_int(1, int(float(np.abs(self._machine.speeds_rad_s).max()) < _STEADY_RAD_S))

    def _doubles(self, first: int, count: int) -> FloatArray:
        return self._machine.in_doubles(self._offset + first, count)

    def _write_int(self, register: int, value: int) -> None:
        self._machine.outputs[f"output_int_register_{self._offset + register}"] = value

    def _write_doubles(self, values: tuple[float, ...]) -> None:
        for i, value in enumerate(values):
            self._machine.outputs[f"output_double_register_{self._offset + i}"] = value

    def _write_async(self, progress: int) -> None:
        self._changes = (self._changes + 1) % 128
        self._write_int(2, self._operation << 24 | self._changes << 16 | int(self._running) << 15 | progress)


def program_of(text: str, machine: Machine) -> ControlScript | ForeignProgram:
    """The program that a script text is, by its name."""
    head = text[text.index("def ") + 4 :].split("(", maxsplit=1)[0].strip() if "def " in text else "unnamed"
    if head != ControlScript.name:
        return ForeignProgram(head)
    return ControlScript(machine, _register_offset(text))


def _register_offset(text: str) -> int:
    """The number that ur_rtde writes after its mark; 24 where the upper registers are used."""
    found = re.search(r"# int register offset\n\s*(\d+)", text)
    return int(found[1]) if found else 0
