"""The values of RTDE's output variables, by their names."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from drivers.simulated.controllers.ur.machine import Machine, RobotMode, SafetyMode
from drivers.simulated.controllers.ur.variables import Value, output_type, zero_of

_SAFETY_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.REDUCED: 1 << 1,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SafetyMode.SAFEGUARD_STOP: 1 << 4 | 1 << 10,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
    SafetyMode.FAULT: 1 << 9 | 1 << 10,
}


def _status_bits(machine: Machine) -> int:
    return int(machine.mode >= RobotMode.IDLE) | int(machine.program is not None) << 1 | int(machine.freedrive) << 2


_READERS: Mapping[str, Callable[[Machine], Value]] = {
    "timestamp": lambda machine: machine.timestamp_s,
    "actual_q": lambda machine: machine.joints_rad.tolist(),
    "target_q": lambda machine: machine.cell.joints_rad().tolist(),
    "actual_qd": lambda machine: machine.speeds_rad_s.tolist(),
    "actual_TCP_pose": lambda machine: machine.tcp_pose(),
    "target_TCP_pose": lambda machine: machine.tcp_pose(),
    "robot_mode": lambda machine: int(machine.mode),
    "safety_mode": lambda machine: int(machine.safety),
    "safety_status": lambda machine: int(machine.safety),
    "safety_status_bits": lambda machine: _SAFETY_BITS[machine.safety],
    "robot_status_bits": _status_bits,
    "runtime_state": lambda machine: int(machine.runtime),
    "speed_scaling": lambda _: 1.0,
    "target_speed_fraction": lambda _: 1.0,
    "joint_temperatures": lambda _: (32.0,) * 6,
}


def output(machine: Machine, name: str) -> Value:
    """Value of an output variable now; not modelled ones are 0."""
    reader = _READERS.get(name)
    if reader is not None:
        return reader(machine)
    stored = machine.outputs.get(name, machine.inputs.get(name))
    return stored if stored is not None else zero_of(output_type(name) or "DOUBLE")
