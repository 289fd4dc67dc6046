"""What a robot and a camera are to spherecal. Adapters satisfy these protocols; nothing inherits from them.

Units are mm, rad and s; `base_from_flange` follows `drivers.kinematics.se3`. A device object does no I/O in its
constructor: `open` connects, `close` may be called any number of times, and one thread owns it.

What every robot adapter promises (docs/add_a_robot.md; `drivers.contract.robot` tests it):

* a reading is fresh (`RobotState.age_s` at most `MAX_AGE_S`) or an error, never the last known value;
* every call ends within its deadline (`CONNECT_S`, `SILENCE_S`), whatever the controller does;
* a motion that was refused or interrupted is a typed error with the controller's own reason, as far as it gives one;
* nothing is sent again after a lost link by itself: the caller opens anew, and decides;
* no protective stop is ever cleared.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from types import TracebackType
from typing import Literal, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from drivers.errors import SpherecalError

FloatArray = NDArray[np.float64]


CONNECT_S = 3.0
"""Longest time of `open`, whatever is at the address."""
SILENCE_S = 1.0
"""Longest time of any other call, when the controller says nothing."""
MAX_AGE_S = 0.05
"""An older reading is none: adapters raise StaleReading."""


class Safety(Enum):
    """What the controller says about its safety state."""

    NORMAL = "normal"
    REDUCED = "reduced"
    """Moves, at a speed that the safety configuration bounds."""
    PROTECTIVE_STOP = "protective_stop"
    SAFEGUARD_STOP = "safeguard_stop"
    """A door or a light curtain; ends by itself when it closes."""
    EMERGENCY_STOP = "emergency_stop"
    FAULT = "fault"
    """The safety system itself has failed."""
    UNKNOWN = "unknown"

    @property
    def stops_motion(self) -> bool:
        """Whether the robot cannot move until somebody acts at it."""
        return self in {Safety.PROTECTIVE_STOP, Safety.SAFEGUARD_STOP, Safety.EMERGENCY_STOP, Safety.FAULT}


class Mode(StrEnum):
    """Who is master of the robot's motions."""

    AUTOMATIC = "automatic"
    """Programs and remote clients may move it (UR: remote control; ABB: AUTO)."""
    MANUAL = "manual"
    """A person with an enabling switch (ABB: MANR, MANF; UR: manual)."""
    LOCAL = "local"
    """The pendant only (UR: local control)."""
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class RobotInfo:
    """Identity of a robot, as far as its controller tells it."""

    adapter: str
    model: str | None = None
    serial: str | None = None
    controller: str | None = None
    notes: tuple[str, ...] = ()

    def identity(self) -> dict[str, str]:
        """What is known of the part that a calibration is bound to, under the key of a cell's `identity`."""
        return {} if self.serial is None else {"robot_serial": self.serial}


@dataclass(frozen=True, slots=True, eq=False)
class RobotState:
    """One fresh reading of a robot."""

    joints_rad: FloatArray | None
    """(n,) reported axis angles, or None where the controller does not give them."""
    base_from_flange: FloatArray | None
    """(4, 4) flange pose as the controller reports it, or None."""
    time_s: float
    """`time.monotonic()` of the reading (simulated cells: their own clock)."""
    moving: bool
    safety: Safety = Safety.NORMAL
    mode: str = Mode.AUTOMATIC
    """One of `Mode`."""
    age_s: float = 0.0
    """How old the reading was when it was handed over, transport included as far as it can be known."""
    motors_on: bool | None = None
    """Drives powered and brakes free; None where the controller does not tell."""
    reason: str | None = None
    """Why the robot does not move or stopped, in the controller's own words."""
    active_tool: str | None = None
    """Tool that the controller's poses refer to: `tool0` for the bare flange, None where unknown."""
    active_work_object: str | None = None
    """Frame that the controller's poses refer to: `wobj0` for the base, None where unknown."""


@runtime_checkable
class Robot(Protocol):
    """A robot arm that can be read, moved and stopped."""

    def open(self) -> RobotInfo:
        """Connect. Raises RobotNotReached or RobotTimeout within 3 s when nobody answers."""
        ...

    def read_state(self) -> RobotState:
        """A fresh reading (never a stale one), or RobotNotReached / RobotTimeout. An active stop is told, not raised."""
        ...

    def start_move(self, joints_rad: FloatArray, *, speed_rad_s: float) -> None:
        """Start a motion to axis angles (n,) and return at once; raises MotionRefused or SafetyStop.

        No axis is faster than `speed_rad_s`. Number, finiteness and limits of the angles are checked before anything is
        sent. How long the motion may take, and that the robot then stands still, is `acquire.motion`'s to see; an
        adapter whose process may die with the robot moving stops it by itself.
        """
        ...

    def stop(self) -> None:
        """Stop now, in any state and from any open or lost link; returns when the controller has the command."""
        ...

    def wait(self, seconds: float) -> None:
        """Let time pass: real robots sleep, simulated ones advance their clock (and may not sleep at all)."""
        ...

    def close(self) -> None:
        """Release the robot; safe to call twice and after errors."""
        ...


@runtime_checkable
class HandGuided(Protocol):
    """What a robot that can be led by hand has besides `Robot`; ask with `isinstance`."""

    def start_freedrive(self) -> None:
        """Let a person push the arm; raises MotionRefused or SafetyStop."""
        ...

    def end_freedrive(self) -> None:
        """Hold the arm again where it is; without effect when it is held."""
        ...


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """Identity that a calibration is bound to: another serial, preset or on-board correction needs another calibration."""

    adapter: str
    model: str | None = None
    serial: str | None = None
    firmware: str | None = None
    settings_digest: str | None = None
    """Of everything that was set and that changes where points lie."""
    onboard_correction: str | None = None
    """Name or time stamp of a correction that the camera applies by itself (Zivid: infield correction)."""
    working_range_mm: tuple[float, float] | None = None
    kind: Literal["area", "line_profile"] = "area"
    vendor: str | None = None
    sdk_version: str | None = None
    notes: tuple[str, ...] = ()
    """What an operator should know of the camera's settings; `doctor` tells them as hints."""

    def identity(self) -> dict[str, str]:
        """What is known of the parts that a calibration is bound to, under the keys of a cell's `identity`."""
        known = {"camera_serial": self.serial, "camera_settings": self.settings_digest, "camera_correction": self.onboard_correction}
        return {key: value for key, value in known.items() if value is not None}


@dataclass(frozen=True, slots=True, eq=False)
class Frame3D:
    """One triggered exposure: owned arrays, mm, camera frame (x right, y down, z out), NaN where invalid."""

    xyz_mm: NDArray[np.float32]
    """(height, width, 3), C-contiguous; unorganised sources give (1, n, 3)."""
    sequence: int
    """Strictly rising per connection: proves that the frame follows its trigger."""
    time_s: float
    """`time.monotonic()` of the trigger (simulated cells: their own clock)."""
    intensity: NDArray[np.float32] | None = None
    """(height, width), 0..1."""
    temperatures_c: Mapping[str, float] = field(default_factory=dict)
    quality: NDArray[np.float32] | None = None
    """(height, width), higher is better; what it means is told by `quality_kind`."""
    quality_kind: Literal["snr", "confidence"] | None = None
    done_s: float | None = None
    """`time.monotonic()` when the frame had come whole."""
    device_time_ns: int | None = None
    """The camera's own time stamp of the exposure."""
    diagnostics: Mapping[str, float | int | str] = field(default_factory=dict)
    """Whatever tells how well the transport works: lost and resent packets, file name, frame number of the camera."""


@dataclass(frozen=True, slots=True)
class CameraHealth:
    """How a camera that is open is, without taking a picture."""

    temperatures_c: Mapping[str, float] = field(default_factory=dict)
    link: Mapping[str, float | int | str] = field(default_factory=dict)
    """Counters of the way to it, as in `Frame3D.diagnostics`: packets lost and sent again, since the stream began."""


@runtime_checkable
class TellsHealth(Protocol):
    """What a camera that can tell how it is has besides `Camera3D`; ask with `isinstance`."""

    def health(self) -> CameraHealth:
        """How it is now. Raises CameraNotReached when it is not open or does not answer."""
        ...


@runtime_checkable
class Camera3D(Protocol):
    """A 3D camera that gives one fresh frame per call (docs/add_a_camera.md; `drivers.contract.camera` tests it).

    One thread owns it; while a call waits, the application's other threads run on.
    """

    def open(self) -> CameraInfo:
        """Connect and apply the settings, every time anew.

        Raises:
            CameraNotReached: nobody answers (within 3 s), or another client holds it (CameraBusy).
            CameraMisconfigured: its settings would spoil a calibration.
            CameraSdkMissing: the vendor's library is not installed.
        """
        ...

    def capture(self, *, timeout_s: float) -> Frame3D:
        """A frame exposed after this call, or a CameraError; never None, never an older frame."""
        ...

    def close(self) -> None:
        """Release the camera; safe to call twice and after errors."""
        ...


def stop_after(robot: Robot, error: BaseException) -> SpherecalError | None:
    """Stop a robot after an error, which stays the one that is told; its remedy says so where the stop fails, too.

    Returns:
        Why it could not be told to stop; None where it could.
    """
    try:
        robot.stop()
    except SpherecalError as second:
        if isinstance(error, SpherecalError) and _NOT_STOPPED not in (error.remedy or ""):
            error.remedy = f"{_NOT_STOPPED} ({second.message}): press the emergency stop if it moves. {error.remedy or ''}".strip()
        return second
    return None


_NOT_STOPPED = "The robot could not be told to stop"


@dataclass(frozen=True, slots=True)
class Devices:
    """The robot and the camera of one cell, opened and closed together.

    The robot is stopped when the block ends by an exception: a program that lost its way must not leave a moving arm.
    The exception goes on, and tells with it when the robot could not be stopped.
    """

    robot: Robot
    camera: Camera3D
    _told: dict[str, str] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def identity(self) -> Mapping[str, str]:
        """What robot and camera told of themselves when they were opened, under the keys of a cell's `identity`."""
        return self._told

    def __enter__(self) -> Self:
        """Open both; the robot is closed again when the camera fails."""
        robot = self.robot.open()
        try:
            camera = self.camera.open()
        except BaseException:
            self.robot.close()
            raise
        self._told.clear()
        self._told.update(robot.identity() | camera.identity())
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Stop the robot on any exception, then close both."""
        try:
            second = None if error is None else stop_after(self.robot, error)
            if second is not None and not isinstance(error, SpherecalError):
                raise second  # says more than Ctrl-C or a bug does
        finally:
            try:
                self.camera.close()
            finally:
                self.robot.close()
