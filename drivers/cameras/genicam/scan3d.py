"""What a GenICam camera says of its coordinates (SFNC, Scan3dControl), and what of it would spoil a calibration."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

UNITS_MM = {"Millimeter": 1.0, "Inch": 25.4, "Meter": 1000.0, "Micrometer": 0.001}
POINT_MODES = ("CalibratedABC_Grid", "CalibratedABC_PointCloud")
DEPTH_MODES = ("CalibratedC", "RectifiedC", "ProjectedC")
AXES = ("A", "B", "C")

Get = Callable[[str], str | None]
Set = Callable[[str, str], None]


@dataclass(frozen=True, slots=True)
class Coordinate:
    """How one axis is coded: coordinate = sent * scale + offset; a sent value that marks a hole."""

    scale: float = 1.0
    offset: float = 0.0
    invalid: float | None = None


@dataclass(frozen=True, slots=True)
class Pinhole:
    """Lines of sight of a depth map: x = (u - principal_u) z / focal, y = (v - principal_v) z / (focal aspect); pixels."""

    focal_px: float
    principal_u_px: float
    principal_v_px: float
    aspect: float = 1.0


@dataclass(frozen=True, slots=True)
class Scan3d:
    """What is needed to make points of what is sent."""

    unit: str = "Millimeter"
    output_mode: str = "CalibratedABC_Grid"
    coordinate_system: str = "Cartesian"
    reference: str = "Anchor"
    a: Coordinate = field(default_factory=Coordinate)
    b: Coordinate = field(default_factory=Coordinate)
    c: Coordinate = field(default_factory=Coordinate)
    pinhole: Pinhole | None = None

    @property
    def unit_mm(self) -> float:
        """The unit in mm; `problems` tells where there is none."""
        return UNITS_MM[self.unit]


def read_scan3d(get: Get, put: Set) -> Scan3d:
    """The description of the camera's range component; what it does not tell is as the standard's default.

    Args:
        get: the value of a feature, None where it is absent or cannot be read.
        put: sets a selector.
    """
    if get("ComponentSelector") is not None:
        with suppress(ValueError):
            put("ComponentSelector", "Range")
    default = Scan3d()
    coordinates = {axis: _coordinate(get, put, axis) for axis in AXES}
    return Scan3d(
        unit=get("Scan3dDistanceUnit") or default.unit,
        output_mode=get("Scan3dOutputMode") or default.output_mode,
        coordinate_system=get("Scan3dCoordinateSystem") or default.coordinate_system,
        reference=get("Scan3dCoordinateSystemReference") or default.reference,
        a=coordinates["A"],
        b=coordinates["B"],
        c=coordinates["C"],
        pinhole=_pinhole(get),
    )


def _coordinate(get: Get, put: Set, axis: str) -> Coordinate:
    if get("Scan3dCoordinateSelector") is not None:
        put("Scan3dCoordinateSelector", f"Coordinate{axis}")
    scale, offset, value = (_number(get(f"Scan3d{name}")) for name in ("CoordinateScale", "CoordinateOffset", "InvalidDataValue"))
    marks_holes = (get("Scan3dInvalidDataFlag") or "").lower() in {"true", "1"}
    return Coordinate(1.0 if scale is None else scale, offset or 0.0, value if marks_holes else None)


def _pinhole(get: Get) -> Pinhole | None:
    focal, u, v, aspect = (_number(get(f"Scan3d{name}")) for name in ("FocalLength", "PrincipalPointU", "PrincipalPointV", "AspectRatio"))
    return None if not focal or u is None or v is None else Pinhole(focal, u, v, aspect or 1.0)


def device_temperatures_c(get: Get) -> dict[str, float]:
    """The camera's temperature under the name of the sensor that is selected (`device` where there is one only); {} where it tells none.

    The selector is left alone: writing it for every frame costs more than the other sensors tell.
    """
    value = _number(get("DeviceTemperature"))
    if value is None or not math.isfinite(value):
        return {}
    return {(get("DeviceTemperatureSelector") or "device").lower(): value}


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None


def problems(scan3d: Scan3d) -> list[str]:
    """What would spoil a calibration, each with what to set."""
    found = []
    if scan3d.unit not in UNITS_MM:
        found.append(f"its distance unit is {scan3d.unit}. Set Scan3dDistanceUnit to Millimeter.")
    if scan3d.coordinate_system != "Cartesian":
        found.append(f"its coordinates are {scan3d.coordinate_system}. Set Scan3dCoordinateSystem to Cartesian.")
    if scan3d.reference != "Anchor":
        remedy = "Set Scan3dCoordinateSystemReference to Anchor, the camera's own frame."
        found.append(f"a transform is active (reference {scan3d.reference}). {remedy}")
    if scan3d.output_mode not in (*POINT_MODES, *DEPTH_MODES):
        found.append(f"its output mode is {scan3d.output_mode}. Set Scan3dOutputMode to CalibratedABC_Grid.")
    if scan3d.output_mode in DEPTH_MODES and scan3d.pinhole is None:
        found.append(f"its output mode {scan3d.output_mode} tells no lines of sight. Set Scan3dOutputMode to CalibratedABC_Grid.")
    if not all(coordinate.scale > 0 for coordinate in (scan3d.a, scan3d.b, scan3d.c)):
        found.append("a coordinate scale is not positive. Load the factory's user set.")
    return found
