"""What the primary interface of the simulated controller sends, ten times a second."""

from __future__ import annotations

import struct

import numpy as np

from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.controllers.ur.machine import Machine, Runtime, SafetyMode, pose_vector
from drivers.ur import wire

_MM_PER_M = 1000.0
_VERSION_MESSAGE = 20
_LINEARISED = 2


def version_message() -> bytes:
    """The first message of a connection."""
    project = b"URControl"
    return wire.primary_package(_VERSION_MESSAGE, struct.pack(">qbbb", 0, -2, 3, len(project)) + project + struct.pack(">BBii", 5, 11, 1, 108318))


def robot_state(machine: Machine) -> bytes:
    """Mode, tool pose, and the arm's own Denavit-Hartenberg parameters."""
    parts = (
        wire.primary_package(wire.ROBOT_MODE_DATA, _mode(machine)),
        wire.primary_package(wire.CARTESIAN_INFO, struct.pack(">12d", *machine.tcp_pose(), *pose_vector(machine.flange_from_tcp))),
        wire.primary_package(wire.KINEMATICS_INFO, _kinematics(machine.own_model)),
    )
    return wire.primary_package(wire.ROBOT_STATE, b"".join(parts))


def _mode(machine: Machine) -> bytes:
    stopped = machine.safety is SafetyMode.PROTECTIVE_STOP
    emergency = machine.safety is SafetyMode.ROBOT_EMERGENCY_STOP
    flags = (True, True, machine.mode >= 5, emergency, stopped, machine.runtime is Runtime.PLAYING, machine.runtime is Runtime.PAUSED)
    return struct.pack(">Q7?BB3dB", int(machine.timestamp_s * 1e6), *flags, int(machine.mode), 0, 1.0, 1.0, 1.0, 0)


def _kinematics(model: RobotModel) -> bytes:
    theta, a, d, alpha = standard_dh(model)
    checksums = [int(abs(value) * 1e9) & 0xFFFFFFFF for value in a + 2 * d + 3 * alpha + 5 * theta]
    return struct.pack(">6I24dI", *checksums, *theta, *(a / _MM_PER_M), *(d / _MM_PER_M), *alpha, _LINEARISED)


def standard_dh(model: RobotModel) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Theta offsets, a, d and alpha of UR's convention, RotZ TransZ TransX RotX; mm and rad.

    Modified parameters have a and alpha one link down; the first ones must be 0, as in every UR model.
    """
    a, alpha = np.append(model.a_mm[1:], 0.0), np.append(model.alpha_rad[1:], 0.0)
    return model.theta_offset_rad, a, model.d_mm, alpha
