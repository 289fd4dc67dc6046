"""Any GenICam camera that sends 3D coordinates: GigE Vision through Aravis, anything else through a GenTL producer and harvesters."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drivers.cameras.genicam.camera import GenicamCamera
    from drivers.registry import DriverContext


def make_camera(context: DriverContext) -> GenicamCamera:
    """The camera of a cell file.

    Raises:
        SettingsError: neither `address` nor `producer`, or both; an unknown or wrong setting.
    """
    from drivers.cameras.genicam.camera import GenicamCamera
    from drivers.cameras.genicam.settings import GenicamSettings, transport_of
    from drivers.cameras.settings import parse_settings

    settings = parse_settings(GenicamSettings, context.settings, "genicam")
    return GenicamCamera(transport_of(settings, context.folder), settings)
