"""The one error tree of spherecal.

    SpherecalError
    ├── FileError(ValueError)            a file is missing, broken, or says something that is not allowed
    ├── SettingsError(ValueError)        a call or a command line asks for what cannot be
    ├── DataError(ValueError)            well-formed data that cannot be used: units, too few shots, no sphere
    ├── RobotError(RuntimeError)
    │   ├── RobotNotReached(ConnectionError)   nobody answers
    │   │   ├── LinkLost                           somebody did, and the link has gone
    │   │   └── WrongController                    what answers is not the controller that was expected
    │   ├── RobotTimeout(TimeoutError)         an answer or a motion is late
    │   │   └── StaleReading                       readings come, and are old
    │   ├── MotionRefused                      outside limits, or the controller says no
    │   │   ├── NotInRemoteControl                 the pendant, or a person with an enabling switch, is the master
    │   │   ├── MotorsOff                          no power on the drives, or brakes closed
    │   │   └── ChannelTaken                       another client holds what is needed to command the robot
    │   ├── MotionInterrupted                  a started motion did not reach its target
    │   └── SafetyStop                         a stop is active
    │       ├── ProtectiveStop
    │       ├── SafeguardStop
    │       └── EmergencyStop
    └── CameraError(RuntimeError)
        ├── CameraNotReached(ConnectionError)
        │   ├── CameraLost                         it answered, and does so no more
        │   └── CameraBusy                         another client holds it
        ├── CameraTimeout(TimeoutError)
        ├── InvalidFrame(ValueError)           a frame that must not be used (wrong shape, wrong unit)
        │   ├── IncompleteFrame                    packets or bytes are missing
        │   └── StaleFrame                         exposed before the trigger, or seen before
        ├── CameraMisconfigured(ValueError)
        └── CameraSdkMissing(ImportError)      the vendor's library is not installed

Every error carries what was found (`message`), the file and the place in it, and what to do (`remedy`).
Double inheritance lets a caller catch either our tree or the builtin it knows. A ValueError of Python itself
means a bug in the calling code, never bad user data.
"""

from __future__ import annotations

from pathlib import Path


class SpherecalError(Exception):
    """Root of the tree: one line for the user, the parts for a program."""

    exit_code = 1

    def __init__(
        self,
        message: str,
        *,
        file: str | Path | None = None,
        where: str | None = None,
        remedy: str | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.file = None if file is None else str(file)
        self.where = where
        self.remedy = remedy

    def __str__(self) -> str:
        """One line: file, place, what was found, what to do."""
        place = ", ".join(part for part in (self.file, self.where) if part)
        text = f"{place}: {self.message}" if place else self.message
        text = " ".join(text.split())
        if self.remedy:
            text = f"{text.rstrip('.')}. {' '.join(self.remedy.split())}"
        return text

    def as_dict(self) -> dict[str, str | None]:
        """The object that `--json` prints under `error`."""
        return {
            "type": type(self).__name__,
            "message": self.message,
            "file": self.file,
            "where": self.where,
            "remedy": self.remedy,
        }


class FileError(SpherecalError, ValueError):
    """A file is missing, broken, or holds something that is not allowed there."""


class SettingsError(SpherecalError, ValueError):
    """A call or a command line asks for something that cannot be."""


class DataError(SpherecalError, ValueError):
    """Well-formed data that cannot be used for what was asked."""


class RobotError(SpherecalError, RuntimeError):
    """The robot, or the way to it, does not do what was asked."""


class RobotNotReached(RobotError, ConnectionError):
    """Nobody answers at the robot's address, or the link was lost."""


class LinkLost(RobotNotReached):
    """The robot answered, and the link to it has gone since. Nothing is sent again by itself."""


class WrongController(RobotNotReached):
    """Something answers at the address, and it is not what was expected there."""


class RobotTimeout(RobotError, TimeoutError):
    """An answer or a motion did not come within its deadline."""


class StaleReading(RobotTimeout):
    """The link stands and the readings that come over it are too old to be used."""


class MotionRefused(RobotError):
    """A motion was not started: outside limits, wrong mode, or the controller declined."""


class NotInRemoteControl(MotionRefused):
    """The robot is in local or manual mode: programs and remote clients may not move it."""


class MotorsOff(MotionRefused):
    """The drives have no power, or the brakes are closed; spherecal never switches them on by itself."""


class ChannelTaken(MotionRefused):
    """Another client holds the registers, the port or the session through which the robot is commanded."""


class MotionInterrupted(RobotError):
    """A motion was started and did not end at its target."""


class SafetyStop(RobotError):
    """A protective or emergency stop is active; spherecal never clears one by itself."""


class ProtectiveStop(SafetyStop):
    """The controller stopped the arm: a collision, a force, a limit."""


class SafeguardStop(SafetyStop):
    """A door, a mat or a light curtain holds the robot."""


class EmergencyStop(SafetyStop):
    """An emergency stop is pressed, or was and has not been reset."""


class CameraError(SpherecalError, RuntimeError):
    """The camera, or the way to it, does not do what was asked."""

    retryable = False


class CameraNotReached(CameraError, ConnectionError):
    """No camera at the address, or the link was lost."""


class CameraLost(CameraNotReached):
    """The camera answered, and does so no more; open it anew, its settings may be gone."""


class CameraBusy(CameraNotReached):
    """The camera answers, and another client holds it."""


class CameraTimeout(CameraError, TimeoutError):
    """No frame came within the deadline."""

    retryable = True


class InvalidFrame(CameraError, ValueError):
    """A frame came that must not be used: stale, incomplete, of the wrong shape or unit."""

    retryable = True


class IncompleteFrame(InvalidFrame):
    """A frame that lacks packets or bytes."""


class StaleFrame(InvalidFrame):
    """A frame that was exposed before its trigger, or has been handed over before."""


class CameraMisconfigured(CameraError, ValueError):
    """The camera is set in a way that would spoil a calibration (transform active, wrong unit)."""


class CameraSdkMissing(CameraError, ImportError):
    """The camera's own library is not installed, or cannot be loaded."""
