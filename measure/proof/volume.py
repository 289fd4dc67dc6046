"""Lengths over the work volume: where to put them, and whether those measured reach far enough.

Seven lines through a box, its four space diagonals and the three middle lines along its edges, with five lengths on
each, the longest at least two thirds of the diagonal: the arrangement that volume tests of multiple-view systems are
known for. Its counts are a custom here and not taken from a clause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from drivers.kinematics.se3 import FloatArray
from measure.proof.lengths import LengthResult

N_LINES, LENGTHS_PER_LINE = 7, 5
LONGEST_SHARE = 2.0 / 3.0
LEAST_SHARE = 0.25
"""Of the diagonal: lengths that are all shorter, as a slide of 50 mm is, prove nothing about the volume."""


@dataclass(frozen=True, slots=True)
class VolumeFigures:
    """All judged lengths together."""

    n_lengths: int
    rms_mm: float
    max_mm: float
    """Largest size of an error."""
    longest_mm: float
    diagonal_mm: float | None
    """Of the cell's work volume; None where the cell names none."""
    n_unseen: int
    """Lengths with both ends where no sphere of the calibration stood."""
    n_within_u: int
    """Lengths whose error lies within its own expanded uncertainty."""

    @property
    def longest_share(self) -> float | None:
        """Of the diagonal."""
        return None if self.diagonal_mm is None else self.longest_mm / self.diagonal_mm

    def to_json_dict(self) -> dict[str, object]:
        """For `--json`."""
        return {name: getattr(self, name) for name in self.__slots__} | {"longest_share": self.longest_share}

    def gaps(self) -> tuple[str, ...]:
        """What keeps these lengths from proving anything, in sentences."""
        if self.longest_share is None or self.longest_share >= LEAST_SHARE:
            return ()
        return (
            f"the longest judged length is {self.longest_mm:.0f} mm, {100 * self.longest_share:.0f} % of the work volume's diagonal: so short ones "
            f"see neither scale nor a bent base, {100 * LEAST_SHARE:.0f} % are the least and {100 * LONGEST_SHARE:.0f} % are wanted",
        )

    def warnings(self) -> tuple[str, ...]:
        """What the lengths leave untested, in sentences."""
        found = []
        if self.longest_share is not None and LEAST_SHARE <= self.longest_share < LONGEST_SHARE:
            found.append(
                f"the longest judged length is {self.longest_mm:.0f} mm, {100 * self.longest_share:.0f} % of the work volume's diagonal: "
                f"a scale or a bent base shows on lengths of {100 * LONGEST_SHARE:.0f} % and more"
            )
        if self.n_unseen == 0:
            found.append("every judged length ends where a sphere of the calibration stood: lengths between other places are not tested")
        return tuple(found)


def volume_figures(lengths: Sequence[LengthResult], box_mm: FloatArray | None) -> VolumeFigures | None:
    """Figures of the lengths that can be judged, over a work volume (2, 3); None without any."""
    judged = [length for length in lengths if length.not_judged is None]
    if not judged:
        return None
    errors = np.array([length.error_mm for length in judged])
    return VolumeFigures(
        n_lengths=len(judged),
        rms_mm=float(np.sqrt(np.mean(errors**2))),
        max_mm=float(np.abs(errors).max()),
        longest_mm=max(length.reference_mm for length in judged),
        diagonal_mm=None if box_mm is None else float(np.linalg.norm(box_mm[1] - box_mm[0])),
        n_unseen=sum(length.unseen_places for length in judged),
        n_within_u=sum(abs(length.error_mm) <= length.expanded_uncertainty_mm for length in judged),
    )


def volume_lines(box_mm: FloatArray) -> FloatArray:
    """(7, 6, 3) places on seven lines through a box (2, 3): five lengths from the first place of each line to the others."""
    low, high = box_mm
    middle = (low + high) / 2
    starts, ends = [], []
    for y, z in product((0, 1), repeat=2):
        corner = np.array([0, y, z])
        starts.append(np.where(corner, high, low))
        ends.append(np.where(corner, low, high))
    for axis in range(3):
        for bucket, edge in ((starts, low), (ends, high)):
            place = middle.copy()
            place[axis] = edge[axis]
            bucket.append(place)
    share = np.linspace(0.0, 1.0, LENGTHS_PER_LINE + 1)
    first, last = np.array(starts), np.array(ends)
    return np.asarray(first[:, None] + share[None, :, None] * (last - first)[:, None])
