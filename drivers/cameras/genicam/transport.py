"""What the GenICam adapter needs of a transport: features by name, a stream, frames as parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from drivers.cameras.genicam.decode import Part


@dataclass(frozen=True, slots=True, eq=False)
class Payload:
    """One frame as it came, its parts owned copies."""

    parts: tuple[Part, ...]
    frame_id: int
    """The camera's own number; it may wrap."""
    timestamp_ns: int | None
    fault: str | None
    """Why the frame is not whole, None where it is."""


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """Who answered."""

    vendor: str | None
    model: str | None
    serial: str | None
    firmware: str | None
    library: str
    notes: tuple[str, ...] = ()
    """What an operator should know of the way to the camera."""


class Transport(Protocol):
    """A way to one camera. Every call ends in time; errors are those of `drivers/errors.py`."""

    def open(self) -> DeviceIdentity:
        """Connect to the camera at the address, with control over it.

        Raises:
            CameraNotReached, CameraBusy, CameraSdkMissing, CameraMisconfigured.
        """
        ...

    def get(self, feature: str) -> str | None:
        """The value of a feature as text, None where it is absent or cannot be read now.

        Raises:
            CameraLost: the camera does not answer.
        """
        ...

    def put(self, feature: str, value: str) -> None:
        """Set a feature.

        Raises:
            CameraMisconfigured: it is absent, or does not take the value.
            CameraLost: the camera does not answer.
        """
        ...

    def execute(self, command: str) -> None:
        """Run a command feature; raises as `put`."""
        ...

    def start(self) -> None:
        """Make buffers and let the camera send; raises as `put`."""
        ...

    def stop(self) -> None:
        """End the stream and forget every frame in it; without effect when there is none. Never raises."""
        ...

    def drain(self) -> int:
        """Throw away the frames that lie in the queue; how many."""
        ...

    def fetch(self, timeout_s: float) -> Payload | None:
        """The next frame, whole or not; None when none came in time."""
        ...

    def statistics(self) -> Mapping[str, float | int | str]:
        """Of the stream: packets lost and resent, packet size."""
        ...

    def close(self) -> None:
        """Give the camera back; safe to call twice and after errors. Never raises."""
        ...
