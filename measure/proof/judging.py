"""From figures to judgements, and what keeps a verdict from being `conform` whatever the figures say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from acquire.cell import Limits, Sphere
from measure.decision import Judgement, judge
from measure.proof.lengths import LengthResult
from measure.sphere_figures import Figures


def judgements(limits: Limits, figures: Figures, lengths: Sequence[LengthResult], spheres: Mapping[str, Sphere]) -> tuple[Judgement, ...]:
    """Centre rms, every length, and every sphere's diameter and form against the limits."""
    found: list[Judgement] = []
    if figures.centre_rms_mm is not None:
        freedom = 3 * sum(s.n_views - 1 for s in figures.spheres.values())
        found.append(judge("centre rms", figures.centre_rms_mm, limits.centre_rms_mm, figures.centre_rms_mm / np.sqrt(2 * freedom)))
    for length in lengths:
        if length.not_judged is None:
            found.append(judge(f"length {length.label}", length.error_mm, limits.length_error_mm, length.test_standard_uncertainty_mm))
    for name, sphere in figures.spheres.items():
        u_diameter = float(np.hypot(sphere.diameter_standard_uncertainty_mm, spheres[name].expanded_uncertainty_mm / 2))
        found.append(judge(f"diameter of sphere {name}", sphere.diameter_error_mm, limits.diameter_error_mm, u_diameter))
        u_form = float(np.hypot(sphere.form_standard_uncertainty_mm, (spheres[name].form_mm or 0.0) / 2))
        found.append(judge(f"form of sphere {name}", sphere.form_mm, limits.form_mm, u_form))
    return tuple(found)


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
