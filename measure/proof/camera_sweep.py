"""A sweep of the sphere through the view of a live camera: nothing is moved by us, pictures are taken and kept.

A picture is kept when the sphere is in it, stands still between two exposures, and is at a place not seen yet.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from acquire.cell import Cell
from acquire.exposure import Exposure, expose
from acquire.session import SessionWriter
from acquire.sphere import SphereNotFound, find_sphere
from drivers.errors import InvalidFrame
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import Devices, Frame3D

_FRAME_TIMEOUT_S = 10.0


@dataclass(frozen=True, slots=True)
class SweepSettings:
    """How a sweep goes."""

    n_places: int = 20
    apart_mm: float = 15.0
    """A place nearer to one that was kept is not new."""
    still_mm: float = 0.3
    """A sphere that moved by more between two exposures is still in somebody's hand."""
    every_s: float = 1.0
    give_up_s: float = 600.0


def sweep(devices: Devices, cell: Cell, sphere: str, writer: SessionWriter, settings: SweepSettings, tell: Callable[[str], None]) -> int:
    """Take pictures until enough places were kept, or the time is over; returns how many were.

    Args:
        devices: robot and camera, opened; the robot is only read.
        cell: for the sphere's size.
        sphere: its name.
        writer: where the pictures go.
        settings: how many, how far apart.
        tell: called with a line for the operator after every picture.

    Raises:
        CameraError, RobotNotReached: as the devices do.
        FileError: the session cannot be written.
    """
    kept: list[FloatArray] = []
    waited, after = 0.0, -1
    while len(kept) < settings.n_places and waited < settings.give_up_s:
        frames: list[Frame3D] = []
        for _ in range(2):
            # a frame without a point is a camera that looks into the air, and somebody on the way with the sphere
            with suppress(InvalidFrame):
                frames.append(expose(devices.camera, Exposure(), after=after, timeout_s=_FRAME_TIMEOUT_S).frames[-1])
                after = frames[-1].sequence
        centres = [_centre(frame, cell.spheres[sphere].radius_mm) for frame in frames]
        why = _why_not(centres, kept, settings) or _kept(devices, sphere, frames[-1], writer)
        if why is None and centres[-1] is not None:
            kept.append(centres[-1])
        tell(f"{len(kept)} of {settings.n_places}: {why or 'kept; move the sphere on'}")
        devices.robot.wait(settings.every_s)
        waited += settings.every_s
    return len(kept)


def _kept(devices: Devices, sphere: str, frame: Frame3D, writer: SessionWriter) -> str | None:
    """Write a picture down, with where the robot stood; why not, where it moves."""
    state = devices.robot.read_state()
    if state.moving:
        return "the robot moves"
    writer.append(
        sphere=sphere,
        joints_rad=state.joints_rad,
        base_from_flange=state.base_from_flange,
        xyz_mm=frame.xyz_mm,
        temperatures_c=frame.temperatures_c,
    )
    return None


def _centre(frame: Frame3D, radius_mm: float) -> FloatArray | None:
    try:
        return find_sphere(frame.xyz_mm, radius_mm=radius_mm).centre_in_camera_mm
    except SphereNotFound:
        return None


def _why_not(centres: list[FloatArray | None], kept: list[FloatArray], settings: SweepSettings) -> str | None:
    """Why a picture is not kept; None where it is."""
    first, second = centres if len(centres) == 2 else (None, None)
    if first is None or second is None:
        return "no sphere in view"
    if float(np.linalg.norm(second - first)) > settings.still_mm:
        return "the sphere moves; put it down or hold it still"
    if any(float(np.linalg.norm(second - place)) < settings.apart_mm for place in kept):
        return "seen here before; move the sphere on, nearer and farther too"
    return None
