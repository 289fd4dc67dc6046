"""A robot under the contract tests, and what can be done to its controller."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import Robot


def _nothing() -> None:
    """A controller that needs no clearing."""


@dataclass(frozen=True, slots=True)
class RobotRig:
    """A robot to be tested, and what can be done to its controller."""

    make: Callable[[], Robot]
    """A new adapter, not opened, for the one controller of this rig."""
    targets_rad: FloatArray
    """(k >= 2, n) axis angles it may go to in any order; the robot stands at the first one or near it."""
    speed_rad_s: float = 0.5
    model: RobotModel | None = None
    nobody: Mapping[str, Callable[[], Robot]] = field(default_factory=dict)
    """Adapters for addresses where nobody is: `refuses`, `black_hole`."""
    faults: Mapping[str, Callable[[], None]] = field(default_factory=dict)
    """How to make the controller misbehave: `silence`, `drop`, `stale`, `protective_stop`, `emergency_stop`."""
    clear: Callable[[], None] = _nothing
    """Make it behave again, as an operator would."""
    n_motions: Callable[[], int] | None = None
    """How many motions the controller has begun; proves that nothing is replayed."""
    arrival_tolerance_rad: float = 2e-3
