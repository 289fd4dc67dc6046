"""The controller as master: its own program moves the robot and asks for pictures; we take, keep and judge them.

Two threads: the line's answers at once, whatever the camera does; the worker's owns camera and session. The line
protocol is that of docs/abb_protocol.md; `TRIG id q1..q6` is acknowledged, `RESULT id` says how far it is:

    EXPOSING   the robot must stand          EXPOSED   it may move on, the picture is being judged
    OK         kept, and good                NG why    not good, and why

Where parts are inspected, `RESULT 0` after the last picture asks for the part's own OK or NG (`measure.serve_part`).
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from acquire.capture_shots import diagnostics_of
from acquire.cell import Cell
from acquire.exposure import Exposure, average, expose
from acquire.identity import reopen_camera
from acquire.plan import PlannedPose
from acquire.session import SessionWriter
from acquire.sighting import base_from_flange_of, look_for, predicted_centre_in_camera_mm
from acquire.sphere import SphereNotFound, SphereSettings
from drivers.abb.answers import Answerer, Declined
from drivers.abb.protocol import LAST_NUMBER, MASTER_VERBS, N_AXES, VERSION, Fault, Line, Verb, numbers, whole
from drivers.errors import CameraError, CameraLost, SpherecalError
from drivers.files.ply import PointCloud
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import Camera3D

if TYPE_CHECKING:
    from measure.serve_part import PartLine

EXPOSING, EXPOSED, OK, NG = "EXPOSING", "EXPOSED", "OK", "NG"
PART = 0
"""The number that stands for the part as a whole."""
_SAME_POSE_RAD = 0.01
_LONGEST_REASON = 48
_FRAME_TIMEOUT_S = 10.0


@dataclass(slots=True, eq=False)
class Job:
    """One trigger."""

    id: int
    joints_rad: FloatArray
    """(n,) as the controller's program sent them."""
    state: str = EXPOSING
    reason: str = ""
    index: int | None = None
    """Index of its shot in the session, once it is on disk."""


@dataclass(frozen=True, slots=True)
class Orders:
    """What is to be seen in each picture."""

    poses: tuple[PlannedPose, ...] = ()
    """Trigger 1 belongs to the first; empty: no plan."""
    sphere: str | None = None
    """Without a plan: the sphere of every picture, None for a workpiece."""

    def of(self, job: Job) -> tuple[str | None, str | None]:
        """The sphere of a job, and why it cannot be taken; None where it can."""
        if not self.poses:
            return self.sphere, None
        if not 1 <= job.id <= len(self.poses):
            return None, f"the plan has no pose {job.id}"
        pose = self.poses[job.id - 1]
        off = float(np.abs(job.joints_rad - pose.joints_rad).max())
        return pose.sphere, None if off <= _SAME_POSE_RAD else f"{np.degrees(off):.2f} degrees from pose {pose.id}"

    def pose_id(self, job: Job) -> str:
        """What the session calls it."""
        return self.poses[job.id - 1].id if 1 <= job.id <= len(self.poses) else f"trigger{job.id}"


class CellDesk:
    """Answers the controller; a trigger becomes a job in the queue."""

    def __init__(self, *, judges_parts: bool = False) -> None:
        """A desk; where it judges parts, RESULT 0 closes the part at work and asks for its verdict, and the next trigger begins another."""
        self._judges_parts = judges_parts
        self._answers = Answerer(self._do, MASTER_VERBS)
        self._lock = threading.Lock()
        self._jobs: dict[int, Job] = {}
        self.waiting: queue.Queue[Job | None] = queue.Queue()

    def answer(self, data: bytes) -> bytes:
        """The reply to a line; at once, and never an exception."""
        with self._lock:
            return self._answers.answer(data)

    def forget(self) -> None:
        """Another connection: its numbers are its own."""
        with self._lock:
            self._answers.forget()

    def _do(self, line: Line) -> tuple[str, ...]:
        if line.word == Verb.HELLO:
            return str(VERSION), "0"
        number = whole(line.arguments[0], LAST_NUMBER)
        if line.word == Verb.TRIGGER:
            return self._take(number, line)
        job = self._closed_part() if self._judges_parts and number == PART else self._jobs.get(number)
        if job is None:
            raise Declined(Fault.TOKEN, "no such trigger")
        state = EXPOSING if job.id == PART and self._is_exposing() else job.state
        return str(number), state, *_words(job.reason)

    def _is_exposing(self) -> bool:
        return any(job.state == EXPOSING for job in self._jobs.values())

    def _closed_part(self) -> Job:
        if PART not in self._jobs:
            # to the controller it is as a picture that is being judged: its programs for pictures serve for parts
            self._jobs[PART] = Job(PART, np.zeros(0), EXPOSED)
            self.waiting.put(self._jobs[PART])
        return self._jobs[PART]

    def _take(self, number: int, line: Line) -> tuple[str, ...]:
        if self._judges_parts and number == PART:
            raise Declined(Fault.TOKEN, "0 is the part")
        if self._is_exposing():
            raise Declined(Fault.BUSY, "exposing")
        if self._judges_parts and PART in self._jobs:
            self._jobs.clear()
        job = Job(number, np.radians(numbers(line.arguments[1:], N_AXES)))
        self._jobs[number] = job
        self.waiting.put(job)
        return (str(number),)


def _words(reason: str) -> list[str]:
    plain = "".join(character if 32 < ord(character) < 127 and character != "*" else " " for character in reason)
    return plain[:_LONGEST_REASON].split()


@dataclass(slots=True)
class CellWorker:
    """Takes the pictures of the jobs, one after the other, and keeps them."""

    cell: Cell
    model: RobotModel | None
    camera: Camera3D
    writer: SessionWriter | None
    """None where `parts` opens a session for each."""
    orders: Orders
    tell: Callable[[Job], None] = lambda _: None
    """Called when a job is done."""
    frames: int = 1
    sphere_settings: SphereSettings = field(default_factory=SphereSettings)
    parts: PartLine | None = None
    """Where parts are inspected; it then gives the session of each."""
    told: Mapping[str, str] = field(default_factory=dict)
    """What the camera told of itself when it was opened; a lost one that comes back must tell the same."""
    counts: dict[str, int] = field(default_factory=lambda: {OK: 0, NG: 0})
    _sequence: int = -1
    _lost: bool = False
    _last: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Know what a resumed session holds."""
        held = () if self.writer is None else self.writer.shots
        self._last = {shot.pose_id: shot.index for shot in held if shot.pose_id is not None and shot.status == "ok"}

    def work(self, waiting: queue.Queue[Job | None], most: int | None = None) -> None:
        """Work until None comes, or so many pictures are good; where parts are judged, until so many are.

        A camera whose link was lost is opened anew for the next picture.

        Raises:
            FileError: the session cannot be written.
            CameraError: the camera is set wrongly or not there, which another picture will not mend.
        """
        n_parts = 0
        while (job := waiting.get()) is not None:
            if self.parts is not None and job.id == PART:
                self._judge_part(self.parts, job)
                n_parts += 1
            else:
                self._take(job)
                self.counts[job.state] += 1
                self.tell(job)
            if most is not None and (n_parts if self.parts is not None else self.counts[OK]) >= most:
                return

    def _judge_part(self, parts: PartLine, job: Job) -> None:
        def told(verdict: str, reason: str) -> None:
            job.reason = "" if verdict == "conform" else f"{verdict}: {reason}"
            job.state = OK if verdict == "conform" else NG

        self._last = {}
        parts.judge(told)

    def _session(self) -> SessionWriter:
        writer = self.writer if self.parts is None else self.parts.begin()
        if writer is None:
            raise ValueError("neither a session nor parts")
        return writer

    def _take(self, job: Job) -> None:
        sphere, hindrance = self.orders.of(job)
        if hindrance is not None:
            self._fail(job, sphere, hindrance)
            return
        try:
            exposure = self._expose()
        except CameraError as error:
            self._fail(job, sphere, str(error))
            self._lost = self._lost or isinstance(error, CameraLost)
            if not (error.retryable or self._lost):
                raise
            return
        job.state = EXPOSED
        self._judge(job, sphere, exposure)

    def _expose(self) -> Exposure:
        if self._lost:
            reopen_camera(self.camera, self.told)
            self._lost, self._sequence = False, -1
        exposure = Exposure()
        while len(exposure.frames) < self.frames:
            exposure = expose(self.camera, exposure, after=self._sequence, timeout_s=_FRAME_TIMEOUT_S)
            self._sequence = exposure.frames[-1].sequence
        return exposure

    def _judge(self, job: Job, sphere: str | None, exposure: Exposure) -> None:
        xyz_mm = average(exposure.frames)
        flange = base_from_flange_of(self.model, job.joints_rad, None)
        reason = None
        if sphere is not None:
            try:
                look_for(self.cell, sphere, xyz_mm, predicted_centre_in_camera_mm(self.cell, sphere, flange), self.sphere_settings)
            except SphereNotFound as error:
                reason = f"{error.reason}: {error}"
        self._keep(job, sphere, reason, exposure)

    def _fail(self, job: Job, sphere: str | None, reason: str) -> None:
        self._keep(job, sphere, reason, None)

    def _keep(self, job: Job, sphere: str | None, reason: str | None, exposure: Exposure | None) -> None:
        pose_id = self.orders.pose_id(job)
        frames = () if exposure is None else exposure.frames
        try:
            shot = self._session().append(
                sphere=sphere,
                joints_rad=job.joints_rad,
                xyz_mm=average(frames) if frames else None,
                intensity=frames[0].intensity if len(frames) == 1 else None,
                frames_xyz_mm=[frame.xyz_mm for frame in frames] if len(frames) > 1 else (),
                status="ok" if reason is None else "failed",
                reason=reason,
                pose_id=pose_id,
                replaces=self._last.get(pose_id) if reason is None else None,
                temperatures_c=frames[-1].temperatures_c if frames else None,
                extra={"diagnostics": diagnostics_of(frames)} if frames and frames[-1].diagnostics else None,
            )
        except SpherecalError as error:
            job.reason, job.state = str(error), NG
            raise
        if reason is None:
            self._last[pose_id] = shot.index
            if self.parts is not None:
                self.parts.add(shot, PointCloud(average(frames).astype(np.float32)))
        job.index, job.reason = shot.index, reason or ""
        job.state = OK if reason is None else NG
