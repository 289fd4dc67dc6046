"""A RealSense camera made of the vendor's own software device: a thread streams depth images of a scene."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

UNIT_M = 1e-5
PERIOD_S = 0.02


@dataclass(frozen=True, slots=True)
class Pinhole:
    """Size and lines of sight of a depth stream; pixels."""

    width: int = 160
    height: int = 120
    focal_x: float = 700.0
    focal_y: float = 700.0

    @property
    def middle(self) -> tuple[float, float]:
        """Where the optical axis meets the image."""
        return (self.width - 1) / 2, (self.height - 1) / 2


def depth_image(points: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Depths of a scan in steps of the unit, 0 for holes."""
    return np.asarray(np.rint(np.nan_to_num(points[..., 2]) / (1000 * UNIT_M)), dtype=np.uint16)


def lines_of_sight(pinhole: Pinhole) -> NDArray[np.float64]:
    """Unit lines of sight (height, width, 3)."""
    columns, rows = np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height))
    across, down = (columns - pinhole.middle[0]) / pinhole.focal_x, (rows - pinhole.middle[1]) / pinhole.focal_y
    slopes = np.stack([across, down, np.ones(across.shape)], axis=-1)
    return np.asarray(slopes / np.linalg.norm(slopes, axis=-1, keepdims=True))


class FakeRealsense:
    """Streams what `expose` gives at each moment: points (height, width, 3) on `lines_of_sight`, in mm."""

    def __init__(
        self, expose: Callable[[], NDArray[np.float32]], pinhole: Pinhole | None = None, *, unit_m: float = UNIT_M, distortion: float = 0.0
    ) -> None:
        self.rs: Any = pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed: pip install 'spherecal[realsense]'")
        self.expose = expose
        self._pinhole = pinhole or Pinhole()
        self.silent = False
        self.device = self.rs.software_device()
        self.device.register_info(self.rs.camera_info.serial_number, "SW1")
        self.device.register_info(self.rs.camera_info.name, "software D4xx")
        self._sensor = self.device.add_sensor("Depth")
        self._sensor.add_read_only_option(self.rs.option.depth_units, unit_m)
        self._sensor.add_read_only_option(self.rs.option.asic_temperature, 41.5)
        self._profile = self._sensor.add_video_stream(self._stream(distortion)).as_video_stream_profile()
        self._number = 0
        self._stop = threading.Event()

    def find(self, rs: Any) -> Any:
        """What the adapter opens."""
        del rs
        return self.device

    def send(self) -> None:
        """One frame of the scene as it is now."""
        depth = depth_image(self.expose())
        self._number += 1
        frame = self.rs.software_video_frame()
        frame.pixels, frame.stride, frame.bpp = depth, 2 * depth.shape[1], 2
        frame.timestamp, frame.domain = 1000.0 * time.monotonic(), self.rs.timestamp_domain.hardware_clock
        frame.frame_number, frame.profile, frame.depth_units = self._number, self._profile, UNIT_M
        self._sensor.on_video_frame(frame)

    @contextmanager
    def streaming(self) -> Iterator[None]:
        """Until the block ends."""
        thread = threading.Thread(target=self._run, daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._stop.set()
            thread.join()

    def _run(self) -> None:
        while not self._stop.wait(PERIOD_S):
            if not self.silent:
                self.send()

    def _stream(self, distortion: float) -> Any:
        size, found = self._pinhole, self.rs.intrinsics()
        found.width, found.height, found.fx, found.fy = size.width, size.height, size.focal_x, size.focal_y
        found.ppx, found.ppy, found.coeffs = *size.middle, [distortion, 0, 0, 0, 0]
        found.model = self.rs.distortion.brown_conrady
        stream = self.rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fmt = self.rs.stream.depth, 0, 1, self.rs.format.z16
        stream.width, stream.height, stream.fps, stream.bpp, stream.intrinsics = size.width, size.height, int(1 / PERIOD_S), 2, found
        return stream
