"""The simulated robot: what its controller would say, and motions on the cell's clock.

The controller knows only the nominal model: it reports the commanded axis angles (with encoder noise, where set) and
their nominal flange pose, never the true one. Not modelled: braking distance, blending, collisions, safety stops.
"""

from __future__ import annotations

from drivers.errors import MotionRefused, RobotNotReached
from drivers.kinematics import mdh
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import RobotInfo, RobotState
from drivers.readings import checked_target
from drivers.simulated.cell import SimulatedCell

_READING_S = 0.002


class SimulatedRobot:
    """A robot of the `Robot` protocol on a simulated cell."""

    def __init__(self, cell: SimulatedCell) -> None:
        self._cell = cell
        self._opened = False

    def open(self) -> RobotInfo:
        """Identity: nothing in it comes from the truth."""
        self._opened = True
        return RobotInfo(adapter="simulated", model=self._cell.model.name, controller="simulated cell")

    def read_state(self) -> RobotState:
        """Axis angles, nominal flange pose and whether it moves, now; a reading takes 2 ms.

        Raises:
            RobotNotReached: before `open` or after `close`.
        """
        self._check_open()
        self._cell.advance(_READING_S)
        joints = self._cell.read_joints_rad()
        flange = mdh.base_from_flange(self._cell.model, joints)
        return RobotState(joints_rad=joints, base_from_flange=flange, time_s=self._cell.clock_s, moving=self._cell.moving())

    def start_move(self, joints_rad: FloatArray, *, speed_rad_s: float) -> None:
        """Start a motion in which the fastest axis keeps `speed_rad_s`; the axes arrive together.

        Raises:
            MotionRefused: a target that is not n finite numbers within all limits, a speed that is not positive, or a
                motion still under way.
            RobotNotReached: before `open` or after `close`.
        """
        self._check_open()
        target = checked_target(self._cell.model, joints_rad, speed_rad_s=speed_rad_s)
        if self._cell.moving():
            raise MotionRefused("a motion is still under way", remedy="Wait until the robot stands, or stop it first.")
        self._cell.start_motion(target, speed_rad_s=float(speed_rad_s))

    def stop(self) -> None:
        """Stand still where the axes are now; without effect when they stand."""
        self._cell.stop_motion()

    def wait(self, seconds: float) -> None:
        """Let time pass on the cell's clock."""
        self._cell.advance(seconds)

    def close(self) -> None:
        """Release the robot; a motion under way goes on, as with a real controller."""
        self._opened = False

    def _check_open(self) -> None:
        if not self._opened:
            raise RobotNotReached("the simulated robot is not open", remedy="Open it first, e.g. in a `with devices:` block.")
