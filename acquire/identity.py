"""Which robot and which camera: what a cell file says, what the devices tell, what a session or a calibration was made with.

A calibration is bound to the serial numbers, to everything set at the camera that changes where points lie, to a
correction that the camera applies by itself, and to the payload. What one side does not tell is no difference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from acquire.cell import Cell, cell_of_session
from drivers.errors import CameraMisconfigured, DataError, SettingsError, WrongController
from drivers.files.session import Session
from drivers.protocols import Camera3D, Robot

BOUND: Mapping[str, str] = {
    "robot_serial": "the robot's serial number",
    "camera_serial": "the camera's serial number",
    "camera_settings": "the digest of the camera's settings",
    "camera_correction": "the camera's own correction",
    "payload_kg": "the payload",
}
"""Another one of these and a calibration measures something else; in words."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One thing that both sides tell, and not the same."""

    key: str
    expected: str
    found: str

    def text(self, whose: str) -> str:
        """In words: `the camera's serial number is 8, WHOSE 7`."""
        return f"{BOUND.get(self.key, self.key)} is {self.found}, {whose} {self.expected}"


def differences(expected: Mapping[str, object], found: Mapping[str, object]) -> tuple[Difference, ...]:
    """What both sides know and do not agree on, what binds a calibration first; `7` and `"7"` are the same."""
    known = [key for key in (*BOUND, *sorted(found)) if expected.get(key) is not None and found.get(key) is not None]
    pairs = [Difference(key, str(expected[key]), str(found[key])) for key in dict.fromkeys(known)]
    return tuple(pair for pair in pairs if pair.expected != pair.found)


def identity_of_new_session(cell: Cell, told: Mapping[str, str]) -> dict[str, object]:
    """What a session that begins now is recorded with: the cell file's identity, and what the devices tell.

    Raises:
        SettingsError: robot or camera are others, or set otherwise, than the cell file says.
    """
    for difference in differences(cell.identity, told):
        remedy = f"Connect that device and set it so; or correct identity.{difference.key} in the cell file, and calibrate again."
        raise SettingsError(difference.text("the cell file says"), file=cell.path, where=f"identity.{difference.key}", remedy=remedy)
    return {**cell.identity, **told}


def check_resumed(identity: Mapping[str, object], told: Mapping[str, str], *, file: Path) -> None:
    """Nothing, where a session is gone on with by the robot and the camera that it was begun with, set as then.

    Raises:
        SettingsError: they are others.
    """
    for difference in differences(identity, told):
        remedy = "Connect the device of its start and set it as it was, or begin a new session: the shots of two cannot be solved as one."
        raise SettingsError(difference.text("the session was begun with"), file=file, where=f"identity.{difference.key}", remedy=remedy)


def identity_of_session(session: Session, cell: Cell | None = None) -> dict[str, object]:
    """What a session was recorded with, as far as it, or else its cell file, says.

    Raises:
        FileError: its cell file is broken.
    """
    return {**(cell or cell_of_session(session)).identity, **session.identity}


def identity_marks(identity: Mapping[str, object], session: Session, cell: Cell | None = None) -> tuple[str, ...]:
    """How the system that recorded a session differs from the one that was calibrated, where the cell file lets that pass.

    Args:
        identity: of the calibration.
        session: that is to be measured with it.
        cell: the session's own if None.

    Raises:
        DataError: another robot, camera, setting, correction or payload, where the cell file does not say
            `identity_mismatch: {KEY: mark}`.
        FileError: its cell file is broken.
    """
    its_cell = cell or cell_of_session(session)
    marks = []
    for difference in differences(identity, identity_of_session(session, its_cell)):
        text = difference.text("the calibration is of")
        if its_cell.identity_mismatch.get(difference.key, "refuse" if difference.key in BOUND else "mark") == "refuse":
            passing = f"`identity_mismatch: {{{difference.key}: mark}}` in the cell file lets it pass"
            remedy = f"Use the calibration of that device, or calibrate anew; {passing}."
            raise DataError(text, file=session.folder / "session.yaml", where=f"identity.{difference.key}", remedy=remedy)
        marks.append(text)
    return tuple(marks)


def check_one_system(sessions: Sequence[Session]) -> None:
    """Nothing, where sessions may be solved together.

    Raises:
        DataError: they were recorded with different robots, cameras, settings or payloads, and no cell file lets that pass.
        FileError: a cell file is broken.
    """
    known: dict[str, object] = {}
    for session in sessions:
        cell = cell_of_session(session)
        found = identity_of_session(session, cell)
        for difference in differences(known, found):
            if difference.key in BOUND and cell.identity_mismatch.get(difference.key) != "mark":
                remedy = "Calibrate the sessions of each camera, robot and setting apart."
                raise DataError(difference.text("an earlier session's"), file=session.folder, where=f"identity.{difference.key}", remedy=remedy)
        known = {**found, **known}


def reopen_camera(camera: Camera3D, known: Mapping[str, str]) -> None:
    """Open a camera anew, and see that it is the same one, set as before.

    Args:
        camera: that was lost, or gave trouble.
        known: what it told of itself at first.

    Raises:
        CameraError: it cannot be opened; CameraMisconfigured: it is another one or set otherwise (it is closed again).
    """
    camera.close()
    told = camera.open().identity()
    for difference in differences(known, told):
        camera.close()
        remedy = "Connect the camera of the run's start, and set it as it was; or end the run and begin a new session."
        raise CameraMisconfigured(difference.text("the run was begun with"), remedy=remedy)


def reopen_robot(robot: Robot, known: Mapping[str, str]) -> None:
    """Connect to a robot anew, and see that it is the same one.

    Args:
        robot: whose link was lost.
        known: what it told of itself at first.

    Raises:
        RobotError: it cannot be reached; WrongController: it is another one (the link is closed again).
    """
    robot.close()
    told = robot.open().identity()
    for difference in differences(known, told):
        robot.close()
        remedy = "Connect the robot of the run's start, or end the run and begin a new session."
        raise WrongController(difference.text("the run was begun with"), remedy=remedy)
