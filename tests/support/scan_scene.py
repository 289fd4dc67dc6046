"""One sphere before a camera, for tests of camera adapters: where it is now, and exposures of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tests.support.scenes import FloatArray, frame, rays

RADIUS_MM = 19.05


@dataclass(slots=True, eq=False)
class ScanScene:
    """A sphere that can be moved; every exposure has noise of its own."""

    width: int = 160
    height: int = 120
    noise_mm: float = 0.01
    centre_mm: FloatArray = field(default_factory=lambda: np.array([6.0, -4.0, 350.0]))
    n_moves: int = 0
    n_exposures: int = 0

    def move(self) -> None:
        """Elsewhere, each time to another place."""
        self.n_moves += 1
        rng = np.random.default_rng(1000 + self.n_moves)
        self.centre_mm = np.array([6.0, -4.0, 350.0]) + rng.uniform(2, 6, 3) * rng.choice([-1, 1], 3) + [0, 0, 3.0 * self.n_moves]

    def expose(self) -> NDArray[np.float32]:
        """Points (height, width, 3) in mm, NaN where there is no sphere."""
        self.n_exposures += 1
        sight = rays(self.width, self.height, (6.0, 4.5))
        return frame([(self.centre_mm, RADIUS_MM)], sight=sight, noise_mm=self.noise_mm, seed=self.n_exposures)
