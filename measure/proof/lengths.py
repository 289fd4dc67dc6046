"""Certified lengths: each measured between commonly fitted centres, and view by view in pairs, as on a slide."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from acquire.cell import CertifiedLength
from calibrate.observations import SphereShot
from drivers.kinematics.se3 import FloatArray
from measure.length_uncertainty import End, distance_standard_uncertainty_mm, end_of
from measure.placing import JudgedSystem
from measure.proof.poses import near, same_poses
from measure.proof.reach import is_unseen_place
from measure.sphere_figures import Figures, separation

LEAST_VIEWS = 2
_SLIDE_TOLERANCE_MM = 1.0


@dataclass(frozen=True, slots=True)
class PairFigures:
    """Distances between single views of both ends, no two of a pair from the same robot pose (the paper's Table 5)."""

    n_pairs: int
    mean_mm: float
    """Of | |P1 - P2| - L |."""
    max_mm: float
    std_mm: float
    signed_mean_mm: float
    """Of |P1 - P2| - L: what does not average out."""

    def to_json_dict(self) -> dict[str, object]:
        """For `--json`."""
        return {name: getattr(self, name) for name in self.__slots__}


@dataclass(frozen=True, slots=True)
class LengthResult:
    """One certified length, measured between centres fitted on all views of each sphere together."""

    between: tuple[str, str]
    measured_mm: float
    reference_mm: float
    reference_standard_uncertainty_mm: float
    """Certificate, at the temperature when seen."""
    repeat_standard_uncertainty_mm: float
    """Scatter between the views."""
    calibration_standard_uncertainty_mm: float
    """What the calibration leaves open of this length; no decision is charged with it."""
    not_judged: str | None = None
    """Why this length says nothing about the system; None where it does."""
    unseen_places: bool = True
    """Whether no sphere of the calibration stood at either end."""
    pairs: PairFigures | None = None
    """View by view; None where no two views of the ends make a pair, and for line profiles."""

    @property
    def test_standard_uncertainty_mm(self) -> float:
        """Reference and repeat: of the test, not of the system."""
        return float(np.hypot(self.reference_standard_uncertainty_mm, self.repeat_standard_uncertainty_mm))

    @property
    def expanded_uncertainty_mm(self) -> float:
        """Of the error, k = 2: reference, repeat and calibration."""
        return 2.0 * float(np.hypot(self.test_standard_uncertainty_mm, self.calibration_standard_uncertainty_mm))

    @property
    def error_mm(self) -> float:
        """Measured minus reference."""
        return self.measured_mm - self.reference_mm

    @property
    def label(self) -> str:
        """For people."""
        return "-".join(self.between)

    @property
    def is_slide(self) -> bool:
        """Whether one sphere was moved along a slide: names that differ in a number, by the length (`A0`, `A50`)."""
        found = [re.fullmatch(r"(.*?)(\d+(?:\.\d+)?)", name) for name in self.between]
        if found[0] is None or found[1] is None or found[0][1] != found[1][1]:
            return False
        return abs(abs(float(found[0][2]) - float(found[1][2])) - self.reference_mm) < _SLIDE_TOLERANCE_MM

    def to_json_dict(self) -> dict[str, object]:
        """As in DESIGN 4, and whether it was judged."""
        return {
            "between": list(self.between),
            "measured_mm": self.measured_mm,
            "reference_mm": self.reference_mm,
            "error_mm": self.error_mm,
            "expanded_uncertainty_mm": self.expanded_uncertainty_mm,
            "reference_standard_uncertainty_mm": self.reference_standard_uncertainty_mm,
            "repeat_standard_uncertainty_mm": self.repeat_standard_uncertainty_mm,
            "calibration_standard_uncertainty_mm": self.calibration_standard_uncertainty_mm,
            "not_judged": self.not_judged,
            "unseen_places": self.unseen_places,
            "slide": self.is_slide,
            "pairs": None if self.pairs is None else self.pairs.to_json_dict(),
        }


def length_results(
    calibration: JudgedSystem, lengths: Sequence[CertifiedLength], figures: Figures, shots: Sequence[SphereShot]
) -> tuple[LengthResult, ...]:
    """All certified lengths whose ends were both seen."""
    by_sphere: dict[str, list[SphereShot]] = {name: [] for name in figures.spheres}
    for shot in shots:
        by_sphere[shot.sphere].append(shot)
    seen = [length for length in lengths if set(length.between) <= set(figures.spheres)]
    names = {name for length in seen for name in length.between}
    known = {name: end_of(calibration, figures.spheres[name].centre_in_base_mm, by_sphere[name]) for name in names}
    return tuple(_length(calibration, length, figures, by_sphere, known) for length in seen)


def _length(
    calibration: JudgedSystem,
    length: CertifiedLength,
    figures: Figures,
    by_sphere: Mapping[str, Sequence[SphereShot]],
    known: Mapping[str, End],
) -> LengthResult:
    ends = [figures.spheres[name] for name in length.between]
    measured, scatter = separation(ends[0], ends[1])
    shots = [by_sphere[name] for name in length.between]
    return LengthResult(
        between=length.between,
        measured_mm=measured,
        reference_mm=length.length_mm,
        reference_standard_uncertainty_mm=length.standard_uncertainty_mm,
        repeat_standard_uncertainty_mm=scatter,
        calibration_standard_uncertainty_mm=distance_standard_uncertainty_mm(calibration, *(known[name] for name in length.between)),
        not_judged=_why_not_judged([end.n_views for end in ends], shots),
        unseen_places=all(is_unseen_place(calibration, end.centre_in_base_mm) for end in ends),
        pairs=_pairs(length.length_mm, shots, figures),
    )


def _why_not_judged(n_views: Sequence[int], shots: Sequence[Sequence[SphereShot]]) -> str | None:
    if min(n_views) < LEAST_VIEWS:
        return f"an end with fewer than {LEAST_VIEWS} views shows no scatter"
    if same_poses(shots[0], shots[1]) or same_poses(shots[1], shots[0]):
        return "both ends were seen from the same robot poses, which cannot show an error of robot or hand-eye"
    return None


def _pairs(length_mm: float, shots: Sequence[Sequence[SphereShot]], figures: Figures) -> PairFigures | None:
    """The first view of one end with the first of the other that has another pose, and so on, each view once."""
    centres = {(view.session, view.index, view.sphere): view.centre_in_base_mm for view in figures.views}
    first, left = list(shots[0]), list(shots[1])
    distances = []
    for one in first:
        other = next((shot for shot in left if not near(one.base_from_flange, shot.base_from_flange[None])[0]), None)
        if other is None:
            continue
        left.remove(other)
        here, there = (centres[shot.session, shot.index, shot.sphere] for shot in (one, other))
        if here is not None and there is not None:
            distances.append(float(np.linalg.norm(there - here)))
    return pair_figures(np.array(distances) - length_mm) if distances else None


def pair_figures(signed_mm: FloatArray) -> PairFigures:
    """Figures of signed errors (n,) of distances between single views."""
    error = np.abs(signed_mm)
    return PairFigures(len(error), float(error.mean()), float(error.max()), float(error.std()), float(signed_mm.mean()))
