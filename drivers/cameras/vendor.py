"""What the thin adapters of vendors' libraries share: a deadline for every call, one thread for the library, one way to make a frame.

Vendors' libraries may block for as long as they like. Each call runs on a thread of the camera's own; a call that is late
is given up, with its thread and whatever it still may return, and the camera must be opened anew.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from drivers.cameras.points import optical_points_mm
from drivers.errors import CameraLost, CameraNotReached, CameraTimeout, InvalidFrame, SpherecalError
from drivers.protocols import CameraInfo, Frame3D

Result = TypeVar("Result")
CONNECT_S = 30.0
_CLOSE_S = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class VendorScan:
    """One scan as the vendor's library gives it."""

    points_mm: ArrayLike
    """(height, width, 3), optical frame, holes NaN or (0, 0, 0)."""
    quality: ArrayLike | None = None
    quality_kind: Literal["snr", "confidence"] | None = None
    temperatures_c: Mapping[str, float] = field(default_factory=dict)
    diagnostics: Mapping[str, float | int | str] = field(default_factory=dict)


class VendorSession(Protocol):
    """One connection by a vendor's library. It may block, and any exception of the library's may come out of it."""

    def connect(self) -> CameraInfo:
        """Load the library, connect, set everything."""
        ...

    def scan(self, timeout_s: float) -> VendorScan:
        """Trigger, and the scan that follows."""
        ...

    def disconnect(self) -> None:
        """Give the camera back."""
        ...


class VendorCamera:
    """A camera behind a vendor's library. Satisfies `drivers.protocols.Camera3D`.

    Args:
        name: of the driver, for messages.
        make_session: a new, unconnected session.
        connect_s: longest time of `open`; vendors' libraries look for their cameras first.
    """

    def __init__(self, name: str, make_session: Callable[[], VendorSession], *, connect_s: float = CONNECT_S) -> None:
        self._name, self._make_session, self._connect_s = name, make_session, connect_s
        self._session: VendorSession | None = None
        self._thread: _OwnThread | None = None
        self._lost: str | None = None
        self._sequence = 0

    def open(self) -> CameraInfo:
        """Connect, with a new session and a new thread.

        Raises:
            CameraNotReached: nobody answers in time, or the library says so.
            SpherecalError: as the session does (busy, misconfigured, library or a settings file missing).
        """
        self.close()
        session, thread = self._make_session(), _OwnThread(self._name)
        try:
            info = thread.run(session.connect, self._connect_s)
        except SpherecalError:
            thread.end()
            raise
        except _Late as error:
            thread.end()
            remedy = "Check cable, power and address."
            raise CameraNotReached(f"the {self._name} camera did not connect within {self._connect_s:g} s", remedy=remedy) from error
        except Exception as error:
            thread.end()
            raise CameraNotReached(f"the {self._name} camera does not connect ({error})", remedy="Check cable, power and address.") from error
        self._session, self._thread = session, thread
        return info

    def capture(self, *, timeout_s: float) -> Frame3D:
        """Trigger, and the scan that follows.

        Raises:
            CameraNotReached: not open.
            CameraTimeout: the library said so, or did not come back; in the latter case the camera must be opened anew.
            CameraLost: the library failed.
            InvalidFrame: the scan has no three coordinates a point.
        """
        if self._lost is not None:
            raise CameraLost(self._lost, remedy="Open the camera anew.")
        if self._session is None or self._thread is None:
            raise CameraNotReached(f"the {self._name} camera is not open", remedy="Open it first.")
        session, called_s = self._session, time.monotonic()
        try:
            scan = self._thread.run(lambda: session.scan(timeout_s), timeout_s)
        except SpherecalError:
            raise
        except _Late as error:
            self._lost = f"the {self._name} library did not come back within {timeout_s:g} s"
            raise CameraTimeout(self._lost, remedy="Allow more time, and open the camera anew.") from error
        except Exception as error:
            self._lost = f"the {self._name} camera fails ({error})"
            raise CameraLost(self._lost, remedy="Check cable and power, and open the camera anew.") from error
        self._sequence += 1
        return vendor_frame(scan, self._sequence, called_s)

    def close(self) -> None:
        """Disconnect, as far as the library lets us."""
        session, thread, is_lost = self._session, self._thread, self._lost is not None
        self._session = self._thread = self._lost = None
        if session is not None and thread is not None:
            if not is_lost:
                with suppress(Exception):
                    thread.run(session.disconnect, _CLOSE_S)
            thread.end()


def vendor_frame(scan: VendorScan, sequence: int, called_s: float) -> Frame3D:
    """A scan as a frame; every array is owned.

    Raises:
        InvalidFrame: points that are not (height, width, 3).
    """
    points = np.asarray(scan.points_mm)
    if points.ndim != 3 or points.shape[-1] != 3 or points.dtype.kind != "f":
        found = f"the scan is {points.shape} of {points.dtype}"
        raise InvalidFrame(found, remedy="Let the camera give point clouds; this library's version may be another than was written for.")
    xyz_mm = optical_points_mm(points, unit_mm=1.0)
    quality = None if scan.quality is None else np.array(scan.quality, dtype=np.float32, order="C", copy=True)
    fits = quality is not None and quality.shape == xyz_mm.shape[:2]
    return Frame3D(
        xyz_mm=xyz_mm,
        sequence=sequence,
        time_s=called_s,
        temperatures_c=dict(scan.temperatures_c),
        quality=quality if fits else None,
        quality_kind=scan.quality_kind if fits else None,
        done_s=time.monotonic(),
        diagnostics=dict(scan.diagnostics),
    )


class _Late(Exception):
    """A call did not come back in time."""


class _OwnThread:
    """One daemon thread that makes one call after the other."""

    def __init__(self, name: str) -> None:
        self._calls: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        threading.Thread(target=self._serve, name=f"camera-{name}", daemon=True).start()

    def run(self, function: Callable[[], Result], timeout_s: float) -> Result:
        """The function's result, or what it raised.

        Raises:
            _Late: it did not come back in time; the thread is of no use any more.
        """
        answers: SimpleQueue[tuple[Result | None, BaseException | None]] = SimpleQueue()

        def call() -> None:
            try:
                answers.put((function(), None))
            except BaseException as error:
                answers.put((None, error))

        self._calls.put(call)
        try:
            result, error = answers.get(timeout=max(timeout_s, 0.0))
        except Empty:
            raise _Late from None
        if error is not None:
            raise error
        return result  # type: ignore[return-value]

    def end(self) -> None:
        """Let the thread end when it comes back."""
        self._calls.put(None)

    def _serve(self) -> None:
        while (call := self._calls.get()) is not None:
            call()


@contextmanager
def stdout_to_stderr() -> Iterator[None]:
    """What a C library prints to stdout goes to stderr meanwhile: stdout belongs to `--json`."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        os.dup2(2, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
