"""Waiting until a camera is warm: the robot stands, the camera looks at whatever is there, its drift is watched."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from acquire.capture_settings import WarmUpSettings
from acquire.events import WarmingUp
from drivers.errors import CameraError, CameraTimeout
from drivers.protocols import Devices, FloatArray, Frame3D


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    time_s: float
    temperatures_c: dict[str, float]
    depth_mm: FloatArray
    """(h w,), NaN where nothing is seen."""


def warming_up(devices: Devices, settings: WarmUpSettings, *, frame_timeout_s: float) -> Iterator[WarmingUp]:
    """Expose again and again until temperatures and distances stand still; the last event is warm.

    Time is the robot's (`RobotState.time_s`). A single exposure that fails is left out.

    Raises:
        CameraTimeout: not warm within `longest_s`.
        CameraError: the camera is gone.
        RobotError: the robot is.
    """
    begin_s = devices.robot.read_state().time_s
    looks: deque[_Look] = deque()
    while True:
        now_s = devices.robot.read_state().time_s
        frame = _frame(devices, frame_timeout_s)
        if frame is not None:
            looks.append(_look(frame, now_s))
        while len(looks) > 2 and looks[1].time_s <= now_s - settings.window_s:
            looks.popleft()
        event = _event(looks, now_s - begin_s, settings)
        yield event
        if event.warm:
            return
        if now_s - begin_s > 2 * settings.window_s and event.drift_k_per_min is None and event.drift_mm_per_min is None:
            raise CameraTimeout(
                "nothing tells whether the camera is warm: it gives no temperature and sees nothing from here",
                remedy="Put something into its view, move the robot to where it sees something, or go on without --warm-up.",
            )
        if now_s - begin_s > settings.longest_s:
            raise CameraTimeout(
                f"the camera still drifts after {settings.longest_s / 60:.0f} min: {drift_text(event)}",
                remedy="Is something moving in its view, or the air around it? Go on without --warm-up, or let it rest.",
            )
        devices.robot.wait(settings.every_s)


def drift_text(event: WarmingUp) -> str:
    """The drifts in words."""
    parts = []
    if event.drift_k_per_min is not None:
        parts.append(f"{event.drift_k_per_min:.2f} K/min")
    if event.drift_mm_per_min is not None:
        parts.append(f"{1000 * event.drift_mm_per_min:.0f} um/min")
    return " and ".join(parts) or "no figure yet"


def _frame(devices: Devices, timeout_s: float) -> Frame3D | None:
    try:
        return devices.camera.capture(timeout_s=timeout_s)
    except CameraError as error:
        if not error.retryable:
            raise
        return None


def _look(frame: Frame3D, time_s: float) -> _Look:
    return _Look(time_s, dict(frame.temperatures_c), frame.xyz_mm[..., 2].astype(np.float64).ravel())


def _event(looks: deque[_Look], seconds: float, settings: WarmUpSettings) -> WarmingUp:
    if len(looks) < 2 or looks[-1].time_s - looks[0].time_s < 0.9 * settings.window_s:
        return WarmingUp(seconds, None, None, warm=False)
    first, last = looks[0], looks[-1]
    minutes = (last.time_s - first.time_s) / 60
    common = first.temperatures_c.keys() & last.temperatures_c.keys()
    kelvin = max((abs(last.temperatures_c[name] - first.temperatures_c[name]) / minutes for name in common), default=None)
    mm = _shift_mm(first, last)
    rate = None if mm is None else mm / minutes
    told = [(kelvin, settings.most_k_per_min), (rate, settings.most_mm_per_min)]
    known = [value <= most for value, most in told if value is not None]
    return WarmingUp(seconds, kelvin, rate, warm=bool(known) and all(known))


def _shift_mm(first: _Look, last: _Look) -> float | None:
    """How far what both looks see has moved along the view: the median, which noise and edges hardly touch."""
    if first.depth_mm.shape != last.depth_mm.shape:
        return None
    shift = (last.depth_mm - first.depth_mm)[np.isfinite(first.depth_mm) & np.isfinite(last.depth_mm)]
    return float(abs(np.median(shift))) if len(shift) else None
