"""The states of a capture run, and which may follow which."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum


class RunState(StrEnum):
    """Where a run is. The robot can only be moving in `MOVING`."""

    READY = "ready"
    """The robot stands, nothing is under way: before the first pose, between two, and about to go to one."""
    MOVING = "moving"
    SETTLING = "settling"
    """The robot has arrived and comes to rest; or it stands while the camera warms up."""
    CAPTURING = "capturing"
    PAUSED = "paused"
    """By command, or suspended: something is wrong and somebody is asked."""
    DONE = "done"
    """All poses were begun, or what was wanted is reached."""
    ABORTED = "aborted"
    """A Stop ended it."""
    FAILED = "failed"
    """An error ended it."""

    @property
    def is_end(self) -> bool:
        """Whether nothing follows."""
        return self in {RunState.DONE, RunState.ABORTED, RunState.FAILED}


_ANYWHERE = frozenset({RunState.PAUSED, RunState.ABORTED, RunState.FAILED})

FOLLOWERS: Mapping[RunState, frozenset[RunState]] = {
    RunState.READY: _ANYWHERE | {RunState.READY, RunState.MOVING, RunState.SETTLING, RunState.DONE},
    RunState.MOVING: _ANYWHERE | {RunState.MOVING, RunState.SETTLING, RunState.READY},
    RunState.SETTLING: _ANYWHERE | {RunState.SETTLING, RunState.CAPTURING, RunState.READY},
    RunState.CAPTURING: _ANYWHERE | {RunState.CAPTURING, RunState.READY},
    RunState.PAUSED: _ANYWHERE | {RunState.READY, RunState.SETTLING, RunState.DONE},
    RunState.DONE: frozenset(),
    RunState.ABORTED: frozenset(),
    RunState.FAILED: frozenset(),
}
"""What may come after a state; between two poses a run is ready."""
