"""Probing error of form and size: of single views, and of all views of a sphere stitched together.

Form is the width of the thinnest shell about the centre of a free-radius fit that holds a share of the points; size is
the diameter of a free-radius fit to those points, less the certified one. Both on all points, 99.7 % and 95 %: which of
them a standard's clause means is for the reader to say (facts are not confirmed), so none is named after one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquire.sphere_fit import fit_free_radius

FloatArray = NDArray[np.float64]

SHARES = (1.0, 0.997, 0.95)
_LEAST_POINTS = 10


@dataclass(frozen=True, slots=True)
class Probing:
    """Form and size of one set of points, each on all of them, on 99.7 % and on 95 %."""

    n_points: int
    form_mm: tuple[float, float, float]
    size_error_mm: tuple[float, float, float]

    def to_json_dict(self) -> dict[str, object]:
        """For `--json`: share of the points by name."""
        names = ("all", "share_997", "share_95")
        return {
            "n_points": self.n_points,
            "form_mm": dict(zip(names, self.form_mm, strict=True)),
            "size_error_mm": dict(zip(names, self.size_error_mm, strict=True)),
        }


@dataclass(frozen=True, slots=True)
class ProbingResult:
    """Probing of one sphere: by one view, or by all of them together."""

    sphere: str
    session: str | None
    """Digest; None for all views together."""
    index: int | None
    probing: Probing | None
    """None for a view with too few points."""


def probing_of(points_mm: FloatArray, radius_mm: float, start_mm: FloatArray) -> Probing | None:
    """Form and size of points (n, 3) on a sphere of certified radius; None for fewer points than can tell."""
    if len(points_mm) < _LEAST_POINTS:
        return None
    centre, radius, _ = fit_free_radius(points_mm, radius_mm, start_mm)
    distances = np.linalg.norm(points_mm - centre, axis=1)
    shells = [shell_of(distances, share) for share in SHARES]
    sizes = [2.0 * (radius - radius_mm)]
    for low, high in shells[1:]:
        held = points_mm[(distances >= low) & (distances <= high)]
        sizes.append(2.0 * (fit_free_radius(held, radius, centre)[1] - radius_mm) if len(held) >= _LEAST_POINTS else sizes[0])
    widths = [high - low for low, high in shells]
    return Probing(len(points_mm), (widths[0], widths[1], widths[2]), (sizes[0], sizes[1], sizes[2]))


def shell_of(radii_mm: FloatArray, share: float) -> tuple[float, float]:
    """Ends of the narrowest interval that holds a share of the radii (n,), at least one of them."""
    ordered = np.sort(radii_mm)
    n_held = max(1, int(np.ceil(share * len(ordered))))
    widths = ordered[n_held - 1 :] - ordered[: len(ordered) - n_held + 1]
    first = int(np.argmin(widths))
    return float(ordered[first]), float(ordered[first + n_held - 1])


def shell_width_mm(radii_mm: FloatArray, share: float) -> float:
    """Width of that interval."""
    low, high = shell_of(radii_mm, share)
    return high - low
