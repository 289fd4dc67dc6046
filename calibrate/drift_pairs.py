"""Two causes at once: whether some pair explains the residuals of a check far better than any single cause, and which.

The evidence of a pair is that of single causes (`calibrate.drift_causes`) on the columns of both. What is compared is
the mean over all pairs with the mean over all single causes, so that the many pairs pay for being many, and the size of
both changes for being free (Occam's share in the evidence).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import logsumexp

from calibrate.drift_causes import HAND_EYE, ODDS, SPHERE, Cause, Diagnosis, Shape, weigh, whitened
from calibrate.quick_check import CheckResiduals
from drivers.kinematics.se3 import FloatArray

LEAST_ODDS = 30.0
"""Two causes are told where pairs are so many times likelier than single causes, both taken for equally likely before."""


@dataclass(frozen=True, slots=True)
class Pair:
    """Two causes together."""

    causes: tuple[str, str]
    probability: float
    """Posterior among all pairs, one of them taken to be there."""


@dataclass(frozen=True, slots=True)
class Together:
    """More than one thing has changed."""

    log_odds: float
    """Natural logarithm of the evidence for pairs against that for single causes."""
    pairs: tuple[Pair, ...]
    """Those that the shots cannot tell from the likeliest, which comes first."""


def two_causes(residuals: CheckResiduals, causes: Sequence[Cause], diagnosis: Diagnosis) -> Together | None:
    """What changed where a pair explains the residuals far better than any single cause; None otherwise, or where nothing changed."""
    if not diagnosis.changed:
        return None
    n_axes = sum(cause.name.startswith("axis ") for cause in causes)
    # what no pose tells apart is no pair
    alike = ({"axis 1", SPHERE}, {f"axis {n_axes}", HAND_EYE})
    factor, y = whitened(residuals)
    single = [_evidence(cause.shapes, factor, y) for cause in causes]
    partners = [(a, b) for a, b in combinations(causes, 2) if {a.name, b.name} not in alike]
    paired = [_evidence(tuple(_both(x, z) for x in a.shapes for z in b.shapes), factor, y) for a, b in partners]
    priors = np.array([a.prior * b.prior for a, b in partners])
    log_odds = _mean(paired, priors) - _mean(single, np.array([cause.prior for cause in causes]))
    if log_odds < np.log(LEAST_ODDS):
        return None
    log_share = np.array(paired) + np.log(priors)
    share = np.exp(log_share - logsumexp(log_share))
    pairs = sorted((Pair((a.name, b.name), float(p)) for (a, b), p in zip(partners, share, strict=True)), key=lambda pair: -pair.probability)
    return Together(log_odds, tuple(pair for pair in pairs if pair.probability > ODDS * pairs[0].probability))


def _evidence(shapes: Sequence[Shape], factor: FloatArray, y: FloatArray) -> float:
    """Logarithm, mean over the shapes."""
    return _mean([weigh(shape, factor, y)[0] for shape in shapes], np.array([shape.weight for shape in shapes]))


def _mean(logs: Sequence[float], weights: FloatArray) -> float:
    return float(logsumexp(logs, b=weights / weights.sum()))


def _both(first: Shape, second: Shape) -> Shape:
    columns = np.concatenate([first.columns, second.columns], axis=1)
    return Shape(columns, np.concatenate([first.size, second.size]), (*first.names, *second.names), first.weight * second.weight)
