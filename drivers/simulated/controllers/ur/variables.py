"""Names and types of RTDE's variables (UR's "RTDE guide"), and how their values are packed."""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence

Value = int | float | Sequence[float] | Sequence[int]

_FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}

_OUTPUTS = {
    "VECTOR6D": (
        "target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current joint_control_output actual_TCP_pose"
        " actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed joint_temperatures actual_joint_voltage payload_inertia ft_raw_wrench"
        " actual_current_as_torque"
    ),
    "VECTOR6INT32": "joint_mode",
    "VECTOR3D": "actual_tool_accelerometer elbow_position elbow_velocity payload_cog",
    "DOUBLE": (
        "timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum actual_main_voltage actual_robot_voltage"
        " actual_robot_current standard_analog_input0 standard_analog_input1 standard_analog_output0 standard_analog_output1 io_current"
        " tool_analog_input0 tool_analog_input1 tool_output_current tool_temperature tcp_force_scalar payload joint_position_deviation_ratio"
        " collision_detection_ratio"
    ),
    "INT32": "robot_mode safety_mode safety_status tool_output_voltage time_scale_source",
    "UINT32": (
        "runtime_state robot_status_bits safety_status_bits analog_io_types tool_mode output_bit_registers0_to_31 output_bit_registers32_to_63"
        " input_bit_registers0_to_31 input_bit_registers32_to_63 script_control_line"
    ),
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
}

_INPUTS = {
    "UINT8": (
        "standard_digital_output_mask standard_digital_output configurable_digital_output_mask configurable_digital_output tool_digital_output_mask"
        " tool_digital_output standard_analog_output_mask standard_analog_output_type"
    ),
    "UINT32": "speed_slider_mask input_bit_registers0_to_31 input_bit_registers32_to_63",
    "DOUBLE": "speed_slider_fraction standard_analog_output_0 standard_analog_output_1",
    "VECTOR6D": "external_force_torque",
}

_REGISTER = re.compile(r"(input|output)_(int|double|bit)_register_(\d+)")
_REGISTER_TYPES = {"int": "INT32", "double": "DOUBLE", "bit": "BOOL"}
_N_REGISTERS = {"int": 48, "double": 48, "bit": 128}


def _by_name(table: dict[str, str]) -> dict[str, str]:
    return {name: kind for kind, names in table.items() for name in names.split()}


_OUTPUT_TYPES, _INPUT_TYPES = _by_name(_OUTPUTS), _by_name(_INPUTS)


def output_type(name: str) -> str | None:
    """RTDE type of an output variable, None where there is none of the name."""
    return _OUTPUT_TYPES.get(name) or _register_type(name, "input", "output")


def input_type(name: str) -> str | None:
    """RTDE type of an input variable, None where there is none of the name."""
    return _INPUT_TYPES.get(name) or _register_type(name, "input")


def _register_type(name: str, *ways: str) -> str | None:
    match = _REGISTER.fullmatch(name)
    if match is None or match[1] not in ways or int(match[3]) >= _N_REGISTERS[match[2]]:
        return None
    return _REGISTER_TYPES[match[2]]


def zero_of(kind: str) -> Value:
    """The value of a variable that the simulation does not model."""
    count = struct.calcsize(">" + _FORMATS[kind]) // struct.calcsize(">" + _FORMATS[kind][-1])
    return 0 if count == 1 else (0,) * count


def packer(kinds: Sequence[str]) -> struct.Struct:
    """Packs the values of variables of these types, vectors flattened, one after the other."""
    return struct.Struct(">" + "".join(_FORMATS[kind] for kind in kinds))


def widths(kinds: Sequence[str]) -> list[int]:
    """How many numbers each variable has."""
    return [int(_FORMATS[kind][:-1] or 1) for kind in kinds]
