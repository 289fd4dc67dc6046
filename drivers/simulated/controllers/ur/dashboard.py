"""The dashboard of the simulated controller: one line asked, one line answered."""

from __future__ import annotations

from collections.abc import Callable

from drivers.simulated.controllers.ur.machine import Machine, RobotMode, Runtime, SafetyMode
from drivers.simulated.controllers.ur.rtde import VERSION

GREETING = "Connected: Universal Robots Dashboard Server"
GOODBYE = "Disconnected"
SERIAL_NUMBER = "20235500123"


def answer(machine: Machine, line: str) -> str:
    """What PolyScope 5.11 says to a line, as far as it is modelled."""
    command = line.strip()
    act = _COMMANDS.get(command.lower())
    if act is not None:
        return act(machine)
    for word, reply in (("load ", "Loading program: "), ("popup ", "showing popup"), ("addtolog ", "Added log message")):
        if command.lower().startswith(word):
            return reply + command[len(word) :] if reply.endswith(": ") else reply
    return f"could not understand: '{command}'"


def _stop(machine: Machine) -> str:
    machine.end_program()
    return "Stopped"


def _play(machine: Machine) -> str:
    if not machine.can_move or machine.program is None:
        return "Failed to execute: play"
    machine.resume()
    return "Starting program"


def _pause(machine: Machine) -> str:
    machine.pause()
    return "Pausing program" if machine.program is not None else "Failed to execute: pause"


def _unlock(machine: Machine) -> str:
    if machine.safety is SafetyMode.PROTECTIVE_STOP:
        machine.safety = SafetyMode.NORMAL
    return "Protective stop releasing"


def _power(mode: RobotMode, reply: str) -> Callable[[Machine], str]:
    def act(machine: Machine) -> str:
        machine.mode = mode
        if mode is not RobotMode.RUNNING:
            machine.end_program()
        return reply

    return act


def _program_state(machine: Machine) -> str:
    name = machine.program.name if machine.program is not None else "<unnamed>"
    return f"{machine.runtime.name} {name}.urp"


_COMMANDS: dict[str, Callable[[Machine], str]] = {
    "polyscopeversion": lambda _: f"URSoftware {'.'.join(map(str, VERSION))} (Oct 13 2021)",
    "version": lambda _: ".".join(map(str, VERSION)),
    "get serial number": lambda _: SERIAL_NUMBER,
    "get robot model": lambda machine: machine.own_model.name.upper().removesuffix("E"),
    "is in remote control": lambda machine: str(machine.remote).lower(),
    "robotmode": lambda machine: f"Robotmode: {machine.mode.name}",
    "safetymode": lambda machine: f"Safetymode: {machine.safety.name}",
    "safetystatus": lambda machine: f"Safetystatus: {machine.safety.name}",
    "running": lambda machine: f"Program running: {str(machine.runtime is Runtime.PLAYING).lower()}",
    "programstate": _program_state,
    "get loaded program": _program_state,
    "stop": _stop,
    "play": _play,
    "pause": _pause,
    "unlock protective stop": _unlock,
    "power on": _power(RobotMode.IDLE, "Powering on"),
    "brake release": _power(RobotMode.RUNNING, "Brake releasing"),
    "power off": _power(RobotMode.POWER_OFF, "Powering off"),
    "close popup": lambda _: "closing popup",
    "close safety popup": lambda _: "closing safety popup",
    "quit": lambda _: GOODBYE,
}
