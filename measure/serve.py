"""The controller as master: its own program moves the robot and asks for pictures; we take, keep and judge them.

Two threads: the line's answers at once, whatever the camera does; the worker's owns camera and session. The line
protocol is that of docs/abb_protocol.md; `TRIG id q1..q6` is acknowledged, `RESULT id` says how far it is:

    EXPOSING   the robot must stand          EXPOSED   it may move on, the picture is being judged
    OK         kept, and good                NG why    not good, and why
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

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
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import Camera3D

EXPOSING, EXPOSED, OK, NG = "EXPOSING", "EXPOSED", "OK", "NG"
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

    def __init__(self) -> None:
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
        job = self._jobs.get(number)
        if job is None:
            raise Declined(Fault.TOKEN, "no such trigger")
        return str(number), job.state, *_words(job.reason)

    def _take(self, number: int, line: Line) -> tuple[str, ...]:
        if any(job.state == EXPOSING for job in self._jobs.values()):
            raise Declined(Fault.BUSY, "exposing")
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
    writer: SessionWriter
    orders: Orders
    tell: Callable[[Job], None] = lambda _: None
    """Called when a job is done."""
    frames: int = 1
    sphere_settings: SphereSettings = field(default_factory=SphereSettings)
    told: Mapping[str, str] = field(default_factory=dict)
    """What the camera told of itself when it was opened; a lost one that comes back must tell the same."""
    counts: dict[str, int] = field(default_factory=lambda: {OK: 0, NG: 0})
    _sequence: int = -1
    _lost: bool = False
    _last: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Know what a resumed session holds."""
        self._last = {shot.pose_id: shot.index for shot in self.writer.shots if shot.pose_id is not None and shot.status == "ok"}

    def work(self, waiting: queue.Queue[Job | None], most: int | None = None) -> None:
        """Work until None comes, or so many pictures are good. A camera whose link was lost is opened anew for the next picture.

        Raises:
            FileError: the session cannot be written.
            CameraError: the camera is set wrongly or not there, which another picture will not mend.
        """
        while (job := waiting.get()) is not None:
            self._take(job)
            self.counts[job.state] += 1
            self.tell(job)
            if most is not None and self.counts[OK] >= most:
                return

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
            shot = self.writer.append(
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
        job.index, job.reason = shot.index, reason or ""
        job.state = OK if reason is None else NG
