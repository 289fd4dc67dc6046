"""Which place in the base belongs to which named sphere, where several of one size stand about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations, islice, permutations

import numpy as np

from acquire.cell import Cell
from calibrate.problem import IntArray
from calibrate.start_consensus import GATE_MM, Candidates
from drivers.kinematics.se3 import FloatArray

SAME_SIZE = 0.06
"""The finder takes spheres for one size whose radii differ by less."""
_LEAST_SHOTS = 2
_NEAR_ENOUGH_MM = 150.0
_LENGTH_OFF_MM = 5.0
_AIM = 0.5
"""A shot is rather of the sphere nearest to the camera's axis than of another that it also shows."""
_MOST_ORDERS = 20_000


def same_size(cell: Cell, name: str) -> tuple[str, ...]:
    """Names of the cell's spheres that a scan cannot tell from this one, itself included."""
    radius_mm = cell.spheres[name].radius_mm
    return tuple(other for other, sphere in cell.spheres.items() if abs(sphere.radius_mm / radius_mm - 1) < SAME_SIZE)


def name_places(candidates: Candidates, names: Sequence[str], flange_from_camera: FloatArray, cell: Cell) -> Mapping[str, FloatArray]:
    """Places (3,) of named spheres (`candidates.sphere` counts them) with a hand-eye transform (4, 4); those without one are left out."""
    in_base, found = candidates.in_base_mm(flange_from_camera), {}
    left = list(names)
    while left:
        alike = [name for name in left if name in same_size(cell, left[0])]
        rows = np.flatnonzero(np.isin(candidates.sphere, [names.index(name) for name in alike]))
        places = _places(in_base[rows], candidates.shot[rows])
        votes = np.array([_votes(candidates, rows, in_base, places, names.index(name)) for name in alike])
        found.update(_assigned(alike, places, votes, cell))
        left = [name for name in left if name not in alike]
    return found


def _places(in_base_mm: FloatArray, shot: IntArray) -> FloatArray:
    """(P, 3) where two or more shots see something, best supported first."""
    found, free = [], np.ones(len(shot), dtype=bool)
    near = np.linalg.norm(in_base_mm[:, None] - in_base_mm[None], axis=2) < GATE_MM
    member = np.eye(int(shot.max()) + 1)[shot] if len(shot) else np.zeros((0, 0))
    while free.any():
        support = ((near & free[None]).astype(np.float64) @ member > 0).sum(axis=1) * free
        best = int(support.argmax())
        if support[best] < _LEAST_SHOTS:
            break
        found.append(np.median(in_base_mm[near[best] & free], axis=0))
        free &= np.linalg.norm(in_base_mm - found[-1], axis=1) >= GATE_MM
        free[best] = False
    return np.array(found).reshape(-1, 3)


def _votes(candidates: Candidates, rows: IntArray, in_base_mm: FloatArray, places: FloatArray, sphere: int) -> FloatArray:
    """(P,) shots of a named sphere that see something at each place, and half as many again where it is what they aim at."""
    votes = np.zeros(len(places))
    own = rows[candidates.sphere[rows] == sphere]
    off_axis = np.linalg.norm(candidates.centre_in_camera_mm[:, :2], axis=1) / np.abs(candidates.centre_in_camera_mm[:, 2])
    for shot in np.unique(candidates.shot[own]):
        seen = own[candidates.shot[own] == shot]
        at = np.linalg.norm(in_base_mm[seen][:, None] - places[None], axis=2) < GATE_MM
        votes += at.any(axis=0) + _AIM * at[off_axis[seen].argmin()]
    return votes


def _assigned(names: Sequence[str], places: FloatArray, votes: FloatArray, cell: Cell) -> dict[str, FloatArray]:
    from scipy.optimize import linear_sum_assignment

    if not len(places):
        return {}
    believed = [cell.spheres[name].centre_in_base_mm for name in names]
    if all(centre is not None for centre in believed):
        off = np.linalg.norm(np.array(believed, dtype=np.float64)[:, None] - places[None], axis=2)
        first, second = linear_sum_assignment(np.minimum(off, _NEAR_ENOUGH_MM))
        if off[first, second].max() < _NEAR_ENOUGH_MM:
            return {names[int(i)]: places[p] for i, p in zip(first, second, strict=True)}
    first, second = linear_sum_assignment(-votes)
    best = {names[int(i)]: places[p] for i, p in zip(first, second, strict=True) if votes[i, p] > 0}
    return best if not _lengths_off(best, cell) else _by_lengths(names, places, votes, cell, best)


def _lengths_off(named: Mapping[str, FloatArray], cell: Cell) -> int:
    """How many certified lengths the places contradict."""
    known = [length for length in cell.lengths if set(length.between) <= set(named)]
    return sum(abs(float(np.linalg.norm(named[a] - named[b])) - length.length_mm) > _LENGTH_OFF_MM for length in known for a, b in [length.between])


def _by_lengths(names: Sequence[str], places: FloatArray, votes: FloatArray, cell: Cell, best: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """The order of places that contradicts the fewest lengths, then has the most votes."""
    rank = (_lengths_off(best, cell), -float("inf"))
    if len(names) > len(places):
        return best
    for order in islice(permutations(range(len(places)), len(names)), _MOST_ORDERS):
        named = {name: places[p] for name, p in zip(names, order, strict=True)}
        of_order = (_lengths_off(named, cell), -float(sum(votes[i, p] for i, p in enumerate(order))))
        if of_order < rank:
            rank, best = of_order, named
    return best


def names_another(places: Mapping[str, FloatArray], cell: Cell) -> bool:
    """Whether a sphere stands where the cell file puts another of its size."""
    for name, other in combinations(places, 2):
        if other in same_size(cell, name):
            own, its = cell.spheres[name].centre_in_base_mm, cell.spheres[other].centre_in_base_mm
            if own is not None and its is not None and (_swapped(places[name], own, its) or _swapped(places[other], its, own)):
                return True
    return False


def _swapped(place: FloatArray, own: object, other: object) -> bool:
    to_own, to_other = (float(np.linalg.norm(place - np.asarray(centre, dtype=np.float64))) for centre in (own, other))
    return to_other < min(to_own, _NEAR_ENOUGH_MM)
