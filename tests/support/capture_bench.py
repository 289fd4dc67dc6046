"""A bench for the capture run: fake devices, a session, and commands given at chosen events."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from acquire.capture import CaptureSettings, run_capture
from acquire.cell import Cell
from acquire.events import Captured, Command, Event, Moving
from acquire.plan import Plan
from acquire.session import SessionWriter
from drivers.protocols import Devices
from tests.support.fake_devices import FakeCamera, FakeRobot, fake_cell, fake_devices

Answer = Callable[[Event], Command | None]


class Bench:
    """A cell, its devices and a session to write."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "session"
        self.cell: Cell = fake_cell(folder)
        self.devices: Devices
        self.robot: FakeRobot
        self.camera: FakeCamera
        self.devices, self.robot, self.camera = fake_devices()
        self.writer = SessionWriter.create(self.folder, purpose="calibration", cell=self.cell)

    def run(self, plan: Plan, answer: Answer = lambda _: None, capture: CaptureSettings | None = None) -> list[Event]:
        """Events without Moving; `answer` gives the command to each event."""
        steps = run_capture(self.devices, self.cell, plan, self.writer, capture)
        events = [next(steps)]
        while True:
            try:
                events.append(steps.send(answer(events[-1])))
            except StopIteration:
                return [event for event in events if not isinstance(event, Moving)]

    def resumed(self) -> None:
        """As a new process would go on."""
        self.writer.close()
        self.writer = SessionWriter.resume(self.folder, cell=self.cell)


def once(*pairs: tuple[type[Event], Command]) -> Answer:
    """Each command at the first event of its kind, in this order."""
    left = list(pairs)

    def answer(event: Event) -> Command | None:
        if left and isinstance(event, left[0][0]):
            return left.pop(0)[1]
        return None

    return answer


def kinds(events: list[Event]) -> list[str]:
    """Names of the events."""
    return [type(event).__name__ for event in events]


def pose_ids(events: list[Event]) -> list[str]:
    """Poses in the order they were captured."""
    return [event.pose_id for event in events if isinstance(event, Captured)]
