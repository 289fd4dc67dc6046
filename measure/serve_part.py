"""The verdict for a controller that owns the motion: the pictures of a part are fused as they come, RESULT 0 asks what the part is worth.

One thread of its own fuses, judges and writes, in the order in which things came, while the next picture is exposed.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

from acquire.session import SessionWriter
from calibrate.result import Calibration
from drivers.errors import SpherecalError
from drivers.files.ply import PointCloud
from drivers.files.session import Session, Shot, read_session
from measure.history.recording import last_taken_utc, record_result
from measure.inspecting.inspection import with_deviations
from measure.inspecting.outputs import write_outputs
from measure.part import Drawing, MeasuredPart, PartInProgress
from measure.stitch import StitchSettings

_LOG = logging.getLogger(__name__)

Told = Callable[[str, str], None]
"""Called with the verdict, or `error`, and the first reason, once it is known."""


@dataclass(frozen=True, slots=True)
class PartPlaces:
    """Where parts go: a session each, and a folder of results each, both under its number."""

    sessions: Path
    results: Path
    calibration: Path
    """The file."""
    history: str | None = None

    def next_number(self) -> str:
        """Of the next part: the one after the greatest that either place knows."""
        names = [path.name for place in (self.sessions, self.results) if place.is_dir() for path in place.iterdir()]
        return f"{1 + max((int(name) for name in names if name.isdigit()), default=0):04d}"


@dataclass(slots=True, eq=False)
class PartLine:
    """Parts one after the other; a context manager, which waits for results that are still being written."""

    calibration: Calibration
    drawing: Drawing
    places: PartPlaces
    open_session: Callable[[Path], SessionWriter]
    """Begins a session in a folder."""
    say: Callable[[str], None]
    settings: StitchSettings = field(default_factory=StitchSettings)
    counts: dict[str, int] = field(default_factory=dict)
    """Parts by verdict."""
    number: str = ""
    """Of the part at work."""
    writer: SessionWriter | None = None
    """Its session; None between two parts."""
    _part: PartInProgress | None = None
    _session: Session | None = None
    _thread: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1, thread_name_prefix="part"))
    _waiting: list[Future[None]] = field(default_factory=list)

    def begin(self) -> SessionWriter:
        """The session of the part at work, begun where there is none.

        Raises:
            FileError: it cannot be made.
        """
        if self.writer is None:
            self.places.sessions.mkdir(parents=True, exist_ok=True)
            self.number = self.places.next_number()
            self.writer = self.open_session(self.places.sessions / self.number)
            self._part, self._session = PartInProgress(self.calibration, self.settings), None
        return self.writer

    def add(self, shot: Shot, xyz_mm: PointCloud) -> None:
        """Have a picture fused that is on disk already."""
        part, folder = self._part, self.places.sessions / self.number
        if part is not None:
            self._submit(lambda: self._fuse(part, folder, shot, xyz_mm))

    def judge(self, told: Told) -> None:
        """Close the part; `told` is called from another thread when its verdict is known, before anything is written."""
        part, writer, number = self._part, self.writer, self.number
        self._part = self._session = self.writer = None
        if part is None or writer is None:
            told("error", "no picture of this part")
            return
        writer.close()
        began = time.perf_counter()
        self._submit(lambda: self._finish(part, number, began, told))

    def _submit(self, work: Callable[[], None]) -> None:
        self._waiting = [future for future in self._waiting if not future.done()]
        self._waiting.append(self._thread.submit(work))

    def _fuse(self, part: PartInProgress, folder: Path, shot: Shot, cloud: PointCloud) -> None:
        try:
            part.add(self._read_once(folder), shot, cloud)
        except SpherecalError as error:
            # the verdict reads the scan again, and then this is its reason
            _LOG.warning("picture %s was not fused: %s", shot.index, error)

    def _read_once(self, folder: Path) -> Session:
        """A session's head; its shots come one by one."""
        if self._session is None or self._session.folder != folder:
            self._session = read_session(folder)
        return self._session

    def _finish(self, part: PartInProgress, number: str, began: float, told: Told) -> None:
        folder = self.places.results / number
        try:
            session = read_session(self.places.sessions / number)
            measured = part.judged(session, self.drawing, folder, began=began)
        except SpherecalError as error:
            self._tell(number, "error", str(error), told)
            return
        except Exception:
            self._tell(number, "error", "a bug in spherecal", told)
            raise
        found = measured.inspection
        self._tell(number, found.verdict, f"{found.reasons[0] if found.reasons else ''} ({found.seconds_to_verdict:.2f} s)", told)
        try:
            self._write(session, measured, folder)
        except SpherecalError as error:
            self.say(f"warning: part {number}: the results are not written: {error}")

    def _tell(self, number: str, verdict: str, reason: str, told: Told) -> None:
        self.counts[verdict] = self.counts.get(verdict, 0) + 1
        told(verdict, reason)
        self.say(f"part {number}: {verdict.replace('_', ' ')}: {reason}")

    def _write(self, session: Session, measured: MeasuredPart, folder: Path) -> None:
        found = with_deviations(measured.inspection, measured.cloud(), self.drawing.nominal, self.drawing.spec)
        self.places.results.mkdir(parents=True, exist_ok=True)
        write_outputs(folder, found, recording=False, add=measured.write_cloud)
        content: Mapping[str, object] = {"part": folder.name, **found.to_json_dict(), "out": str(folder)}
        taken_utc = last_taken_utc([session])
        record_result(self.places.history, "inspection", self.calibration, self.places.calibration, content, self.say, taken_utc=taken_utc)

    def warm_up(self) -> None:
        """Load what the first verdict would wait for; the robot is on its way to the first picture meanwhile."""
        self._submit(lambda: load_inspection(self.drawing))

    def __enter__(self) -> Self:
        """The line itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """End; a part that nobody asked the verdict of stays as a session."""
        if self.writer is not None:
            self.writer.close()
        self._thread.shutdown(wait=True)
        failed = next((future for future in self._waiting if future.done() and future.exception() is not None), None)
        if failed is not None and kind is None:
            failed.result()


def load_inspection(drawing: Drawing) -> None:
    """Import and compile what an inspection of this drawing uses."""
    import scipy.linalg
    import scipy.spatial  # noqa: F401  the fits import them when they run

    from calibrate import placing_kernels  # noqa: F401
    from measure import fuse_kernels  # noqa: F401
    from measure.inspecting.distance import NominalSurface
    from measure.inspecting.spec import ProfileCheck
    from measure.stitching import scan_kernels  # noqa: F401

    if drawing.spec.alignment.method == "best_fit" or any(isinstance(check, ProfileCheck) for check in drawing.spec.checks):
        NominalSurface.of(drawing.nominal)
