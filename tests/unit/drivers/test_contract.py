"""The contract on the simulated robot, and that the contract sees a robot that breaks it."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

from drivers.contract.checks import ContractBroken
from drivers.contract.robot import RobotContract, RobotRig
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model
from drivers.protocols import RobotState
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.robot import SimulatedRobot
from drivers.simulated.truth import Truth

MODEL = load_robot_model("ur5e")
HOME = np.array([0.1, -1.4, 1.3, -0.6, 0.4, 0.2])


def rig_of(robot_class: type[SimulatedRobot], truth: Truth) -> RobotRig:
    cell = SimulatedCell(truth, MODEL)
    return RobotRig(make=lambda: robot_class(cell), targets_rad=np.array([HOME, HOME + 0.6]), model=MODEL)


class TestSimulatedRobot(RobotContract):
    @pytest.fixture
    def rig(self) -> RobotRig:
        return rig_of(SimulatedRobot, Truth())


class Forgetful(SimulatedRobot):
    """Gives old readings."""

    def read_state(self) -> RobotState:
        return replace(super().read_state(), age_s=1.0)


class Frozen(SimulatedRobot):
    """Its clock stands."""

    def read_state(self) -> RobotState:
        return replace(super().read_state(), time_s=1.0)


class Metres(SimulatedRobot):
    """Reports its flange in metres."""

    def read_state(self) -> RobotState:
        state = super().read_state()
        pose = np.array(state.base_from_flange)
        pose[:3, 3] /= 1000
        return replace(state, base_from_flange=pose)


class Trusting(SimulatedRobot):
    """Sends what it is given, cut to its size."""

    def start_move(self, joints_rad: FloatArray, *, speed_rad_s: float) -> None:
        good = np.nan_to_num(np.resize(joints_rad, 6))
        super().start_move(np.clip(good, -6, 6), speed_rad_s=abs(speed_rad_s) if np.isfinite(speed_rad_s) and speed_rad_s else 0.1)


class Racing(SimulatedRobot):
    """Ignores the speed."""

    def start_move(self, joints_rad: FloatArray, *, speed_rad_s: float) -> None:
        super().start_move(joints_rad, speed_rad_s=10 * speed_rad_s)


class Runaway(SimulatedRobot):
    """Cannot be stopped."""

    def stop(self) -> None:
        pass


class Open(SimulatedRobot):
    """Reads without a link."""

    def close(self) -> None:
        pass


class TestTheContractSees:
    BROKEN: ClassVar[dict[str, tuple[type[SimulatedRobot], str]]] = {
        "old readings": (Forgetful, "test_readings_are_fresh_and_time_goes_on"),
        "a clock that stands": (Frozen, "test_readings_are_fresh_and_time_goes_on"),
        "metres": (Metres, "test_joints_and_flange_pose_agree"),
        "unchecked targets": (Trusting, "test_what_must_not_be_sent_is_refused_and_nothing_moves"),
        "a speed that is not kept": (Racing, "test_a_move_starts_at_once_ends_at_its_target_and_keeps_its_speed"),
        "a stop that does nothing": (Runaway, "test_stop_stops_and_the_next_motion_works"),
        "a program that ends with a moving arm": (Runaway, "test_an_exception_in_the_program_stops_the_robot"),
        "a link that never closes": (Open, "test_no_reading_without_a_link"),
    }

    @pytest.mark.parametrize("name", BROKEN)
    def test_a_robot_with(self, name: str) -> None:
        broken, promise = self.BROKEN[name]
        with pytest.raises(ContractBroken):
            getattr(RobotContract(), promise)(rig_of(broken, Truth()))
