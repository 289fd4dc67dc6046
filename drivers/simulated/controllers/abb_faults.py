"""How the simulated IRC5 misbehaves, and the buttons that an operator would press."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.simulated.controllers.abb_program import AbbProgram

WIRE_FAULTS = {
    "refuse": "no program listens: connections are refused, the open one is cut",
    "black_hole": "connections are neither accepted nor refused, as from an unplugged robot; the open one falls silent",
    "silence": "connections are accepted, nothing is answered",
    "half_lines": "only the first half of every reply comes",
    "two_halves": "every reply comes in two pieces",
    "garbage": "bytes that are no reply",
    "wrong_checksum": "replies with a wrong checksum; with a number: so many of them",
    "lost_replies": "requests are carried out and not answered; with a number: so many of them",
    "doubled_replies": "every reply comes twice",
    "slow": "seconds that every reply waits, 0.02 by default",
    "stale": "readings that are 80 ms old when they come",
    "drop": "the connection is cut now",
    "drop_mid_move": "the connection is cut 0.2 s after the next motion has begun",
}
"""Faults of the line; `clear` ends them."""

BUTTONS = {
    "emergency_stop": "emergency stop: motors off, the program is held, mid-move too",
    "guard_stop": "a door: the program is held",
    "protective_stop": "motion supervision: the program is held",
    "stop_button": "the stop button: the program is held, motors stay on",
    "start_button": "reset the stop, motors on, start: the program goes on where it was held",
    "restart": "program pointer to main, and start: a new epoch",
    "manual": "manual reduced speed",
    "automatic": "automatic",
}
"""What a person does at the controller."""

_LETTERS = {"emergency_stop": ("E", False), "guard_stop": ("G", False), "protective_stop": ("P", True), "stop_button": ("N", True)}


@dataclass(slots=True)
class WireFault:
    """The fault in force on the line."""

    name: str | None = None
    left: int = -1
    """How many replies it still spoils; negative: all."""
    seconds: float = 0.02

    def set(self, name: str, argument: str | None) -> None:
        """Put a fault in force.

        Raises:
            ValueError: no such fault, or an argument that is no number.
        """
        if name not in WIRE_FAULTS:
            msg = f"no fault {name!r}; there are {', '.join((*WIRE_FAULTS, *BUTTONS))}"
            raise ValueError(msg)
        self.name, self.left = name, -1
        if name == "slow":
            self.seconds = float(argument) if argument else 0.02
        elif argument:
            self.left = int(argument)

    def take(self, name: str) -> bool:
        """Whether this fault spoils the reply in hand."""
        if self.name != name or self.left == 0:
            return False
        self.left -= self.left > 0
        return True

    def clear(self) -> None:
        """No fault any more."""
        self.name, self.left = None, -1


def press(program: AbbProgram, button: str) -> None:
    """Press a button of `BUTTONS`."""
    if button in _LETTERS:
        letter, motors_on = _LETTERS[button]
        program.hold(letter, motors_on=motors_on)
    elif button == "start_button":
        program.press_start()
    elif button == "restart":
        program.pp_to_main()
    else:
        program.mode = "R" if button == "manual" else "A"
