"""A simulated IRC5 from a robot model and a truth."""

from __future__ import annotations

from pathlib import Path

from drivers.abb.protocol import N_AXES
from drivers.errors import SettingsError
from drivers.kinematics.mdh import RobotModel
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.controllers.abb import AbbController
from drivers.simulated.truth import Truth

PORT = 5000


def make_abb_controller(
    model: RobotModel,
    truth: Truth | None,
    host: str,
    *,
    port: int = PORT,
    bench_port: int,
    speed_up: float = 1.0,
    folder: Path | None = None,
) -> AbbController:
    """A controller, not yet serving.

    Args:
        model: the nominal robot, with 6 axes.
        truth: what the robot truly is; None for a robot without errors.
        host: a loopback address.
        port: of the program that moves; the second program has the next one. 0 for any free ones.
        bench_port: 0 for any free one.
        speed_up: how much faster than real the robot moves.
        folder: where a truth's mesh lies.

    Raises:
        SettingsError: no loopback address, a port that is taken, or a model without six axes.
    """
    if model.n_joints != N_AXES:
        raise SettingsError(f"{model.name} has {model.n_joints} axes", where="--model", remedy="The program on the controller moves six axes.")
    return AbbController(SimulatedCell(truth or Truth(), model, folder=folder), host=host, port=port, bench_port=bench_port, speed_up=speed_up)
