"""What the shots of a run say so far: a calibration of them, what it will be worth, and which pose would tell most next.

The solve runs in a process of its own, with little priority: it reads the session from disk, so a run never waits for it,
and a solver that hangs or dies costs a line on the screen and nothing else.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acquire.plan import PlannedPose
from drivers.errors import SpherecalError
from drivers.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from acquire.cell import Cell
    from calibrate.next_poses import Taken
    from calibrate.result import Calibration
    from drivers.files.session import Session
    from drivers.kinematics.mdh import RobotModel

FEWEST_SHOTS = 12
"""No run is ended early on fewer."""
_SOLVED_FROM = 6
_AS_PREDICTED = 2.0
"""Left-out shots may miss by this many times what was predicted before a prediction is no longer believed."""
_CLOSE_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """What the solver is asked."""

    session: Path
    waiting: tuple[PlannedPose, ...]
    """Poses of the plan that are still to be taken."""
    end_rad: FloatArray | None = None
    """(n,) where the robot stands, if poses beyond the plan are wanted from there."""


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """What it answers."""

    n_shots: int
    """Good shots of spheres in the session."""
    seconds: float
    trouble: str | None = None
    """Why there is no more than that."""
    left_out_rms_mm: float | None = None
    """Of shots that the solve left out."""
    predicted_centre_rms_mm: float | None = None
    length_u_mm: float | None = None
    """Expanded uncertainty (k = 2) of lengths over the work volume that these shots will leave, unmodelled physics included."""
    best: str | None = None
    """The pose of the plan that would tell most next."""
    further: tuple[PlannedPose, ...] = ()
    """Feasible poses beyond the plan, best first, each with a clear straight way from where the robot stands."""

    def reaches(self, length_u_mm: float) -> bool:
        """Whether enough is known: enough shots, the uncertainty asked for, and left-out shots that bear the prediction out."""
        if self.trouble is not None or self.length_u_mm is None or self.n_shots < FEWEST_SHOTS:
            return False
        measured, predicted = self.left_out_rms_mm, self.predicted_centre_rms_mm
        borne_out = measured is None or predicted is None or measured <= _AS_PREDICTED * predicted
        return borne_out and self.length_u_mm <= length_u_mm

    def lines(self, wanted_mm: float | None, done: Collection[str] = ()) -> tuple[str, ...]:
        """For the screen; `done` are poses that have been taken since the question."""
        if self.trouble is not None:
            return (f"solve {self.n_shots} shots: {self.trouble}"[:79],)
        left_out = "" if self.left_out_rms_mm is None else f", left-out shots {self.left_out_rms_mm:.3f} mm"
        goal = "" if wanted_mm is None else f", wanted {wanted_mm:g}"
        lengths = "" if self.length_u_mm is None else f"; lengths U {self.length_u_mm:.3f} mm (k = 2){goal}"
        return (
            f"solve {self.n_shots} shots{left_out}{lengths}",
            *((f"next  pose {self.best} would tell most",) if self.best and self.best not in done else ()),
        )


def solve_so_far(question: Question) -> Solved:
    """Solve what a session holds."""
    from threadpoolctl import threadpool_limits

    from drivers.files.session import read_session

    began, n_shots = time.perf_counter(), 0
    try:
        session = read_session(question.session)
        n_shots = sum(shot.status == "ok" and shot.sphere is not None for shot in session.shots)
        if n_shots < _SOLVED_FROM:
            return Solved(n_shots, time.perf_counter() - began, f"solved from {_SOLVED_FROM} on")
        with threadpool_limits(limits=1, user_api="blas"):
            solved = _solved(session, n_shots, question)
    except SpherecalError as error:
        return Solved(n_shots, time.perf_counter() - began, error.message)
    return replace(solved, seconds=time.perf_counter() - began)


def _solved(session: Session, n_shots: int, question: Question) -> Solved:
    from acquire.cell import cell_of_session, robot_model_of
    from calibrate.solve import CalibrationSettings, calibrate

    # a pillow, since choosing among models takes longer and changes little of what is asked here
    line_profile = (cell := cell_of_session(session)).camera.kind == "line_profile"
    calibration = calibrate([session], CalibrationSettings(camera_error="none" if line_profile else "pillow"))
    held_out = calibration.statistics.cross_validated_rms_mm
    solved = Solved(n_shots, 0.0, left_out_rms_mm=held_out)
    model = robot_model_of(cell, session)
    return solved if model is None else _predicted(solved, cell, model, session, calibration, question)


def _predicted(solved: Solved, cell: Cell, model: RobotModel, session: Session, calibration: Calibration, question: Question) -> Solved:
    from calibrate.design import best_next, information_of, predicted_of
    from calibrate.design_cell import PlacedLength, PlacedSphere, aim_of_cell, scene_of

    taken = _taken(cell, session, calibration)
    spheres = [
        PlacedSphere((float(c[0]), float(c[1]), float(c[2])), cell.spheres[name].diameter_mm, cell.spheres[name].expanded_uncertainty_mm)
        for name, c in zip(taken.names, taken.centres_in_base_mm, strict=True)
    ]
    row = {name: i for i, name in enumerate(taken.names)}
    lengths = [
        PlacedLength(row[x.between[0]], row[x.between[1]], x.expanded_uncertainty_mm) for x in cell.lengths if set(x.between) <= set(taken.names)
    ]
    found = cell.model_copy(update={"flange_from_camera": taken.flange_from_camera.tolist()})
    scene = scene_of(found, model, spheres, lengths, expectation=taken.expectation)
    aim = aim_of_cell(found, scene, np.random.default_rng(12))
    so_far = information_of(scene, taken.joints_rad, taken.sphere)
    predicted = predicted_of(so_far, aim, len(taken.joints_rad))
    done = {shot.pose_id for shot in session.shots if shot.status == "ok"}
    waiting = [pose for pose in question.waiting if pose.sphere in row and pose.id not in done]
    best = None
    if waiting:
        joints = np.array([pose.joints_rad for pose in waiting])
        best = waiting[int(best_next(scene, aim, so_far, joints, np.array([row[str(pose.sphere)] for pose in waiting]))[0])].id
    further = () if question.end_rad is None else _further(cell, model, taken, question.end_rad, len(session.all_shots))
    return replace(solved, predicted_centre_rms_mm=predicted.centre_rms_mm, length_u_mm=2 * predicted.length_rms_mm, best=best, further=further)


def _taken(cell: Cell, session: Session, calibration: Calibration) -> Taken:
    from calibrate.design_cell import expectation_of
    from calibrate.next_poses import Taken

    centres = calibration.sphere_centres_in_base_mm
    shots = [shot for shot in session.shots if shot.status == "ok" and shot.sphere in centres and shot.joints_rad is not None]
    names = tuple(name for name in cell.spheres if any(shot.sphere == name for shot in shots))
    return Taken(
        np.array([shot.joints_rad for shot in shots]),
        np.array([names.index(str(shot.sphere)) for shot in shots], dtype=np.int64),
        names,
        np.array([centres[name] for name in names]),
        np.asarray(calibration.flange_from_camera),
        expectation_of(calibration),
    )


def _further(cell: Cell, model: RobotModel, taken: Taken, begin_rad: FloatArray, number: int) -> tuple[PlannedPose, ...]:
    """Poses beyond the plan that a straight and clear way leads to from where the robot stands."""
    from acquire.collision import cell_collisions
    from calibrate.next_poses import next_best_poses

    check, names = cell_collisions(cell, model), (f"extra{number:03d}{letter}" for letter in "abcdefgh")
    poses = [pose for pose in next_best_poses(cell, model, taken) if check.trouble(begin_rad, pose.joints_rad) is None]
    return tuple(replace(pose, id=name) for pose, name in zip(poses, names, strict=False))


class SolveWorker:
    """The process that solves; always the newest question, one at a time. Use as a context manager."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._ours, self._theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(self._theirs,), daemon=True)
        self._next: Question | None = None
        self._is_busy = False
        self._is_dead = False

    def __enter__(self) -> SolveWorker:
        """Start it."""
        self._process.start()
        self._theirs.close()
        return self

    def __exit__(self, *_: object) -> None:
        """End it, whatever it does."""
        self._ours.close()
        self._process.terminate()
        self._process.join(_CLOSE_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    @property
    def is_idle(self) -> bool:
        """Whether nothing that was asked is open; so too when the process is gone."""
        return self._is_dead or not (self._is_busy or self._next)

    def ask(self, question: Question) -> None:
        """Ask; a question that was waiting for its turn is dropped."""
        self._next = question
        self._send()

    def poll(self, wait_s: float = 0.0) -> Solved | None:
        """An answer that has come, within so much time."""
        if self._is_dead:
            return None
        try:
            if not self._ours.poll(wait_s):
                return None
            answer = self._ours.recv()
        except (EOFError, OSError):
            self._is_dead = True
            return Solved(0, 0.0, "the solver has died; the run goes on without it")
        self._is_busy = False
        self._send()
        return answer if isinstance(answer, Solved) else None

    def _send(self) -> None:
        if self._next is None or self._is_busy or self._is_dead:
            return
        with suppress(OSError):
            self._ours.send(self._next)
        self._next, self._is_busy = None, True


def _serve(pipe: Connection) -> None:
    """The child: Ctrl-C is the parent's business, and when the parent is gone so is this."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(OSError):
        os.nice(10)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with suppress(EOFError, OSError):
        while True:
            pipe.send(solve_so_far(pipe.recv()))
