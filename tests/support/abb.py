"""A simulated IRC5 with a small cell, and adapters for it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from drivers.abb.adapter import AbbRobot
from drivers.abb.settings import AbbSettings, parse_settings
from drivers.contract.robot import RobotRig
from drivers.kinematics.mdh import RobotModel
from drivers.models import load_robot_model
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.controllers.abb import AbbController
from drivers.simulated.truth import Truth
from tests.support.simulated import exact_camera

TARGETS_DEG = np.array([[0.0, 0.0, 0.0, 0.0, 10.0, 0.0], [15.0, 9.0, -6.0, 12.0, 0.0, -14.321]])
SPEED_RAD_S = 0.9


def abb_model() -> RobotModel:
    """The shipped IRB 1410."""
    return load_robot_model("abb_irb1410")


def abb_cell() -> SimulatedCell:
    """A robot without any error."""
    return SimulatedCell(Truth(seed=1, camera=exact_camera()), abb_model())


@contextmanager
def controller(*, cell: SimulatedCell | None = None, speed_up: float = 1.0) -> Iterator[AbbController]:
    """A started controller on free ports."""
    made = AbbController(cell or abb_cell(), bench_port=0, speed_up=speed_up)
    made.start()
    try:
        yield made
    finally:
        made.close()


def robot_over_tcp(of: AbbController, *, state: bool = True, **settings: object) -> AbbRobot:
    """An adapter for it, not opened; with or without the second program."""
    second = {"state_port": of.state_port} if state else {}
    return AbbRobot(parse_settings({"host": of.host, "port": of.port, **second, **settings}), abb_model())


def robot_over_pty(of: AbbController, **settings: object) -> AbbRobot:
    """An adapter for its serial line, not opened."""
    return AbbRobot(parse_settings({"serial_port": of.serial_port, "baud": 38400, **settings}), abb_model())


def rig(of: AbbController) -> RobotRig:
    """For the contract tests."""

    def nobody(fault: str) -> AbbRobot:
        of.fault(fault)
        return robot_over_tcp(of)

    return RobotRig(
        make=lambda: robot_over_tcp(of),
        targets_rad=np.radians(TARGETS_DEG[:2]),
        speed_rad_s=SPEED_RAD_S,
        model=abb_model(),
        nobody={name: lambda name=name: nobody(name) for name in ("refuse", "black_hole")},  # type: ignore[misc]
        faults={name: lambda name=name: of.fault(name) for name in ("silence", "drop", "stale", "protective_stop", "emergency_stop")},  # type: ignore[misc]
        clear=of.clear,
        n_motions=of.n_motions,
    )


def settings_of(**values: object) -> AbbSettings:
    """Checked settings."""
    return parse_settings(values)
