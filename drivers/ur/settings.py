"""What a cell file says of a UR, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from drivers.errors import SettingsError

SETTINGS = {
    "host": "the controller's IP address or name",
    "acceleration_rad_s2": "of the leading axis, above 0 to 10 (default 1.0)",
    "frequency_hz": "how often it sends a reading, 50 to 500 (default 125)",
    "upper_registers": "true: use registers 24 and up, where a fieldbus holds the lower ones (default false)",
}
_UPLOAD_SCRIPT, _UPPER_REGISTERS, _NO_FORCE_TORQUE = 0x01, 0x08, 0x40


@dataclass(frozen=True, slots=True)
class UrSettings:
    """What a cell file says of a UR."""

    host: str
    acceleration_rad_s2: float = 1.0
    frequency_hz: float = 125.0
    upper_registers: bool = False

    @property
    def flags(self) -> int:
        """For ur_rtde's control client; the external force input is not ours to claim."""
        return _UPLOAD_SCRIPT | _NO_FORCE_TORQUE | (_UPPER_REGISTERS if self.upper_registers else 0)


def ur_settings(settings: Mapping[str, object]) -> UrSettings:
    """The settings, checked.

    Raises:
        SettingsError: `host` is missing, or another key or value is not allowed.
    """
    for key in settings:
        if key not in SETTINGS:
            raise SettingsError(f"unknown key {key!r}", where="robot (driver ur_rtde)", remedy=f"Allowed: {', '.join(SETTINGS)}.")
    host = settings.get("host")
    if not isinstance(host, str) or not host:
        remedy = "Add `host: 192.168.0.10` to the cell file."
        raise SettingsError("the controller's address is missing", where="robot (driver ur_rtde)", remedy=remedy)
    return UrSettings(
        host,
        acceleration_rad_s2=_number(settings, "acceleration_rad_s2", 1.0, 1e-3, 10.0),
        frequency_hz=_number(settings, "frequency_hz", 125.0, 50.0, 500.0),
        upper_registers=_flag(settings, "upper_registers"),
    )


def _number(settings: Mapping[str, object], key: str, default: float, low: float, high: float) -> float:
    value = settings.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise SettingsError(f"{value!r} is not allowed", where=f"robot.{key}", remedy=f"{key}: {SETTINGS[key]}.")
    return float(value)


def _flag(settings: Mapping[str, object], key: str) -> bool:
    value = settings.get(key, False)
    if not isinstance(value, bool):
        raise SettingsError(f"{value!r} is not allowed", where=f"robot.{key}", remedy=f"{key}: {SETTINGS[key]}.")
    return value
