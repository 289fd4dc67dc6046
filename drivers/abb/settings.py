"""The settings of the driver `abb_socket`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from drivers.errors import SettingsError
from drivers.transport import Link, SerialLink, TcpLink

SLOWEST_BAUD = 19200

SETTINGS = {
    "host": "address of the controller, e.g. 192.168.125.1; this or serial_port",
    "port": "port of the program (default 5000)",
    "serial_port": "serial port of this computer, e.g. /dev/ttyUSB0; this or host",
    "baud": f"speed of the serial line, {SLOWEST_BAUD} or more (default 38400)",
    "state_port": "port of the second program spherecal_state.mod (needs 623-1 Multitasking); none by default",
    "tool": "name of the tool that the program uses, if it is another than tool0 or sphTool",
    "work_object": "name of the work object, if it is another than wobj0",
    "flange_pose": "true (default): read the flange pose while the robot stands, as a cross-check; false: axis angles only",
    "watchdog_s": "1 to 30 (default 3): the program stops a motion when it hears nothing for so long",
}


@dataclass(frozen=True, slots=True)
class AbbSettings:
    """Where the controller is and what is expected of it."""

    host: str | None = None
    port: int = 5000
    serial_port: str | None = None
    baud: int = 38400
    state_port: int | None = None
    tool: str | None = None
    work_object: str | None = None
    flange_pose: bool = True
    watchdog_s: float = 3.0

    def link(self) -> Link:
        """The way to the program that moves the robot."""
        return SerialLink(self.serial_port, self.baud) if self.serial_port is not None else TcpLink(str(self.host), self.port)

    def state_link(self) -> Link | None:
        """The way to the program that tells motors and stops, where there is one."""
        return None if self.state_port is None or self.host is None else TcpLink(self.host, self.state_port)


def parse_settings(settings: Mapping[str, object]) -> AbbSettings:
    """Check the driver's keys of a cell file.

    Raises:
        SettingsError: neither `host` nor `serial_port`, or both; an unknown or wrong setting.
    """
    for key, value in settings.items():
        if key not in SETTINGS:
            raise SettingsError(f"unknown setting {key!r} of the driver abb_socket", where=f"robot.{key}", remedy=f"Allowed: {', '.join(SETTINGS)}.")
        if not _fits(key, value):
            raise SettingsError(f"{value!r} is not allowed", where=f"robot.{key}", remedy=f"{key}: {SETTINGS[key]}.")
    if ("host" in settings) == ("serial_port" in settings):
        remedy = "Give the controller's address as `host: 192.168.125.1`, or `serial_port: /dev/ttyUSB0`."
        raise SettingsError("needs exactly one of host and serial_port", where="robot (driver abb_socket)", remedy=remedy)
    return AbbSettings(**dict(settings))  # type: ignore[arg-type]


def _fits(key: str, value: object) -> bool:
    if key in {"host", "serial_port", "tool", "work_object"}:
        return isinstance(value, str) and bool(value.strip())
    if key == "flange_pose":
        return isinstance(value, bool)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    if key == "watchdog_s":
        return 1 <= value <= 30
    if key == "baud":
        return isinstance(value, int) and SLOWEST_BAUD <= value <= 115200
    return isinstance(value, int) and 1 <= value <= 65535
