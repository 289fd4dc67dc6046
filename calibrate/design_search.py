"""Greedy choice of shots and exchanges, for the mean square error of what will be measured.

With `S = F Sigma F'` of a candidate's rows F, its noise part lowers the criterion by `tr((I + S)^-1 F Sigma W Sigma F')`
(Woodbury), W the mean of the aim's gradients; the push of the unmodelled physics changes by the innovation
`E - F Sigma B`, as a Kalman filter's estimate does. So scoring a candidate costs a few products with its r rows and
no inverse of the whole; the state itself is made anew from its sum after every choice, so that nothing drifts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.kinematics.se3 import FloatArray

IndexArray = NDArray[np.intp]

_KEPT_OF_AIM = 0.9999
"""Share of the aim's variance that the directions kept for scoring hold."""
_REFRESH = 8
_SHORT_LIST = 0.25
"""Between two looks at the whole pool only this share of it, the best of the last look, is scored."""
_LEAST_SHORT_LIST = 60
_LEAST_GAIN = 1e-3
"""An exchange must win this share of the criterion."""


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """What shots (and priors and lengths) tell: sums over rows, so informations of different shots add up."""

    hessian: FloatArray
    """(P, P)."""
    push: FloatArray
    """(P, q) of the disturbances on the gradient."""
    prior_sigma: FloatArray
    """(P,) that the solve believes."""
    actual_covariance: FloatArray
    """(P, P) how large the unknowns really are."""

    def plus(self, rows: FloatArray, sign: float = 1.0) -> Information:
        """With the rows (..., P + q) of further shots, or without them where the sign is -1."""
        flat = rows.reshape(-1, rows.shape[-1])
        size = len(self.hessian)
        added = flat[:, :size].T @ flat
        return replace(self, hessian=self.hessian + sign * added[:, :size], push=self.push + sign * added[:, size:])

    @property
    def factor(self) -> FloatArray:
        """(P, P) L with `L L' = hessian^-1`."""
        scale = 1.0 / np.sqrt(np.diagonal(self.hessian))
        cholesky = np.linalg.cholesky(self.hessian * scale[:, None] * scale)
        return np.asarray(scale[:, None] * np.linalg.inv(cholesky).T)


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """Mean squares of an aim: what noise and wrong guesses leave, and what unmodelled physics adds."""

    modelled_mm2: float
    mismatch_mm2: float

    @property
    def total_mm2(self) -> float:
        """Both."""
        return self.modelled_mm2 + self.mismatch_mm2


def mean_square(information: Information, gradients: FloatArray) -> Split:
    """Mean over gradients (l, P + q) of their expected squared error.

    With priors of precision C in the solve and unknowns that are really of covariance D, the unknowns' errors have
    `Sigma - Sigma (C - C D C) Sigma`: the noise of the data, and what the priors hold back.
    """
    if not len(gradients):
        return Split(float("nan"), float("nan"))
    size, factor = len(information.hessian), information.factor
    spread = gradients[:, :size] @ factor
    left = gradients[:, size:] - spread @ (factor.T @ information.push)
    pulled = spread @ factor.T * information.prior_sigma**-2.0
    too_wide = np.diag(information.prior_sigma**2) - information.actual_covariance
    modelled = (spread**2).sum() - ((pulled @ too_wide) * pulled).sum()
    return Split(float(modelled / len(spread)), float((left**2).sum() / len(left)))


def scores(information: Information, gradients: FloatArray, rows: FloatArray) -> FloatArray:
    """(m,) the criterion, in mm², after each of some candidates (m, r, P + q) alone is added.

    The unknowns are taken as large as the solve's priors here, which is the safe side for a choice.
    """
    size, factor, n = len(information.hessian), information.factor, len(gradients)
    spread = gradients[:, :size] @ factor
    push = factor.T @ information.push
    left = gradients[:, size:] - spread @ push
    aim = _compressed(spread)
    seen = rows[..., :size] @ factor
    inner = np.eye(rows.shape[1]) + seen @ np.swapaxes(seen, -1, -2)
    toward = seen @ aim.T
    innovation = rows[..., size:] - seen @ push
    solved = np.linalg.solve(inner, np.concatenate([toward, innovation], axis=-1))
    gain, settled = solved[..., : toward.shape[-1]], solved[..., toward.shape[-1] :]
    met = seen @ (spread.T @ left)
    noise = (spread**2).sum() - (gain * toward).sum(axis=(1, 2))
    carried = np.swapaxes(toward, -1, -2) @ settled
    mismatch = (left**2).sum() - 2 * (met * settled).sum(axis=(1, 2)) + (carried**2).sum(axis=(1, 2))
    return np.asarray((noise + mismatch) / n)


@dataclass(frozen=True, slots=True, eq=False)
class Pool:
    """Candidates of a search, in an order of their own that does not depend on how they were listed."""

    rows: FloatArray
    """(m, r, P + q)."""
    group: NDArray[np.int64]
    """(m,) the sphere of each, of which every one shall get its share."""


def greedy(information: Information, gradients: FloatArray, pool: Pool, n: int, fewest: int) -> tuple[list[int], Information]:
    """Rows of n candidates, each the best after those before it; every group gets `fewest` of them (or all it has)."""
    chosen: list[int] = []
    free = np.ones(len(pool.rows), dtype=np.bool_)
    last = np.full(len(pool.rows), np.inf)
    for k in range(n):
        allowed = np.flatnonzero(free & _owed(pool.group, chosen, n, fewest))
        looked = allowed if k % _REFRESH == 0 else allowed[np.argsort(last[allowed], kind="stable")[: _short(len(allowed))]]
        last[looked] = scores(information, gradients, pool.rows[looked])
        best = int(looked[np.argmin(last[looked])])
        chosen.append(best)
        free[best] = False
        information = information.plus(pool.rows[best])
    return chosen, information


def exchanged(
    information: Information, gradients: FloatArray, pool: Pool, chosen: list[int], fewest: int, sweeps: int
) -> tuple[list[int], Information]:
    """The choice after each shot in turn was offered for exchange against the best of those not taken."""
    chosen = list(chosen)
    for _ in range(sweeps):
        changed = False
        ranking = np.argsort(scores(information, gradients, pool.rows), kind="stable")
        for place in range(len(chosen)):
            out = chosen[place]
            without = information.plus(pool.rows[out], -1.0)
            others = ranking[~np.isin(ranking, chosen)]
            others = others[_may_replace(pool.group, chosen, out, fewest)[others]][: _short(len(others))]
            looked = np.concatenate([[out], others])
            found = scores(without, gradients, pool.rows[looked])
            best = int(np.argmin(found))
            if found[best] < (1 - _LEAST_GAIN) * found[0]:
                chosen[place] = int(looked[best])
                information = without.plus(pool.rows[looked[best]])
                changed = True
        if not changed:
            break
    return chosen, information


def _compressed(spread: FloatArray) -> FloatArray:
    """(k, P) with nearly the Gram matrix of (l, P), few rows."""
    values, vectors = np.linalg.eigh(spread.T @ spread)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    kept = int(np.searchsorted(np.cumsum(values), _KEPT_OF_AIM * values.sum())) + 1
    return np.asarray((vectors[:, :kept] * np.sqrt(values[:kept])).T)


def _short(n: int) -> int:
    return max(_LEAST_SHORT_LIST, int(_SHORT_LIST * n))


def _owed(group: NDArray[np.int64], chosen: list[int], n: int, fewest: int) -> NDArray[np.bool_]:
    """(m,) candidates that may come next: all, until as many shots are left as groups are still owed."""
    size = int(group.max()) + 1
    has, available = np.bincount(group[chosen], minlength=size), np.bincount(group, minlength=size)
    owed = np.maximum(np.minimum(fewest, available) - has, 0)
    if owed.sum() < n - len(chosen):
        return np.ones(len(group), dtype=np.bool_)
    return np.asarray(owed[group] > 0)


def _may_replace(group: NDArray[np.int64], chosen: list[int], out: int, fewest: int) -> NDArray[np.bool_]:
    """(m,) candidates that may stand in for one of the chosen without leaving its group too few."""
    if (group[chosen] == group[out]).sum() > fewest:
        return np.ones(len(group), dtype=np.bool_)
    return np.asarray(group == group[out])
