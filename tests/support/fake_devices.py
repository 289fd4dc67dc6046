"""Tiny devices for the capture run: a clock, a robot of a few axes, a camera that sees one sphere, and faults on order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from acquire.cell import Cell, load_cell
from acquire.plan import Plan, PlannedPose
from drivers.errors import MotionRefused
from drivers.protocols import Camera3D, CameraInfo, Devices, FloatArray, Frame3D, Robot, RobotInfo, RobotState, Safety
from tests.support.scenes import frame, rays

CENTRE_MM = np.array([10.0, -5.0, 330.0])
RADIUS_MM = 19.05
_SIGHT = rays(120, 80, (8.0, 6.0))

CELL_YAML = f"""\
format: spherecal-cell/1
name: fake
robot: {{driver: simulated, model: null}}
camera: {{driver: simulated, kind: area}}
flange_from_camera: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
spheres:
  A: {{diameter_mm: {2 * RADIUS_MM}, expanded_uncertainty_mm: 0.001, centre_in_base_mm: [8, -4, 333]}}
motion: {{speed_rad_s: 0.5, settle_s: 0.3, frames: 1}}
"""


def fake_cell(folder: Path, text: str = CELL_YAML) -> Cell:
    """The cell of these devices, by way of a file."""
    path = folder / "cell.yaml"
    path.write_text(text, encoding="utf-8")
    return load_cell(path)


def fake_plan(n: int = 3, *, sphere: str | None = "A", vias: bool = False) -> Plan:
    """Poses p0, p1, ... of a robot with two axes."""
    poses = [
        PlannedPose(f"p{i}", sphere, np.array([0.2 * (i + 1), -0.1 * i]), (np.array([0.2 * (i + 1) - 0.1, 0.5]),) if vias else ()) for i in range(n)
    ]
    return Plan("0" * 64, "calibration", tuple(poses))


class FakeRobot:
    """Two axes that run straight at the given speed on a clock of their own."""

    def __init__(self) -> None:
        self.clock_s = 0.0
        self.start = self.target = np.zeros(2)
        self.start_s = self.end_s = 0.0
        self.safety = Safety.NORMAL
        self.refused: list[FloatArray] = []
        self.stuck = False
        self.stops_short_rad = 0.0
        self.tremble_rad = 0.0
        self.on_read: Callable[[FakeRobot], None] = lambda _: None
        self.visited: list[FloatArray] = []
        self.n_stops = self.n_reads = 0

    @property
    def moving(self) -> bool:
        """The truth, whatever the readings say."""
        return self.clock_s < self.end_s

    @property
    def joints(self) -> FloatArray:
        """Axis angles now."""
        if not self.moving:
            return self.target.copy()
        share = (self.clock_s - self.start_s) / (self.end_s - self.start_s)
        return np.asarray(self.start + share * (self.target - self.start))

    def open(self) -> RobotInfo:
        return RobotInfo("fake")

    def read_state(self) -> RobotState:
        self.n_reads += 1
        self.on_read(self)
        joints = self.joints + self.tremble_rad * (-1) ** self.n_reads
        return RobotState(joints, np.eye(4), self.clock_s, self.moving, self.safety)

    def start_move(self, joints_rad: FloatArray, *, speed_rad_s: float) -> None:
        if any(np.allclose(joints_rad, refused) for refused in self.refused):
            raise MotionRefused("the controller declines", remedy="Ask it why.")
        self.start, self.start_s = self.joints, self.clock_s
        self.target = np.array(joints_rad) - self.stops_short_rad
        self.visited.append(np.array(joints_rad))
        distance = float(np.abs(self.target - self.start).max())
        self.end_s = self.clock_s + (1e9 if self.stuck else distance / speed_rad_s)

    def stop(self) -> None:
        self.n_stops += 1
        self.target = self.joints
        self.end_s = self.clock_s

    def wait(self, seconds: float) -> None:
        self.clock_s += seconds

    def close(self) -> None:
        pass


class FakeCamera:
    """Sees the sphere from anywhere; gives what `faults` hold first."""

    def __init__(self, faults: Sequence[Exception | None] = ()) -> None:
        self.sequence = 0
        self.faults = list(faults)
        self.xyz_mm = frame([(CENTRE_MM, RADIUS_MM)], sight=_SIGHT, noise_mm=0.05)
        self.before: Callable[[], object] = lambda: None
        self.warms_k_per_frame = 0.0
        self.temperature_c = 31.5
        self.tells_temperature = True
        self.info = CameraInfo("fake")
        self.diagnostics: dict[str, float | int | str] = {}

    def open(self) -> CameraInfo:
        return self.info

    def capture(self, *, timeout_s: float) -> Frame3D:
        del timeout_s
        self.before()
        fault = self.faults.pop(0) if self.faults else None
        if fault is not None:
            raise fault
        self.sequence += 1
        temperatures_c = {"housing": self.temperature_c} if self.tells_temperature else {}
        self.temperature_c += self.warms_k_per_frame
        return Frame3D(
            xyz_mm=self.xyz_mm.copy(), sequence=self.sequence, time_s=0.0, temperatures_c=temperatures_c, diagnostics=dict(self.diagnostics)
        )

    def close(self) -> None:
        pass


def fake_devices() -> tuple[Devices, FakeRobot, FakeCamera]:
    """The pair, and each of them for a test to meddle with."""
    robot, camera = FakeRobot(), FakeCamera()
    as_robot: Robot = robot
    as_camera: Camera3D = camera
    return Devices(as_robot, as_camera), robot, camera
