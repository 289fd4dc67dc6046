"""The Jacobian columns of every shot in one pass over the links: what `problem.linearise_geometry` puts together.

The motions are those of `datum.twist_columns`, `link_columns` and `term_columns`, turned into camera axes; small matrices
one at a time are a thirtieth of the time of the same as NumPy arrays.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import vectorised

FloatArray = NDArray[np.float64]


@vectorised
def chain_frames(links: FloatArray, twists: FloatArray, base_from_flange: FloatArray, turned: FloatArray) -> None:
    """Fill `base_from_flange` (m, 4, 4) and `turned` (m, n, 4, 4), the frames of the twists: each axis turned, its own twist not yet applied.

    `links` (m, n, 4, 4) are those of `mdh.link_transforms`, `twists` (n, 4, 4) those of the link twists.
    """
    before, after = np.zeros((4, 4)), np.zeros((4, 4))
    for j in range(links.shape[0]):
        before[:] = 0.0
        for a in range(4):
            before[a, a] = 1.0
        for i in range(links.shape[1]):
            _product(before, links[j, i], after)
            turned[j, i] = after
            _product(after, twists[i], before)
        base_from_flange[j] = before


@vectorised
def _product(first: FloatArray, second: FloatArray, result: FloatArray) -> None:
    """Of transforms (4, 4)."""
    for a in range(3):
        for b in range(4):
            result[a, b] = first[a, 0] * second[0, b] + first[a, 1] * second[1, b] + first[a, 2] * second[2, b]
        result[a, 3] += first[a, 3]
    result[3, 3] = 1.0


@vectorised
def _turned(rotation: FloatArray, frame: FloatArray, turn: FloatArray) -> None:
    """Make turn (3, 3) = rotation (3, 3) @ the rotation of a frame (4, 4)."""
    for a in range(3):
        for b in range(3):
            turn[a, b] = rotation[a, 0] * frame[0, b] + rotation[a, 1] * frame[1, b] + rotation[a, 2] * frame[2, b]


@vectorised
def _moved_by_twist(turn: FloatArray, frame: FloatArray, point: FloatArray, twist: FloatArray) -> None:
    """Make twist (3, 6), the motion of a point (3,), in the axes that `turn` (3, 3) leads to, per left twist in a frame (4, 4)."""
    x, y, z = point[0] - frame[0, 3], point[1] - frame[1, 3], point[2] - frame[2, 3]
    p0 = frame[0, 0] * x + frame[1, 0] * y + frame[2, 0] * z
    p1 = frame[0, 1] * x + frame[1, 1] * y + frame[2, 1] * z
    p2 = frame[0, 2] * x + frame[1, 2] * y + frame[2, 2] * z
    for a in range(3):
        twist[a, 0], twist[a, 1], twist[a, 2] = turn[a, 0], turn[a, 1], turn[a, 2]
        # -turn @ hat(p)
        twist[a, 3] = turn[a, 2] * p1 - turn[a, 1] * p2
        twist[a, 4] = turn[a, 0] * p2 - turn[a, 2] * p0
        twist[a, 5] = turn[a, 1] * p0 - turn[a, 0] * p1


@vectorised
def motion_columns(
    camera_from_base: FloatArray,
    base_from_flange: FloatArray,
    turned: FloatArray,
    left_jacobian: FloatArray,
    load: FloatArray,
    points: FloatArray,
    spheres: NDArray[np.int64],
    first_columns: NDArray[np.int64],
    columns: FloatArray,
) -> None:
    """Fill `columns[:, :3]` (m, 3, P) with motions of points (m, 3), base frame, in camera axes.

    Args:
        camera_from_base: (m, 3, 3) rotations.
        base_from_flange: (m, 4, 4).
        turned: (m, n, 4, 4) frames of the link twists, (m, 0, 4, 4) without links.
        left_jacobian: (n, 6, 6) of the link twists.
        load: (m, n, K) of deflection terms, (m, 0, 0) without.
        points: (m, 3) that the flange carries.
        spheres: (m,) indices.
        first_columns: of the links, hand-eye, terms and centres.
        columns: (m, >= 3, P), zero.
    """
    turn, twist = np.zeros((3, 3)), np.zeros((3, 6))
    links, hand_eye, terms, centres = first_columns
    for j in range(points.shape[0]):
        for i in range(turned.shape[1]):
            frame = turned[j, i]
            _turned(camera_from_base[j], frame, turn)
            _moved_by_twist(turn, frame, points[j], twist)
            for a in range(3):
                t0, t1, t2, t3, t4, t5 = twist[a, 0], twist[a, 1], twist[a, 2], twist[a, 3], twist[a, 4], twist[a, 5]
                for b in range(6):
                    shift = t0 * left_jacobian[i, 0, b] + t1 * left_jacobian[i, 1, b] + t2 * left_jacobian[i, 2, b]
                    turned_by = t3 * left_jacobian[i, 3, b] + t4 * left_jacobian[i, 4, b] + t5 * left_jacobian[i, 5, b]
                    columns[j, a, links + 6 * i + b] = shift + turned_by
                for k in range(load.shape[2]):
                    # a link yields about its own axis, the third of its frame
                    columns[j, a, terms + k] += twist[a, 5] * load[j, i, k]
        _turned(camera_from_base[j], base_from_flange[j], turn)
        _moved_by_twist(turn, base_from_flange[j], points[j], twist)
        for a in range(3):
            for b in range(6):
                columns[j, a, hand_eye + b] = twist[a, b]
            for b in range(3):
                columns[j, a, centres + 3 * spheres[j] + b] -= camera_from_base[j, a, b]
