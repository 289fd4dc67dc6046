"""The dashboard in pure Python: questions with a deadline, and the stop of last resort. One connection per question."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass

from drivers.errors import RobotError, RobotNotReached, RobotTimeout
from drivers.ur.net import DASHBOARD_PORT, Deadline, connect, receive, send

ASK_S = 0.5
_LONGEST = 1 << 16
_GREETING = "Universal Robots Dashboard Server"


@dataclass(frozen=True, slots=True)
class Identity:
    """What the dashboard tells of the robot."""

    software: str
    model: str
    serial: str
    remote: bool | None
    """Whether programs and clients may command it; None where the software has no such mode (before 5.6)."""
    robot_mode: str
    safety: str
    program: str | None
    """That runs or is held, None where there is none."""


def ask(host: str, *questions: str, deadline: Deadline) -> list[str]:
    """The answers to questions, asked one after the other.

    Raises:
        RobotNotReached: nobody is there, it hangs up, or it is no dashboard.
        RobotTimeout: it says nothing.
    """
    with closing(connect(host, DASHBOARD_PORT, deadline)) as link:
        buffer = bytearray()

        def line() -> str:
            while b"\n" not in buffer:
                buffer.extend(receive(link, deadline))
                if len(buffer) > _LONGEST:
                    raise _no_dashboard(host)
            text, _, rest = bytes(buffer).partition(b"\n")
            buffer[:] = rest
            return text.decode("utf-8", "replace").strip()

        if _GREETING not in line():
            raise _no_dashboard(host)
        answers: list[str] = []
        for question in questions:
            send(link, question.encode() + b"\n", deadline)
            try:
                answers.append(line())
            except RobotTimeout as error:
                if not answers:
                    raise
                found = f"answers too slowly ({len(answers)} of {len(questions)} questions in time)"
                raise RobotTimeout(found, file=error.file, remedy="Is the network overloaded? Use a cable of its own for the robot.") from error
        return answers


def identity(host: str, deadline: Deadline) -> Identity:
    """Who it is; raises as `ask`."""
    questions = ("PolyscopeVersion", "get robot model", "get serial number", "is in remote control", "robotmode", "safetystatus", "programState")
    software, model, serial, remote, mode, safety, program = ask(host, *questions, deadline=deadline)
    return Identity(
        software=software,
        model=_known(model),
        serial=_known(serial),
        remote=_remote(remote),
        robot_mode=mode.removeprefix("Robotmode: "),
        safety=safety.removeprefix("Safetystatus: "),
        program=_program(program),
    )


def in_remote_control(host: str, deadline: Deadline) -> bool | None:
    """Whether it may be commanded from here, None where the software has no such mode; raises as `ask`."""
    return _remote(ask(host, "is in remote control", deadline=deadline)[0])


def running_program(host: str, deadline: Deadline) -> str | None:
    """The program that runs or is held, None where there is none; raises as `ask`."""
    return _program(ask(host, "programState", deadline=deadline)[0])


def end_program(host: str, deadline: Deadline) -> None:
    """Stop whatever program runs, and so every motion that it makes; raises as `ask`."""
    ask(host, "stop", deadline=deadline)


def answers(host: str) -> bool:
    """Whether the dashboard says anything within half a second."""
    try:
        ask(host, "robotmode", deadline=Deadline.after(ASK_S))
    except RobotError:
        return False
    return True


def _remote(text: str) -> bool | None:
    return {"true": True, "false": False}.get(text.strip().lower())


def _program(text: str) -> str | None:
    state, _, name = _known(text).partition(" ")
    return None if state.upper() in ("STOPPED", "") else name or state


def _known(text: str) -> str:
    return "" if "could not understand" in text.lower() else text


def _no_dashboard(host: str) -> RobotNotReached:
    place = f"{host}:{DASHBOARD_PORT}"
    return RobotNotReached("what answers is no UR dashboard", file=place, remedy="Is this a UR controller with PolyScope 3 or 5?")
