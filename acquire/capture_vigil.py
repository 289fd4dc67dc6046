"""What suspends a run although every device does as it is told: a sphere that is gone, a camera that drifts in temperature, a full disk."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from acquire.capture_settings import CaptureSettings
from acquire.events import Cause
from acquire.plan import PlannedPose
from drivers.errors import CameraError, DataError, FileError, SafetyStop, SpherecalError


class SphereMissing(DataError):
    """One sphere was not found several times in a row."""


class TemperatureDrift(DataError):
    """The camera's temperature has left that of the run's first shot."""


SUSPENDING = (CameraError, SphereMissing, TemperatureDrift, FileError)
"""Beside RobotError: what a person at the cell may put right while the run waits."""


def cause_of(error: SpherecalError) -> Cause:
    """What to call an error that suspends a run."""
    match error:
        case SafetyStop():
            return Cause.SAFETY
        case CameraError():
            return Cause.CAMERA
        case SphereMissing():
            return Cause.SPHERE
        case TemperatureDrift():
            return Cause.TEMPERATURE
        case FileError():
            return Cause.DISK
        case _:
            return Cause.ROBOT


class Vigil:
    """Counts and compares from shot to shot."""

    def __init__(self, settings: CaptureSettings) -> None:
        self._settings = settings
        self._missing: Counter[str] = Counter()
        self._first_c: dict[str, float] = {}
        self._now_c: Mapping[str, float] = {}

    def note_missing(self, pose: PlannedPose) -> None:
        """A shot did not show the sphere of its pose."""
        self._missing[str(pose.sphere)] += 1

    def note_good(self, pose: PlannedPose, temperatures_c: Mapping[str, float]) -> None:
        """A shot did."""
        self._missing.pop(str(pose.sphere), None)
        self._now_c = temperatures_c
        self._first_c = {**temperatures_c, **self._first_c}

    def check(self) -> None:
        """Nothing, if the run may go on.

        Raises:
            SphereMissing: too often in a row.
            TemperatureDrift: too far.
        """
        self._check_spheres()
        self._check_temperatures()

    def forgive(self) -> None:
        """Begin anew: somebody has looked at it."""
        self._missing.clear()
        self._first_c = dict(self._now_c)

    def _check_spheres(self) -> None:
        most = self._settings.most_missing_in_a_row
        for name, count in self._missing.items():
            if most is not None and count >= most:
                raise SphereMissing(
                    f"sphere {name} was not found in {count} shots in a row",
                    remedy=f"Is it in its place, clean and uncovered? Look at `spherecal centres`, then continue with --resume. {_SETTING}",
                )

    def _check_temperatures(self) -> None:
        largest = self._settings.largest_drift_k
        for name, now_c in self._now_c.items():
            drift = now_c - self._first_c[name]
            if largest is not None and abs(drift) > largest:
                raise TemperatureDrift(
                    f"the camera's temperature {name!r} is {now_c:.1f} degrees C, {drift:+.1f} K from that of the first shot",
                    remedy=f"Let it warm up (--warm-up) and take the plan again, or accept it with --resume. {_SETTING}",
                )


_SETTING = "Limits: `suspend` in the cell file."
