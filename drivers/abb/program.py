"""The RAPID program as files for a controller, with the settings of a cell filled in, and its installation page."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal

from drivers.errors import SettingsError
from drivers.files.disk import write_text_atomic

PAGE = "INSTALL.html"
_WHAT = {
    "spherecal.mod": "the program: answers the computer and moves the robot",
    "spherecal_main.mod": "its main",
    "spherecal_tcp.mod": "the line over a socket",
    "spherecal_serial.mod": "the line over a serial port",
    "spherecal_state.mod": "second program: tells motors and stops (optional, needs 623-1)",
    "spherecal_job.mod": "for a program of your own that owns the motion (optional)",
}


@dataclass(frozen=True, slots=True)
class ProgramSettings:
    """What differs from cell to cell."""

    via: Literal["tcp", "serial"] = "tcp"
    address: str = "192.168.125.1"
    port: int = 5000
    com: str = "COM1:"
    baud: int = 38400
    mass_kg: float = 1.0
    pc_address: str = "192.168.125.2"
    pc_port: int = 5005


def module_text(name: str) -> str:
    """A module as it is shipped."""
    return (files("drivers.abb") / name).read_text(encoding="ascii")


def module_names(settings: ProgramSettings) -> tuple[str, ...]:
    """The modules for a kind of line."""
    line = ("spherecal_tcp.mod", "spherecal_state.mod", "spherecal_job.mod") if settings.via == "tcp" else ("spherecal_serial.mod",)
    return ("spherecal.mod", "spherecal_main.mod", *line)


def filled_in(name: str, settings: ProgramSettings) -> str:
    """A module with the settings in its constants.

    Raises:
        SettingsError: an address or port name that RAPID could not hold.
    """
    constants: Mapping[str, str] = {
        "SPH_ADDRESS": _quoted(settings.address, r"[0-9.]{7,15}"),
        "SPH_ADDRESS2": _quoted(settings.address, r"[0-9.]{7,15}"),
        "SPH_PORT": str(settings.port),
        "SPH_PORT2": str(settings.port + 1),
        "SPH_COM": _quoted(settings.com, r"[A-Za-z0-9_]{1,14}:"),
        "SPH_PC_ADDRESS": _quoted(settings.pc_address, r"[0-9.]{7,15}"),
        "SPH_PC_PORT": str(settings.pc_port),
    }
    text = module_text(name)
    for constant, value in constants.items():
        text = re.sub(rf"(CONST \w+ {constant}:=)[^;]*;", lambda match, value=value: f"{match[1]}{value};", text)  # type: ignore[misc]
    return text.replace("],[1,[0,0,50],[1,0,0,0],0,0,0]];", f"],[{settings.mass_kg:g},[0,0,50],[1,0,0,0],0,0,0]];")


def _quoted(text: str, allowed: str) -> str:
    if not re.fullmatch(allowed, text):
        raise SettingsError(f"{text!r} cannot stand in the program", remedy="An address is four numbers with points, a serial port like COM1:.")
    return f'"{text}"'


def write_program(out: Path, settings: ProgramSettings, *, force: bool = False) -> list[tuple[Path, str]]:
    """Write modules and page into a folder; every file with what it is.

    Raises:
        SettingsError: a file is there already and not to be replaced, or a setting that RAPID could not hold.
        FileError: the folder cannot be written.
    """
    texts = {name: (filled_in(name, settings), _WHAT[name]) for name in module_names(settings)}
    texts[PAGE] = (page(settings), "how to install it: print this")
    there = [name for name in texts if (out / name).exists()]
    if there and not force:
        raise SettingsError(f"{there[0]} is there already", file=out, remedy="Name another folder, or replace them with --force.")
    out.mkdir(parents=True, exist_ok=True)
    for name, (text, _) in texts.items():
        write_text_atomic(out / name, text if name == PAGE else text.replace("\n", "\r\n"))
    return [(out / name, what) for name, (_, what) in texts.items()]


def page(settings: ProgramSettings) -> str:
    """The installation page, filled in; what is for the other kind of line is left out."""
    text = (files("drivers.abb") / "install.html").read_text(encoding="utf-8")
    other = "serial" if settings.via == "tcp" else "tcp"
    text = re.sub(rf"<!--{other}-->.*?<!--/{other}-->\n?", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--/?(?:tcp|serial)-->\n?", "", text)
    values = {
        "ADDRESS": settings.address,
        "PORT": str(settings.port),
        "PORT2": str(settings.port + 1),
        "COM": settings.com,
        "BAUD": str(settings.baud),
        "MASS": f"{settings.mass_kg:g}",
        "PC_ADDRESS": settings.pc_address,
        "PC_PORT": str(settings.pc_port),
    }
    for key, value in values.items():
        text = text.replace(f"{{{{{key}}}}}", html.escape(value))
    return text
