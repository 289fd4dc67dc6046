"""What a running solve makes of a run: it ends when enough is known, and goes beyond its plan where that is wanted."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from acquire.events import Append, Captured, Command, Event, Failed, Finish, PoseStarted, Skipped
from acquire.plan import Plan
from measure.running_solve import Question, Solved

_RECORDED = (Captured, Failed, Skipped)


class Solver(Protocol):
    """Answers questions in its own time."""

    @property
    def is_idle(self) -> bool:
        """Whether nothing is open."""
        ...

    def ask(self, question: Question) -> None:
        """Ask the newest question."""
        ...

    def poll(self, wait_s: float = 0.0) -> Solved | None:
        """An answer, if there is one."""
        ...


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a run is to reach."""

    length_u_mm: float | None = None
    """End early when the expanded uncertainty of lengths is predicted to be this."""
    most_further: int = 0
    """Poses beyond the plan, one after the other, while it is not."""
    longest_wait_s: float = 60.0
    """For the solver, the robot standing at the end of its plan."""


class Advice:
    """Watches a run and its solver."""

    def __init__(self, solver: Solver, session: Path, plan: Plan, wanted: Wanted, show: Callable[[tuple[str, ...]], None]) -> None:
        self._solver, self._session, self._plan, self._wanted, self._show = solver, session, plan, wanted, show
        self._done: set[str] = set()
        self._at: PoseStarted | None = None
        self._n_further = 0
        self._tried: set[bytes] = set()
        self._solved: Solved | None = None
        self.reached = False
        """Whether what was wanted is reached."""

    def command_at(self, event: Event) -> Command | None:
        """Finish, Append, or nothing."""
        if isinstance(event, PoseStarted):
            self._at = event
        if isinstance(event, _RECORDED):
            self._done.add(event.pose_id)
            self._ask()
        self._take(0.0)
        if self._is_reached():
            self.reached = True
            return Finish()
        return self._beyond() if isinstance(event, _RECORDED) and self._may_go_beyond else None

    @property
    def _may_go_beyond(self) -> bool:
        return self._at is not None and self._at.number == self._at.n_poses and self._n_further < self._wanted.most_further

    def _ask(self) -> None:
        waiting = tuple(pose for pose in self._plan.poses if pose.id not in self._done)
        end_rad = self._at.pose.joints_rad if self._at is not None and self._may_go_beyond else None
        self._solver.ask(Question(self._session, waiting, end_rad))

    def _take(self, wait_s: float) -> None:
        solved = self._solver.poll(wait_s)
        if solved is not None:
            self._solved = solved
            self._show(solved.lines(self._wanted.length_u_mm, self._done))

    def _is_reached(self) -> bool:
        wanted = self._wanted.length_u_mm
        return wanted is not None and self._solved is not None and self._solved.reaches(wanted)

    def _beyond(self) -> Command | None:
        """At the end of the plan the robot stands, and there is time to hear what the last shot said."""
        deadline = time.monotonic() + self._wanted.longest_wait_s
        while not self._solver.is_idle and time.monotonic() < deadline:
            self._take(0.2)
        if self._is_reached():
            self.reached = True
            return Finish()
        further = () if self._solved is None else self._solved.further
        new = [pose for pose in further if pose.joints_rad.tobytes() not in self._tried]
        if not new:
            return None
        self._n_further += 1
        self._tried.add(new[0].joints_rad.tobytes())
        return Append(new[0])
