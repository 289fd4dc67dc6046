"""A recorded robot and camera: they replay a session, shot by shot, with no hardware.

Settings of both: `session`, the session's folder, relative to the cell file. The robot goes only where the recording
has been; the camera gives the scan of the shot that the robot stands at. A camera without its robot plays the scans in
their order.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CameraNotReached, InvalidFrame, MotionRefused, RobotError, RobotNotReached, SettingsError
from drivers.files.session import Session, read_scan, read_session
from drivers.files.shots import Shot
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import CameraInfo, Frame3D, RobotInfo, RobotState
from drivers.registry import DriverContext

_SAME_POSE_RAD = 1e-3


def make_robot(context: DriverContext) -> RecordedRobot:
    """The robot of a recording.

    Raises:
        SettingsError: `session` is missing, or there is another key.
    """
    return RecordedRobot(_recording(context, "robot"))


def make_camera(context: DriverContext) -> RecordedCamera:
    """The camera of a recording.

    Raises:
        SettingsError: `session` is missing, or there is another key.
    """
    return RecordedCamera(_recording(context, "camera"))


@dataclass(slots=True, eq=False)
class Recording:
    """What the robot and the camera of one recording share: the shots, and which one is being played."""

    folder: Path
    session: Session | None = None
    shots: tuple[Shot, ...] = ()
    position: int | None = None
    """Place in `shots`; None before the first."""
    visits: dict[int, int] = field(default_factory=dict)
    robot_moves: bool = False
    clock_s: float = 0.0

    def load(self) -> Session:
        """Read the session, once.

        Raises:
            FileError: as `read_session`.
        """
        if self.session is None:
            self.session = read_session(self.folder)
            self.shots = tuple(shot for shot in self.session.shots if shot.status == "ok" and shot.scan is not None)
        return self.session

    def nearest(self, joints_rad: FloatArray) -> tuple[int, float]:
        """Place of the shot nearest to axis angles (n,), the least visited and then the earliest of equals; its distance in rad."""
        distances = [_distance_rad(shot, joints_rad) for shot in self.shots]
        best = min(distances)
        if best > _SAME_POSE_RAD:
            return distances.index(best), best
        same = [i for i, distance in enumerate(distances) if distance <= best + 1e-9]
        return min(same, key=lambda i: self.visits.get(i, 0)), best

    def go(self, place: int) -> None:
        """Stand at a shot."""
        self.position = place
        self.visits[place] = self.visits.get(place, 0) + 1


class RecordedRobot:
    """Goes where the recording has been. Satisfies `drivers.protocols.Robot`."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._open = False

    def open(self) -> RobotInfo:
        """Read the session.

        Raises:
            RobotError: the recording holds flange poses only, or no scan at all.
            FileError: as `read_session`.
        """
        session = self._recording.load()
        if not self._recording.shots:
            raise RobotError("the recording has no scans", file=session.folder, remedy="Name a session with shots.")
        if any(shot.joints_rad is None for shot in self._recording.shots):
            raise RobotError(
                "the recording has flange poses but no axis angles, so there is nothing to move a robot to",
                file=session.folder,
                remedy="Use the session itself: spherecal calibrate, verify and stitch read it without a robot.",
            )
        self._open = self._recording.robot_moves = True
        serial = session.identity.get("robot_serial")
        return RobotInfo("recorded", serial=None if serial is None else str(serial), notes=(f"replays {session.folder}",))

    def read_state(self) -> RobotState:
        """The recorded state of the shot it stands at; of the first shot before any motion."""
        self._check_open()
        shot = self._recording.shots[self._recording.position or 0]
        return RobotState(shot.joints_rad, shot.base_from_flange, self._recording.clock_s, moving=False)

    def start_move(self, joints_rad: FloatArray, *, speed_rad_s: float) -> None:
        """Go to the recorded shot at these axis angles (measured or commanded), at once.

        Raises:
            MotionRefused: the recording has no shot within 1e-3 rad.
        """
        self._check_open()
        del speed_rad_s  # a recording takes no time
        place, distance_rad = self._recording.nearest(np.asarray(joints_rad, dtype=np.float64))
        if distance_rad > _SAME_POSE_RAD:
            nearest = f"the nearest, shot {self._recording.shots[place].index}, is {distance_rad:.4g} rad away"
            message = f"the recording has no shot at these axis angles; {nearest}"
            raise MotionRefused(message, file=self._recording.folder, remedy="Use the plan of the recorded session.")
        self._recording.go(place)

    def stop(self) -> None:
        """Nothing moves."""

    def wait(self, seconds: float) -> None:
        """Advance the recording's own clock; sleeps not at all."""
        self._recording.clock_s += seconds

    def close(self) -> None:
        """Forget the connection."""
        self._open = self._recording.robot_moves = False

    def _check_open(self) -> None:
        if not self._open:
            raise RobotNotReached("the recording is not open", file=self._recording.folder, remedy="Open the robot first.")


class RecordedCamera:
    """Gives the scan of the shot that the robot stands at. Satisfies `drivers.protocols.Camera3D`."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._open = False
        self._sequence = 0

    def open(self) -> CameraInfo:
        """Read the session.

        Raises:
            CameraNotReached: the recording has no scans.
            FileError: as `read_session`.
        """
        session = self._recording.load()
        if not self._recording.shots:
            raise CameraNotReached("the recording has no scans", file=session.folder, remedy="Name a session with shots.")
        self._open = True
        if not self._recording.robot_moves:
            self._recording.position = None
        known = {key: str(value) for key, value in session.identity.items() if value is not None}
        return CameraInfo(
            "recorded",
            serial=known.get("camera_serial"),
            settings_digest=known.get("camera_settings"),
            onboard_correction=known.get("camera_correction"),
        )

    def capture(self, *, timeout_s: float) -> Frame3D:
        """The recorded scan.

        Raises:
            CameraNotReached: not open, or, without a robot, the recording is over.
            InvalidFrame: the robot has not moved to any shot yet.
            FileError: the scan is missing or has changed.
        """
        del timeout_s  # reading a file does not wait
        if not self._open or self._recording.session is None:
            raise CameraNotReached("the recording is not open", file=self._recording.folder, remedy="Open the camera first.")
        cloud = read_scan(self._recording.session, self._recording.shots[self._place()])
        self._sequence += 1
        xyz_mm = cloud.xyz_mm if cloud.xyz_mm.ndim == 3 else cloud.xyz_mm[None]
        intensity = cloud.properties.get("intensity")
        return Frame3D(
            xyz_mm=np.ascontiguousarray(xyz_mm),
            sequence=self._sequence,
            time_s=self._recording.clock_s,
            intensity=None if intensity is None else _image(intensity, xyz_mm.shape[:2]),
            temperatures_c=self._recording.shots[self._recording.position or 0].temperatures_c,
        )

    def close(self) -> None:
        """Forget the connection."""
        self._open = False

    def _place(self) -> int:
        recording = self._recording
        if recording.robot_moves:
            if recording.position is None:
                raise InvalidFrame("the robot has not moved to a recorded shot yet", file=recording.folder, remedy="Move it first.")
            return recording.position
        following = 0 if recording.position is None else recording.position + 1
        if following >= len(recording.shots):
            raise CameraNotReached("the recording is over", file=recording.folder, remedy="Open it again to play from the beginning.")
        recording.go(following)
        return following


def _recording(context: DriverContext, section: str) -> Recording:
    path = context.settings.get("session")
    unknown = [key for key in context.settings if key != "session"]
    if unknown:
        raise SettingsError(f"unknown key {unknown[0]!r}", where=f"{section} (driver recorded)", remedy="Allowed: session.")
    if not isinstance(path, str) or not path:
        raise SettingsError(
            "the recorded driver needs to know what to replay", where=f"{section} (driver recorded)", remedy="Add `session: FOLDER` to the cell file."
        )
    folder = context.folder / path
    found = context.shared.setdefault(f"recorded:{folder.resolve()}", Recording(folder))
    if not isinstance(found, Recording):
        msg = "shared state of the recorded driver was replaced"
        raise TypeError(msg)
    return found


def _distance_rad(shot: Shot, joints_rad: FloatArray) -> float:
    known = [joints for joints in (shot.joints_rad, shot.target_joints_rad) if joints is not None and joints.shape == joints_rad.shape]
    return min((float(np.abs(joints - joints_rad).max()) for joints in known), default=float("inf"))


def _image(values: NDArray[np.generic], shape: tuple[int, ...]) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32).reshape(shape)
