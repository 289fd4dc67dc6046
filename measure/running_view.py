"""A live picture of a run in Rerun, fed by a process of its own: a viewer that is slow, hangs or is closed delays nothing.

What the run tells goes into a short queue; where that is full it is dropped.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.cell import Cell
from acquire.events import Captured, Event, Moving
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from measure.console import LOCAL_ONLY
from measure.scene import Scene, SphereMark, Step

if TYPE_CHECKING:
    from multiprocessing.queues import Queue

_ITEMS = 30
_POINTS = 8000
_BETWEEN_READINGS_S = 0.1
_START_S = 10.0
_CLOSE_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Glimpse:
    """One thing to show."""

    step: Step
    is_new: bool
    """A shot; otherwise the robot under way."""


class Feed:
    """A process that is given things to show, and dropped when it does not keep up. Use as a context manager."""

    def __init__(self, child: Callable[..., None], *arguments: object) -> None:
        context = multiprocessing.get_context("spawn")
        self._queue: Queue[Any] = context.Queue(_ITEMS)
        self._process = context.Process(target=_quietly, args=(child, self._queue, *arguments), daemon=True)
        self.n_dropped = 0

    def __enter__(self) -> Feed:
        """Start it."""
        self._process.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Let it end by itself for a moment, then end it."""
        self._queue.cancel_join_thread()
        self.offer(None)
        self._process.join(_CLOSE_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._queue.close()

    def offer(self, item: object) -> None:
        """Give something to show; returns at once."""
        try:
            self._queue.put_nowait(item)
        except (queue.Full, ValueError, OSError):
            self.n_dropped += 1


class View:
    """Makes glimpses of events."""

    def __init__(self, feed: Feed, cell: Cell, model: RobotModel) -> None:
        self._feed, self._model = feed, model
        self._flange_from_camera = np.eye(4) if cell.flange_from_camera is None else np.asarray(cell.flange_from_camera, dtype=np.float64)
        self._last_s = 0.0

    def show(self, event: Event) -> None:
        """Show where the robot is and what the camera sees."""
        if isinstance(event, Moving) and event.joints_rad is not None and time.monotonic() - self._last_s > _BETWEEN_READINGS_S:
            self._last_s = time.monotonic()
            self._feed.offer(Glimpse(self._step(event.joints_rad, np.zeros((0, 3)), event.pose_id), is_new=False))
        if isinstance(event, Captured) and event.shot.joints_rad is not None:
            points = event.xyz_mm.reshape(-1, 3).astype(np.float64)
            points = points[np.isfinite(points).all(axis=1)]
            points = points[:: max(1, -(-len(points) // _POINTS))]
            self._feed.offer(Glimpse(self._step(np.asarray(event.shot.joints_rad), points, event.pose_id, _curves(event)), is_new=True))

    def _step(self, joints_rad: FloatArray, points_in_camera_mm: FloatArray, pose_id: str, curves: Mapping[str, float] | None = None) -> Step:
        links = np.asarray(mdh.chain(self._model, joints_rad))
        base_from_camera = links[-1] @ self._flange_from_camera
        return Step(f"pose {pose_id}", links, base_from_camera, se3.apply(base_from_camera, points_in_camera_mm), np.zeros((0, 3)), curves or {})


def _curves(event: Captured) -> dict[str, float]:
    found = {} if event.finding is None else {"rms of the sphere fit": event.finding.rms_mm}
    return found if event.prediction_error_mm is None else found | {"distance from the predicted place": event.prediction_error_mm}


@contextmanager
def viewed(cell: Cell, model: RobotModel | None) -> Iterator[Callable[[Event], None]]:
    """A live viewer of a cell's run; shows nothing where the cell has no robot model."""
    if model is None:
        yield _nothing
        return
    with Feed(_show_all, scene_of_run(cell, model)) as feed:
        yield View(feed, cell, model).show


def scene_of_run(cell: Cell, model: RobotModel) -> Scene:
    """What stands in a cell."""
    places = {name: sphere for name, sphere in cell.spheres.items() if sphere.centre_in_base_mm is not None}
    spheres = tuple(SphereMark(name, np.array(sphere.centre_in_base_mm), sphere.radius_mm) for name, sphere in places.items())
    is_area, view = cell.camera.kind == "area", cell.camera.field_of_view_deg
    return Scene(f"spherecal: {cell.name}", (), spheres, shape=model.shape, field_of_view_deg=view if is_area else None)


def _nothing(_: Event) -> None:
    """Nobody looks."""


def _quietly(child: Callable[..., None], *arguments: object) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(OSError):
        os.nice(5)
    child(*arguments)


def _show_all(items: Queue[Any], scene: Scene) -> None:
    """The child: a viewer on this machine only, and everything that comes."""
    from measure.viewer import LiveRecording

    port = _free_port()
    command = [str(Path(sys.executable).parent / "rerun"), *LOCAL_ONLY, "--port", str(port), "--hide-welcome-screen"]
    # the viewer stays when the run has ended: it is the person's
    subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    _wait_for(port)
    live = LiveRecording(f"rerun+http://127.0.0.1:{port}/proxy", scene)
    while (item := items.get()) is not None:
        live.show(item.step, is_new=item.is_new)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait_for(port: int) -> None:
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=0.5):
            return
        time.sleep(0.1)
