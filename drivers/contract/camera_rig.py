"""A camera under the contract tests, the scene in front of it, and what can be done to it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from drivers.contract.checks import ContractBroken, require, skip_without
from drivers.errors import CameraError
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import Camera3D, Frame3D

_BAND = 0.25
_FEWEST = 100
_STEPS = 30


def _nothing() -> None:
    """A camera that needs no mending."""


@dataclass(frozen=True, slots=True)
class CameraRig:
    """A camera to be tested, and what can be done to it."""

    make: Callable[[], Camera3D]
    """A new adapter, not opened, for the one camera of this rig."""
    timeout_s: float = 5.0
    """Time for one frame."""
    short_timeout_s: float = 1.0
    """Time that is allowed where no frame will come; longer than a frame takes."""
    radius_mm: float | None = None
    """Of a sphere in view."""
    centre_mm: Callable[[], FloatArray] | None = None
    """Where its centre (3,) is now, in the camera frame."""
    tolerance_mm: float = 0.05
    """How far a measured centre may be from it."""
    move_sphere: Callable[[], None] | None = None
    """Put it elsewhere, by 2 mm or more; each call to another place."""
    organised: bool = True
    has_settings: bool = True
    """Whether anything is set that `settings_digest` could tell."""
    real_time: bool = True
    """Whether `Frame3D.time_s` is `time.monotonic()`; simulated cells have clocks of their own."""
    nobody: Mapping[str, Callable[[], Camera3D]] = field(default_factory=dict)
    """Adapters for addresses where no camera is."""
    faults: Mapping[str, Callable[[], None]] = field(default_factory=dict)
    """How to make the camera misbehave.

    Before it is opened: `busy` (another client holds it), `misconfigured` (unit, transform, pixel format).
    While it is open: `silence` (no frame comes), `late` (one frame comes after its call has timed out), `old_frame` (a frame
    of an earlier trigger lies in the queue), `lost_packets`, `gone`.
    """
    clear: Callable[[], None] = _nothing
    """Make it behave again, as an operator would."""


@contextmanager
def opened_camera(rig: CameraRig) -> Iterator[Camera3D]:
    """A new adapter of the rig, open; closed on the way out."""
    camera = rig.make()
    try:
        camera.open()
        yield camera
    finally:
        camera.close()


def fault_of(rig: CameraRig, name: str) -> Callable[[], None]:
    """How to break the rig's camera; skips the test where the rig cannot."""
    if name not in rig.faults:
        skip_without(f"the fault {name}")
    return rig.faults[name]


def require_sphere(frame: Frame3D, rig: CameraRig) -> None:
    """The frame shows the sphere where it is now; skips the test where the rig has none.

    Raises:
        ContractBroken: it does not, or shows it too large, too small, or elsewhere.
    """
    if rig.radius_mm is None or rig.centre_mm is None:
        skip_without("a known sphere")
    true_mm = np.asarray(rig.centre_mm(), dtype=np.float64)
    found_mm, radius_mm = fitted_sphere(frame, true_mm, rig.radius_mm)
    off_mm = float(np.linalg.norm(found_mm - true_mm))
    told = f"the sphere was found at {found_mm.round(3)} mm, it is at {true_mm.round(3)} mm ({off_mm:.4f} mm off)"
    require(off_mm <= rig.tolerance_mm, f"{told}; wrong unit, axes, or an old frame")
    require(abs(radius_mm - rig.radius_mm) <= 5 * rig.tolerance_mm, f"the sphere has a radius of {radius_mm:.3f} mm, not {rig.radius_mm:.3f}")


def fitted_sphere(frame: Frame3D, near_mm: FloatArray, radius_mm: float) -> tuple[FloatArray, float]:
    """Centre (3,) for the known radius, and the mean distance of the points from it, of the points round a place.

    Raises:
        ContractBroken: there are too few points.
    """
    points = frame.xyz_mm[np.isfinite(frame.xyz_mm).all(axis=-1)].astype(np.float64)
    points = points[np.abs(np.linalg.norm(points - near_mm, axis=1) - radius_mm) < _BAND * radius_mm]
    if len(points) < _FEWEST:
        raise ContractBroken(f"only {len(points)} points where the sphere is: wrong unit, axes, or an old frame")
    centre = near_mm.copy()
    for _ in range(_STEPS):
        away = points - centre
        distance = np.linalg.norm(away, axis=1)
        step, *_ = np.linalg.lstsq(away / distance[:, None], distance - radius_mm, rcond=None)
        centre = centre + step
    return centre, float(np.linalg.norm(points - centre, axis=1).mean())


def capture_or_error(camera: Camera3D, timeout_s: float) -> Frame3D | CameraError:
    """A frame, or the error that came in its place."""
    try:
        return camera.capture(timeout_s=timeout_s)
    except CameraError as error:
        require(bool(error.remedy), f"{type(error).__name__} without a remedy: {error}")
        return error
