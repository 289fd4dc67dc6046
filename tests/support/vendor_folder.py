"""A camera maker's own software, as a folder sees it: it waits for a trigger file and writes a scan, slowly, as makers do."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.files.ply import encode_ply
from tests.support.scan_scene import ScanScene

Points = NDArray[np.float32]
TRIGGER = "trigger.txt"


def as_ply(points: Points) -> bytes:
    """As spherecal itself writes it."""
    return encode_ply(points)


@dataclass(slots=True, eq=False)
class VendorSoftware:
    """Answers every trigger file by a scan of the scene."""

    folder: Path
    scene: ScanScene
    encode: Callable[[Points], bytes] = as_ply
    suffix: str = ".ply"
    pieces: int = 3
    pause_s: float = 0.01
    silent: bool = False
    delay_s: float = 0.0
    n_written: int = 0
    _stop: threading.Event = field(default_factory=threading.Event)

    def expose(self) -> bytes:
        """The bytes of a scan of the scene as it is now."""
        return self.encode(self.scene.expose())

    def write(self, data: bytes) -> None:
        """In pieces, with pauses between them."""
        self.n_written += 1
        path = self.folder / f"scan_{self.n_written:04d}{self.suffix}"
        step = -(-len(data) // self.pieces)
        with path.open("wb") as stream:
            for begin in range(0, len(data), step):
                stream.write(data[begin : begin + step])
                stream.flush()
                time.sleep(self.pause_s)

    def _asked(self) -> tuple[bytes, int] | None:
        """Text and time of the trigger file, both of one and the same file: it may be replaced, or go away, at any moment."""
        try:
            with (self.folder / TRIGGER).open("rb") as stream:
                return stream.read(), os.fstat(stream.fileno()).st_mtime_ns
        except FileNotFoundError:
            return None

    def _serve(self) -> None:
        seen: tuple[bytes, int] | None = None
        while not self._stop.wait(0.005):
            asked = self._asked()
            if asked is None or asked == seen:
                continue
            seen = asked
            if not self.silent:
                data = self.expose()
                time.sleep(self.delay_s)
                self.write(data)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Until the block ends."""
        thread = threading.Thread(target=self._serve, daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._stop.set()
            thread.join()
