"""How the simulated UR controller misbehaves, and what a person does at it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drivers.simulated.controllers.ur.machine import Machine, RobotMode, SafetyMode
from drivers.simulated.controllers.ur.program import ForeignProgram

WIRE_FAULTS = {
    "refuse": "connections are refused, open ones are cut",
    "black_hole": "connections are neither accepted nor refused, as from an unplugged robot; open ones fall silent",
    "silence": "connections are accepted, nothing is sent any more",
    "half_packets": "half a package comes, then nothing",
    "fragments": "every package comes in two pieces",
    "garbage": "packages hold random values: no numbers, impossible angles, modes that there are not",
    "noise": "random bytes come instead of packages",
    "drop": "all RTDE connections are cut now; the robot goes on",
    "drop_commanding": "the RTDE connections that write inputs are cut, those that read stay",
    "drop_mid_move": "all of them, 0.1 s after the next motion has begun",
    "drop_at_command": "the same, as soon as the next motion begins: the command is carried out and never confirmed",
    "slow": "seconds that every answer waits and that lie between readings, 0.3 by default",
    "lag": "seconds that everything is late, 0.2 by default",
    "stale": "readings come, all with the same old timestamp",
    "registers_taken": "a fieldbus holds the input registers",
    "restart": "seconds that the controller is away, 0.5 by default; it comes back with the motors off",
}
"""Faults of the line; `clear` ends them."""

BUTTONS = {
    "protective_stop": "protective stop: program and motion are held",
    "safeguard_stop": "a door: the same",
    "emergency_stop": "emergency stop: the program ends, motors off",
    "safety_fault": "the safety system has a fault",
    "local": "local control at the pendant",
    "remote": "remote control",
    "power_off": "motors off",
    "pendant_stop": "the stop button: the program ends",
    "pendant_pause": "the pause button: program and motion are held",
    "pendant_play": "the play button: a held motion goes on to its old target",
    "foreign_program": "somebody starts a program of his own",
    "push": "in freedrive: lead the arm to six axis angles",
    "tool": "x y z rx ry rz (m, rad) of another active tool",
    "mend": "what `clear` does besides the line: stops reset, motors on, remote control, and play is pressed",
}
"""What a person does at the controller."""

_HAND_RAD_S = 2.0


@dataclass(slots=True)
class LineState:
    """How bytes leave the controller."""

    silent: bool = False
    fragments: bool = False
    half: bool = False
    """The next data package is cut in half, then all is silent."""
    stale: bool = False
    garbage: bool = False
    noise: bool = False
    slow_s: float = 0.0
    lag_s: float = 0.0
    drop_after_s: float | None = None
    """Seconds from the beginning of the next motion to a cut of the line."""


def press(machine: Machine, name: str, numbers: list[float]) -> None:
    """Do what a person would.

    Raises:
        ValueError: no such button, or not the numbers it needs.
    """
    if name not in BUTTONS:
        msg = f"no fault {name!r}; there are {', '.join((*WIRE_FAULTS, *BUTTONS))}"
        raise ValueError(msg)
    _ACTIONS[name](machine, numbers)


def _held(safety: SafetyMode) -> Callable[[Machine, list[float]], None]:
    def act(machine: Machine, _: list[float]) -> None:
        machine.pause()
        machine.safety = safety

    return act


def _ended(safety: SafetyMode) -> Callable[[Machine, list[float]], None]:
    def act(machine: Machine, _: list[float]) -> None:
        machine.end_program()
        machine.safety, machine.mode = safety, RobotMode.POWER_OFF

    return act


def _power_off(machine: Machine, _: list[float]) -> None:
    machine.end_program()
    machine.mode = RobotMode.POWER_OFF


def _remote(on: bool) -> Callable[[Machine, list[float]], None]:
    def act(machine: Machine, _: list[float]) -> None:
        machine.remote = on

    return act


def _push(machine: Machine, numbers: list[float]) -> None:
    import numpy as np

    if not machine.freedrive or len(numbers) != machine.own_model.n_joints:
        msg = "the arm is not in freedrive, or not an angle for each axis"
        raise ValueError(msg)
    machine.start_motion(np.array(numbers), _HAND_RAD_S)


def _tool(machine: Machine, numbers: list[float]) -> None:
    import numpy as np

    from drivers.simulated.controllers.ur.machine import pose_transform

    if len(numbers) != 6:
        msg = "a tool has six numbers: x y z in m, rx ry rz in rad"
        raise ValueError(msg)
    machine.flange_from_tcp = pose_transform(np.array(numbers))


def _mend(machine: Machine, _: list[float]) -> None:
    machine.safety, machine.mode, machine.remote = SafetyMode.NORMAL, RobotMode.RUNNING, True
    if isinstance(machine.program, ForeignProgram):
        machine.end_program()
    machine.resume()


_ACTIONS: dict[str, Callable[[Machine, list[float]], None]] = {
    "protective_stop": _held(SafetyMode.PROTECTIVE_STOP),
    "safeguard_stop": _held(SafetyMode.SAFEGUARD_STOP),
    "emergency_stop": _ended(SafetyMode.ROBOT_EMERGENCY_STOP),
    "safety_fault": _ended(SafetyMode.FAULT),
    "local": _remote(False),
    "remote": _remote(True),
    "power_off": _power_off,
    "pendant_stop": lambda machine, _: machine.end_program(),
    "pendant_pause": lambda machine, _: machine.pause(),
    "pendant_play": lambda machine, _: machine.resume(),
    "foreign_program": lambda machine, _: machine.run(ForeignProgram("production")),
    "push": _push,
    "tool": _tool,
    "mend": _mend,
}
