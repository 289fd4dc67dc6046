"""The inside of the simulated UR controller: robot, safety, power, registers, the program that runs. It knows no socket.

The robot moves on the cell's clock, which `cycle` advances; `timestamp_s` and all time limits are real time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

import numpy as np

from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.controllers.ur.variables import Value

_MM_PER_M = 1000.0


class SafetyMode(IntEnum):
    """UR's safety modes."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    SAFEGUARD_STOP = 5
    ROBOT_EMERGENCY_STOP = 7
    FAULT = 9


class RobotMode(IntEnum):
    """UR's robot modes."""

    POWER_OFF = 3
    IDLE = 5
    RUNNING = 7


class Runtime(IntEnum):
    """UR's states of the program."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class Program(Protocol):
    """What runs on the controller."""

    name: str

    def cycle(self, machine: Machine) -> bool:
        """One pass; False when the program is at its end."""
        ...


@dataclass(slots=True, eq=False)
class Machine:
    """State of the controller."""

    cell: SimulatedCell
    own_model: RobotModel
    """What the controller itself believes: the nominal model, or with its factory calibration."""
    speed_up: float = 1.0
    timestamp_s: float = 0.0
    safety: SafetyMode = SafetyMode.NORMAL
    mode: RobotMode = RobotMode.RUNNING
    remote: bool = True
    freedrive: bool = False
    program: Program | None = None
    paused: bool = False
    messages: list[str] = field(default_factory=list)
    """What the controller's log says, newest last."""
    flange_from_tcp: FloatArray = field(default_factory=se3.identity)
    """Translation in mm."""
    inputs: dict[str, Value] = field(default_factory=dict)
    outputs: dict[str, Value] = field(default_factory=dict)
    joints_rad: FloatArray = field(init=False)
    """(n,) as the encoders gave them in this cycle."""
    speeds_rad_s: FloatArray = field(init=False)
    _watched: tuple[str, float] | None = None
    """Input variable that has to be written at least so often, s; else the program ends."""
    _written_s: float = 0.0
    _pose: tuple[float, ...] = field(init=False)
    _pose_of: bytes = b""
    _held: FloatArray | None = None
    """Target of a motion that a pause has interrupted."""
    _speed_rad_s: float = 0.0

    def __post_init__(self) -> None:
        """The first reading."""
        self.joints_rad = self.cell.read_joints_rad()
        self.speeds_rad_s = np.zeros_like(self.joints_rad)

    @property
    def runtime(self) -> Runtime:
        """State of the program."""
        if self.program is None:
            return Runtime.STOPPED
        return Runtime.PAUSED if self.paused else Runtime.PLAYING

    @property
    def can_move(self) -> bool:
        """Whether power and safety allow a motion."""
        return self.mode is RobotMode.RUNNING and self.safety in (SafetyMode.NORMAL, SafetyMode.REDUCED)

    def cycle(self, seconds: float) -> None:
        """Let `seconds` of real time pass: axes move, the program makes one pass."""
        self.timestamp_s += seconds
        self.cell.advance(seconds * self.speed_up)
        joints = self.cell.read_joints_rad()
        self.speeds_rad_s, self.joints_rad = (joints - self.joints_rad) / seconds, joints
        if self._watched is not None and self.timestamp_s - self._written_s > self._watched[1]:
            self.messages.append("the RTDE watchdog ended the program")
            self.end_program()
        if self.program is not None and not self.paused and not self.program.cycle(self):
            self.end_program()

    def write_inputs(self, values: Mapping[str, Value]) -> None:
        """Take the values of one package of a client."""
        self.inputs.update(values)
        if self._watched is not None and self._watched[0] in values:
            self._written_s = self.timestamp_s

    def watch(self, name: str, longest_s: float) -> None:
        """End the program when this input is not written for so long."""
        self._watched, self._written_s = (name, longest_s), self.timestamp_s

    def start_motion(self, target_rad: FloatArray, speed_rad_s: float) -> None:
        """Let the program move the axes."""
        self._speed_rad_s = speed_rad_s
        self.cell.start_motion(target_rad, speed_rad_s=speed_rad_s)

    def run(self, program: Program) -> None:
        """A new program takes the place of whatever ran."""
        self.end_program()
        self.program = program
        self.messages.append(f"program {program.name} begins")

    def end_program(self) -> None:
        """Stop the program, and the motion that it makes."""
        self.program, self.paused, self._held, self.freedrive, self._watched = None, False, None, False, None
        self.cell.stop_motion()

    def pause(self) -> None:
        """Hold program and motion; `resume` goes on with both."""
        if self.program is None:
            return
        if self.cell.moving():
            self._held = np.array(self.cell.axes().target_rad)
        self.cell.stop_motion()
        self.paused = True

    def resume(self) -> None:
        """What Play on the pendant does: an interrupted motion goes on to its old target."""
        held, self._held, self.paused = self._held, None, False
        if held is not None and self.program is not None:
            self.cell.start_motion(held, speed_rad_s=self._speed_rad_s)

    def in_int(self, register: int) -> int:
        """Value of an integer input register."""
        value = self.inputs.get(f"input_int_register_{register}", 0)
        return int(value) if isinstance(value, int | float) else 0

    def in_doubles(self, first: int, count: int) -> FloatArray:
        """Values of double input registers in a row."""
        return np.array([self.inputs.get(f"input_double_register_{i}", 0.0) for i in range(first, first + count)], dtype=np.float64)

    def tcp_pose(self) -> tuple[float, ...]:
        """X, y, z in m and rotation vector in rad of the active tool, by the controller's own model."""
        key = self.joints_rad.tobytes() + self.flange_from_tcp.tobytes()
        if key != self._pose_of:
            self._pose, self._pose_of = pose_vector(mdh.base_from_flange(self.own_model, self.joints_rad) @ self.flange_from_tcp), key
        return self._pose


def pose_vector(transform: FloatArray) -> tuple[float, ...]:
    """UR's pose: x, y, z in m and rotation vector in rad."""
    return (*(float(x) / _MM_PER_M for x in transform[:3, 3]), *(float(r) for r in se3.log_so3(transform[:3, :3])))


def pose_transform(pose: FloatArray) -> FloatArray:
    """(4, 4), mm, of UR's pose (6,)."""
    return se3.from_rotation_translation(se3.exp_so3(pose[3:]), pose[:3] * _MM_PER_M)
