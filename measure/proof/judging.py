"""From figures to judgements, and what keeps a verdict from being `conform` whatever the figures say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from acquire.cell import Limits, Sphere
from measure.decision import Judgement, judge
from measure.proof.lengths import LengthResult
from measure.sphere_figures import Figures, SphereFigures


def judgements(limits: Limits, figures: Figures, lengths: Sequence[LengthResult], spheres: Mapping[str, Sphere]) -> tuple[Judgement, ...]:
    """Centre rms, every length, and every sphere's diameter and form against the limits, with the guard that these choose."""
    found: list[Judgement] = []
    repeat = 0.0 if limits.guard == "reference" else 1.0
    if figures.centre_rms_mm is not None:
        freedom = 3 * sum(s.n_views - 1 for s in figures.spheres.values())
        found.append(judge("centre rms", figures.centre_rms_mm, limits.centre_rms_mm, repeat * figures.centre_rms_mm / np.sqrt(2 * freedom)))
    for length in lengths:
        if length.not_judged is None:
            u_length = float(np.hypot(length.reference_standard_uncertainty_mm, repeat * length.repeat_standard_uncertainty_mm))
            found.append(judge(f"length {length.label}", length.error_mm, limits.length_error_mm, u_length))
    for name, sphere in figures.spheres.items():
        u_diameter = float(np.hypot(repeat * sphere.diameter_standard_uncertainty_mm, spheres[name].expanded_uncertainty_mm / 2))
        found.append(judge(f"diameter of sphere {name}", sphere.diameter_error_mm, limits.diameter_error_mm, u_diameter))
        u_form = float(np.hypot(repeat * sphere.form_standard_uncertainty_mm, form_reference_mm(spheres[name])))
        found.append(judge(f"form of sphere {name}", sphere.form_mm, limits.form_mm, u_form))
    return tuple(found)


def form_reference_mm(sphere: Sphere) -> float:
    """Standard uncertainty that the artefact's own form brings into a measured one: half of what its certificate tells."""
    return (sphere.form_mm or 0.0) / 2


def sphere_uncertainties(
    spheres: Mapping[str, SphereFigures], certified: Mapping[str, Sphere], calibrated_mm: Mapping[str, float]
) -> dict[str, SphereUncertainty]:
    """Of every sphere's diameter and form over all its views; `calibrated_mm` is what the calibration leaves open of each diameter (1 sigma)."""
    return {
        name: SphereUncertainty(
            diameter_reference_mm=certified[name].expanded_uncertainty_mm / 2,
            diameter_repeat_mm=sphere.diameter_standard_uncertainty_mm,
            diameter_calibration_mm=calibrated_mm[name],
            form_reference_mm=form_reference_mm(certified[name]),
            form_repeat_mm=sphere.form_standard_uncertainty_mm,
        )
        for name, sphere in spheres.items()
    }


@dataclass(frozen=True, slots=True)
class SphereUncertainty:
    """Standard uncertainties of a sphere's diameter and form, stitched from all its views."""

    diameter_reference_mm: float
    """Certificate, at the temperature when seen."""
    diameter_repeat_mm: float
    """Scatter between the views."""
    diameter_calibration_mm: float
    form_reference_mm: float
    form_repeat_mm: float

    @property
    def diameter_expanded_mm(self) -> float:
        """U (k = 2) of the diameter error."""
        return 2.0 * float(np.linalg.norm([self.diameter_reference_mm, self.diameter_repeat_mm, self.diameter_calibration_mm]))

    @property
    def form_expanded_mm(self) -> float:
        """U (k = 2) of the form, what the calibration leaves apart: that shows in the form itself."""
        return 2.0 * float(np.hypot(self.form_reference_mm, self.form_repeat_mm))


def gaps_of(limits: Limits | None, figures: Figures, lengths: Sequence[LengthResult], *, line_profile: bool, flattery: Sequence[str]) -> list[str]:
    """What is not proven, in sentences; `flattery` says which training data were allowed."""
    gaps = list(flattery)
    if limits is None:
        gaps.append("no limits given")
    if figures.spheres and figures.centre_rms_mm is None and not line_profile:
        gaps.append("no sphere was seen twice: the scatter of centres is unknown")
    gaps += [f"length {length.label} not judged: {length.not_judged}" for length in lengths if length.not_judged]
    if not lengths:
        gaps.append(f"no {'certified ' if figures.spheres else ''}length was measured: scale and shape of the base are not tested")
    return gaps
