"""What one frame of a camera, and what the camera says of itself, tell about its settings and the way to it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np

from acquire.identity import differences
from drivers.cameras.frames import frame_problems
from drivers.errors import CameraError
from drivers.protocols import Camera3D, CameraInfo, Frame3D, TellsHealth

Facts: TypeAlias = dict[str, object]

_FEW_VALID = 0.05
_LOSSES = ("packets_missing", "packets_resent", "frames_failed", "frames_dropped")


def info_facts(info: CameraInfo) -> Facts:
    """Who the camera says it is."""
    return {
        "vendor": info.vendor,
        "camera_model": info.model,
        "serial": info.serial,
        "firmware": info.firmware,
        "settings_digest": info.settings_digest,
        "onboard_correction": info.onboard_correction,
        "sdk_version": info.sdk_version,
        "notes": list(info.notes),
    }


def identity_problems(info: CameraInfo, identity: Mapping[str, object], kind: str) -> list[str]:
    """Where the camera is another, or is set otherwise, than the cell file says; what either does not tell is no fault."""
    problems = []
    for difference in differences(identity, info.identity()):
        remedy = f"Connect that camera and set it so, or correct identity.{difference.key} and calibrate again"
        problems.append(f"{difference.text('the cell file says')}. {remedy}.")
    if info.kind != kind:
        problems.append(f"it is a {info.kind} camera, the cell file says {kind}. Correct camera.kind.")
    return problems


def health_facts(camera: Camera3D) -> Facts:
    """What a camera tells of itself, picture or not; nothing where it tells nothing."""
    if not isinstance(camera, TellsHealth):
        return {}
    try:
        told = camera.health()
    except CameraError:
        return {}  # whatever it is, the capture tells it
    return {"health": {"temperatures_c": dict(told.temperatures_c), "link": dict(told.link)}}


def frame_facts(frame: Frame3D, working_range_mm: tuple[float, float] | None) -> tuple[Facts, list[str]]:
    """Size, valid points and depths of a frame, how it came, and what is wrong with it."""
    height, width, _ = frame.xyz_mm.shape
    depth_mm = frame.xyz_mm[..., 2][np.isfinite(frame.xyz_mm).all(axis=-1)]
    facts: Facts = {"width": width, "height": height, "n_points": int(depth_mm.size), "depth_mm": None}
    facts |= {"seconds": None if frame.done_s is None else frame.done_s - frame.time_s, "temperatures_c": dict(frame.temperatures_c)}
    facts["diagnostics"] = dict(frame.diagnostics)
    if depth_mm.size == 0:
        return facts, []  # a camera that looks into the air is well: nothing is in its range
    low, middle, high = (float(value) for value in np.percentile(depth_mm, (1, 50, 99)))
    facts["depth_mm"] = [low, middle, high]
    problems = frame_problems(frame.xyz_mm)
    if not problems and working_range_mm is not None and not working_range_mm[0] / 2 <= middle <= working_range_mm[1] * 2:
        problems = [f"the median depth is {middle:.0f} mm, the cell's working range {working_range_mm[0]:g} to {working_range_mm[1]:g} mm."]
    return facts, problems


def camera_hints(info: CameraInfo, frame: Frame3D) -> list[str]:
    """What works, and is worth knowing."""
    hints = list(info.notes)
    valid = float(np.isfinite(frame.xyz_mm).all(axis=-1).mean()) if frame.xyz_mm.size else 0.0
    if valid < _FEW_VALID:
        hints.append(f"only {100 * valid:.1f} % of its pixels hold a point: put something in its range, or check the exposure")
    if frame.xyz_mm.shape[0] == 1 and info.kind == "area":
        hints.append("its frames have no grid: export or set organised clouds, so that edges and holes can be told apart")
    lost = [f"{name.replace('_', ' ')}: {frame.diagnostics[name]}" for name in _LOSSES if frame.diagnostics.get(name)]
    if lost:
        hints.append(f"the network loses data ({', '.join(lost)}): check cable, switch, packet size and delay")
    return hints
