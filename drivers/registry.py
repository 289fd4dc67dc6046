"""Which drivers there are, and how a cell's two devices are made from their settings.

Built-in drivers are imported only when a cell names them. Third parties add theirs by entry points: a function that
takes a `DriverContext` and returns a `Robot` (group `spherecal.robots`) or a `Camera3D` (group `spherecal.cameras`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import cast

from drivers.errors import SettingsError
from drivers.kinematics.mdh import RobotModel
from drivers.protocols import Camera3D, Devices, Robot

ROBOT_GROUP = "spherecal.robots"
CAMERA_GROUP = "spherecal.cameras"

_BUILT_IN: dict[str, dict[str, str]] = {
    ROBOT_GROUP: {
        "simulated": "drivers.simulated:make_robot",
        "recorded": "drivers.recorded:make_robot",
        "ur_rtde": "drivers.ur_rtde:make_robot",
        "abb_socket": "drivers.abb:make_robot",
    },
    CAMERA_GROUP: {
        "simulated": "drivers.simulated:make_camera",
        "recorded": "drivers.recorded:make_camera",
        "folder": "drivers.cameras.folder:make_camera",
        "genicam": "drivers.cameras.genicam:make_camera",
        "realsense": "drivers.cameras.realsense:make_camera",
        "mech_eye": "drivers.cameras.mech_eye:make_camera",
        "photoneo": "drivers.cameras.photoneo:make_camera",
        "zivid": "drivers.cameras.zivid:make_camera",
    },
}

HARDWARE_LOGS: Mapping[str, str] = {}
"""The signed hardware log of each driver that has one, a page under docs/. None has: see docs/add_a_robot.md."""

_NO_HARDWARE = frozenset({"simulated", "recorded"})


def untried_drivers(*drivers: str) -> tuple[str, ...]:
    """Those of the drivers whose work on hardware nobody has signed for; simulations and replays need none."""
    return tuple(sorted({name for name in drivers if name not in HARDWARE_LOGS and name not in _NO_HARDWARE}))


def hardware_remark(driver: str) -> str:
    """What every report says of an untried driver."""
    if driver in _BUILT_IN[ROBOT_GROUP] or driver in _BUILT_IN[CAMERA_GROUP]:
        return f"The driver {driver} has never run on hardware: no signed hardware log is in its documentation."
    return f"The driver {driver} is none of spherecal's own: whether it has ever run on hardware is not known here."


@dataclass(frozen=True, slots=True)
class DriverContext:
    """What a driver's factory is given."""

    settings: Mapping[str, object]
    """The driver's own keys of the cell file; unknown ones are the driver's to refuse."""
    robot_model: RobotModel | None
    folder: Path
    """Where relative paths in the settings start."""
    shared: dict[str, object] = field(default_factory=dict)
    """One for robot and camera of a cell, so that e.g. both come from one simulated cell."""


def driver_names(group: str) -> tuple[str, ...]:
    """The drivers of a group, built-in ones first."""
    others = sorted(entry.name for entry in entry_points(group=group) if entry.name not in _BUILT_IN[group])
    return (*_BUILT_IN[group], *others)


def make_devices(
    *,
    robot_driver: str,
    robot_settings: Mapping[str, object],
    camera_driver: str,
    camera_settings: Mapping[str, object],
    robot_model: RobotModel | None,
    folder: Path,
) -> Devices:
    """Robot and camera of one cell, made but not opened.

    Raises:
        SettingsError: an unknown driver, one that cannot be loaded, or settings that it does not take.
        FileError: a file named in the settings is missing or broken.
    """
    shared: dict[str, object] = {}
    robot_factory = _factory(ROBOT_GROUP, robot_driver)
    camera_factory = _factory(CAMERA_GROUP, camera_driver)
    robot = robot_factory(DriverContext(robot_settings, robot_model, folder, shared))
    camera = camera_factory(DriverContext(camera_settings, robot_model, folder, shared))
    return Devices(cast(Robot, robot), cast(Camera3D, camera))


def _factory(group: str, name: str) -> Callable[[DriverContext], object]:
    try:
        if name in _BUILT_IN[group]:
            module, function = _BUILT_IN[group][name].split(":")
            return cast(Callable[[DriverContext], object], getattr(import_module(module), function))
        found = [entry for entry in entry_points(group=group) if entry.name == name]
        if found:
            return cast(Callable[[DriverContext], object], found[0].load())
    except (ImportError, AttributeError) as error:
        raise SettingsError(f"the driver {name!r} cannot be loaded ({error})", remedy="Install what it needs.") from error
    what = "robot" if group == ROBOT_GROUP else "camera"
    raise SettingsError(f"there is no {what} driver {name!r}", where=f"{what}.driver", remedy=f"Choose one of {', '.join(driver_names(group))}.")
