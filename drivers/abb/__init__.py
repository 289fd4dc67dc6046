"""ABB IRC5 controllers through a RAPID program of our own, over a socket or a serial line (docs/abb.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drivers.protocols import Robot
    from drivers.registry import DriverContext


def make_robot(context: DriverContext) -> Robot:
    """The robot of a cell file with `driver: abb_socket`; settings as in `drivers.abb.settings.SETTINGS`.

    Raises:
        SettingsError: neither `host` nor `serial_port`, an unknown or wrong setting.
    """
    from drivers.abb.adapter import AbbRobot
    from drivers.abb.settings import parse_settings

    return AbbRobot(parse_settings(context.settings), context.robot_model)
