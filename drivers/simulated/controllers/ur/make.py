"""A simulated UR controller from a robot model and a truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from drivers.errors import SettingsError
from drivers.kinematics.mdh import RobotModel
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.controllers.ur.machine import Machine
from drivers.simulated.controllers.ur.server import UrController
from drivers.simulated.truth import RobotTruth, Truth

HOME_RAD = (0.0, -1.57, 1.2, -1.2, -1.57, 0.0)
_TWISTS_RAD = np.pi / 2 * np.array([0, 1, 0, 0, 1, 1])
_CALIBRATION_MM, _CALIBRATION_RAD = 0.2, 3e-4


def make_controller(
    model: RobotModel,
    truth: Truth | None,
    host: str,
    *,
    bench_port: int,
    speed_up: float = 1.0,
    factory_calibration: int | None = None,
    folder: Path | None = None,
) -> UrController:
    """A controller, not yet serving.

    Args:
        model: the nominal robot, with 6 axes.
        truth: what the robot truly is; None for a robot without errors.
        host: a loopback address.
        bench_port: 0 for any free one.
        speed_up: how much faster than real the robot moves.
        factory_calibration: seed of the kinematic calibration that the controller itself believes in; None for the nominal one.
        folder: where a truth's mesh lies.

    Raises:
        SettingsError: no loopback address, or a model that is no UR's.
    """
    if not host.startswith("127."):
        raise SettingsError(f"{host} is no loopback address", where="--host", remedy="Simulated controllers serve 127.0.0.1 to 127.255.255.254 only.")
    if model.n_joints != 6 or model.a_mm[0] or not np.allclose(np.abs(model.alpha_rad), _TWISTS_RAD, atol=0.05):
        raise SettingsError(f"{model.name} is no UR", where="--model", remedy="Name ur5e, ur10e, or a model file of a UR.")
    truth = truth or Truth(robot=RobotTruth(home_rad=HOME_RAD))
    if not truth.robot.home_rad:
        truth = replace(truth, robot=replace(truth.robot, home_rad=HOME_RAD))
    cell = SimulatedCell(truth, model, folder=folder)
    own = model if factory_calibration is None else calibrated(model, np.random.default_rng(factory_calibration))
    return UrController(Machine(cell, own, speed_up), host, bench_port=bench_port)


def calibrated(model: RobotModel, rng: np.random.Generator) -> RobotModel:
    """A model as a factory calibration might have found it: every length 0.2 mm and every angle 0.3 mrad off, drawn."""
    lengths = rng.normal(0, _CALIBRATION_MM, (2, 6))
    angles = rng.normal(0, _CALIBRATION_RAD, (2, 6))
    lengths[0, 0] = angles[0, 0] = 0.0  # the base frame is the first axis
    return replace(
        model,
        a_mm=model.a_mm + lengths[0],
        d_mm=model.d_mm + lengths[1],
        alpha_rad=model.alpha_rad + angles[0],
        theta_offset_rad=model.theta_offset_rad + angles[1],
    )
