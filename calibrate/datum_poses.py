"""Poses over which the base frame is fitted to the nominal robot: the same for every calibration of a cell.

Fitted over the poses that happened to be used, the base moved by 0.1 mm between calibrations of one robot: two sets of
random poses average the difference between true and nominal robot differently.
"""

from __future__ import annotations

import numpy as np

from calibrate.datum import ARM_MM, MAX_REFERENCES
from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_N_TRIED = 20_000
_PRIMES = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29)


def datum_joints(model: RobotModel, work_volume_mm: FloatArray | None, used_rad: FloatArray) -> FloatArray:
    """(k, n) poses for the datum: over the work volume (2, 3) where the cell states one, else those used (m, n)."""
    return used_rad if work_volume_mm is None else work_volume_joints(model, work_volume_mm)


def work_volume_joints(model: RobotModel, work_volume_mm: FloatArray) -> FloatArray:
    """(k, n) axis angles at which the flange points into a box (2, 3) in the base from the distance of the work.

    A Halton sequence over the axes' limits, at most half a turn each way; the nearest to the box where too few reach it.
    Nothing but the model and the box decides.
    """
    # more than a turn only repeats poses
    lower, upper = np.clip(model.joint_limits_rad, -np.pi, np.pi).T
    tried = lower + (upper - lower) * np.stack([_radical_inverse(_N_TRIED, prime) for prime in _PRIMES[: model.n_joints]], axis=-1)
    tried = tried[mdh.within_limits(model, tried)]
    flange = mdh.base_from_flange(model, tried)
    ahead = flange[:, :3, 3] + ARM_MM * flange[:, :3, 2]
    outside = np.linalg.norm(ahead - np.clip(ahead, work_volume_mm[0], work_volume_mm[1]), axis=1)
    return np.asarray(tried[np.argsort(outside, kind="stable")[:MAX_REFERENCES]])


def _radical_inverse(count: int, base: int) -> FloatArray:
    """Van der Corput sequence 1 to `count` in [0, 1)."""
    index, result, digit = np.arange(1, count + 1), np.zeros(count), 1.0 / base
    while index.any():
        result += digit * (index % base)
        index //= base
        digit /= base
    return result
