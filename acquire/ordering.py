"""Choosing well-spread poses from a pool, and an order in which the robot travels little."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquire.candidates import CandidatePool
from drivers.errors import SettingsError
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

# What a full range of each group counts for: the camera volume carries scale and camera error, the rest robot and hand-eye.
_WEIGHT_IN_CAMERA, _WEIGHT_DIRECTION, _WEIGHT_ROLL, _WEIGHT_JOINTS = 1.0, 0.7, 0.4, 0.7
_MOST_SWEEPS = 30
# Kept from the limits by axes whose turn is chosen here.
_LIMIT_MARGIN_RAD = float(np.radians(2))


def choose_spread(pool: CandidatePool, n: int, rng: np.random.Generator, away_from_rad: FloatArray | None = None) -> NDArray[np.intp]:
    """Rows (n,) of a pool, each the farthest from those chosen before it: in the camera, in view direction and roll, and in axis angles.

    Branches of one arm differ in axis angles, so they are spread as well. No view is taken twice while there are others.
    With `away_from_rad` (m, n), axis angles, the first half is as far from those too, whole turns aside: other branches of the arm.

    Raises:
        SettingsError: the pool holds fewer poses than wanted.
    """
    if n > len(pool.view):
        raise SettingsError(
            f"{n} poses are wanted and {len(pool.view)} are feasible",
            remedy="Draw more candidates, allow more tilt, or move the sphere nearer to the middle of the robot's reach.",
        )
    if n <= 0:
        return np.zeros(0, dtype=np.intp)
    features = _features(pool)
    nearest = np.full(len(features), np.inf)
    chosen = [int(rng.integers(len(features)))]
    away = np.full(len(features), np.inf)
    if away_from_rad is not None and len(away_from_rad):
        away = _away(pool.joints_rad, away_from_rad)
        chosen = [int(np.argmax(away))]
    for i in range(1, n):
        nearest = np.minimum(nearest, ((features - features[chosen[-1]]) ** 2).sum(axis=-1))
        nearest[chosen[-1]] = -np.inf
        again = pool.view == pool.view[chosen[-1]]
        nearest[again] = np.minimum(nearest[again], -1.0)
        chosen.append(int(np.argmax(np.minimum(nearest, away) if 2 * i < n else nearest)))
    return np.array(chosen, dtype=np.intp)


def order_by_travel(
    joints_rad: ArrayLike,
    *,
    start_joints_rad: ArrayLike | None = None,
    extra_rad: FloatArray | None = None,
    extra_from_start_rad: FloatArray | None = None,
) -> NDArray[np.intp]:
    """An order (k,) of axis angles (k, n) with little travel: nearest neighbour, then 2-opt; a step costs its largest axis motion.

    The first pose is the one nearest to `start_joints_rad`, or an end of the tour where that is None. `extra_rad` (k, k),
    symmetric, and `extra_from_start_rad` (k,) are what steps cost besides, e.g. where something is in the way.
    """
    joints = np.asarray(joints_rad, dtype=np.float64)
    if len(joints) == 0:
        return np.zeros(0, dtype=np.intp)
    cost = np.abs(joints[:, None] - joints[None]).max(axis=-1) + (0.0 if extra_rad is None else extra_rad)
    if start_joints_rad is None:
        to_start, first = np.zeros(len(joints)), np.argmax(cost.sum(axis=0))
    else:
        to_start = np.abs(joints - np.asarray(start_joints_rad)).max(axis=-1)
        to_start = to_start + (0.0 if extra_from_start_rad is None else extra_from_start_rad)
        first = np.argmin(to_start)
    return _two_opt(_nearest_neighbour(cost, int(first)), cost, to_start)


def unwound(model: RobotModel, joints_rad: FloatArray) -> FloatArray:
    """Axis angles (k, n), each axis in the turns that leave its largest unused arc between the first and the last.

    Where an axis can make more than a turn, an arc that no pose uses is often one that none can pass: a wrist that would run
    into its forearm. Axes that are coupled to others, or have no room for it within their limits, stay as they are.
    """
    result = joints_rad.copy()
    for axis in np.flatnonzero([_turns_alone(model, axis) for axis in range(model.n_joints)]):
        angles = np.mod(joints_rad[:, axis], 2 * np.pi)
        rising = np.sort(angles)
        begin = float(np.roll(rising, -1)[np.argmax(np.diff(rising, append=rising[:1] + 2 * np.pi))])
        angles = begin + np.mod(angles - begin, 2 * np.pi)
        low, high = model.joint_limits_rad[axis]
        middle = 0.5 * (low + high) if np.isfinite(high - low) else 0.0
        angles = angles + 2 * np.pi * round((middle - 0.5 * float(angles.min() + angles.max())) / (2 * np.pi))
        if low + _LIMIT_MARGIN_RAD <= angles.min() and angles.max() <= high - _LIMIT_MARGIN_RAD:
            result[:, axis] = angles
    return result


def _turns_alone(model: RobotModel, axis: int) -> bool:
    """Whether a whole turn of an axis leaves the arm where it is, and is within its limits."""
    unit = np.eye(model.n_joints)[axis]
    alone = (model.coupling[axis] == unit).all() and (model.coupling[:, axis] == unit).all()
    low, high = model.joint_limits_rad[axis]
    return bool(alone and high - low > 2 * np.pi and not any(limit.row[axis] for limit in model.linear_limits))


def travel_rad(joints_rad: ArrayLike) -> float:
    """Sum over steps of the largest axis motion, for axis angles (k, n) in order."""
    return float(np.abs(np.diff(np.asarray(joints_rad, dtype=np.float64), axis=0)).max(axis=-1).sum())


def _features(pool: CandidatePool) -> FloatArray:
    """Numbers (k, f) whose distances tell how different two poses are."""
    direction, across = pool.base_from_camera[:, :3, 2], pool.base_from_camera[:, :3, 0]
    in_camera = pool.centre_in_camera_mm.copy()
    # angles instead of lateral mm: the field of view widens with depth
    in_camera[:, :2] /= in_camera[:, 2:]
    return np.concatenate(
        [
            _WEIGHT_IN_CAMERA * _scaled(in_camera),
            _WEIGHT_DIRECTION * direction,
            _WEIGHT_ROLL * across,
            _WEIGHT_JOINTS * _scaled(pool.joints_rad) / np.sqrt(pool.joints_rad.shape[1]),
        ],
        axis=-1,
    )


def _away(joints_rad: FloatArray, from_rad: FloatArray) -> FloatArray:
    """Squared distances (k,) of axis angles to the nearest of others (m, n), on the scale of `_features`."""
    apart = joints_rad[:, None] - from_rad
    turns = np.abs(apart - 2 * np.pi * np.round(apart / (2 * np.pi)))
    span = np.maximum(np.ptp(joints_rad, axis=0), 1e-9)
    shares = _WEIGHT_JOINTS * np.minimum(turns / span, 1.0) / np.sqrt(joints_rad.shape[1])
    return np.asarray((shares**2).sum(axis=-1).min(axis=1))


def _scaled(values: FloatArray) -> FloatArray:
    span = np.ptp(values, axis=0)
    return np.asarray((values - values.min(axis=0)) / np.where(span > 0, span, 1.0))


def _nearest_neighbour(cost: FloatArray, first: int) -> NDArray[np.intp]:
    free = np.ones(len(cost), dtype=np.bool_)
    order = [first]
    free[first] = False
    while free.any():
        order.append(int(np.argmin(np.where(free, cost[order[-1]], np.inf))))
        free[order[-1]] = False
    return np.array(order, dtype=np.intp)


def _two_opt(order: NDArray[np.intp], cost: FloatArray, to_start: FloatArray) -> NDArray[np.intp]:
    """Reverse stretches of an open tour while that shortens it; the way from the start to the first pose counts."""
    n = len(order)
    for _ in range(_MOST_SWEEPS):
        improved = False
        for i in range(n - 1):
            ends = np.arange(i + 1, n)
            before_i = to_start[order[i]] if i == 0 else cost[order[i - 1], order[i]]
            new_before = to_start[order[ends]] if i == 0 else cost[order[i - 1], order[ends]]
            following = order[np.minimum(ends + 1, n - 1)]
            gain = before_i - new_before + np.where(ends < n - 1, cost[order[ends], following] - cost[order[i], following], 0.0)
            best = int(np.argmax(gain))
            if gain[best] > 1e-9:
                stop = int(ends[best]) + 1
                order[i:stop] = order[i:stop][::-1]
                improved = True
        if not improved:
            break
    return order
