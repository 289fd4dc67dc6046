"""A workpiece of our own: a stepped block with two through bores, a second step and a round boss, 160 x 100 x 75 mm.

Every solid is closed by itself; joined, they overlap only at shared faces, which no ray from outside can tell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.kinematics.se3 import FloatArray

Faces = NDArray[np.int32]

BLOCK_SIZE_MM = (160.0, 100.0, 75.0)
BORE_RADII_MM = (12.0, 20.0)
BORE_CENTRES_IN_PART_MM = ((-50.0, 0.0), (10.0, 0.0))


def stepped_block(segments: int = 96) -> tuple[FloatArray, Faces]:
    """Vertices (v, 3) in the part frame, mm, and faces (f, 3), outward, counter-clockwise.

    The part's origin is the middle of its bottom face, z up. Bores of radius 12 and 20 mm go through the 40 mm high
    base; a 40 mm long step rises to 60 mm at x > 40; a boss of radius 15 mm stands on it to 75 mm.

    Args:
        segments: Corners of each circle, a multiple of 8.
    """
    bored = [
        _bored_block((x - 30, y - 50, 0), (x + 30, y + 50, 40), radius, segments)
        for (x, y), radius in zip(BORE_CENTRES_IN_PART_MM, BORE_RADII_MM, strict=True)
    ]
    return joined([*bored, block((40, -50, 0), (80, 50, 60)), cylinder((60, 0, 60), 15.0, 15.0, segments)])


def joined(solids: list[tuple[FloatArray, Faces]]) -> tuple[FloatArray, Faces]:
    """Solids as one mesh, side by side."""
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in solids)])
    faces = [faces + offset for (_, faces), offset in zip(solids, offsets, strict=False)]
    return np.concatenate([vertices for vertices, _ in solids]), np.concatenate(faces).astype(np.int32)


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> tuple[FloatArray, Faces]:
    """A box between two corners."""
    outline = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]], dtype=np.float64)
    return _prism(outline, low[2], high[2])


def cylinder(foot: tuple[float, float, float], radius: float, height: float, segments: int) -> tuple[FloatArray, Faces]:
    """A round post on a foot (x, y, z)."""
    return _prism(circle(segments) * radius + foot[:2], foot[2], foot[2] + height)


def _prism(outline: FloatArray, bottom: float, top: float) -> tuple[FloatArray, Faces]:
    """A convex outline (n, 2), counter-clockwise, between two heights."""
    n = len(outline)
    vertices = np.concatenate([at_height(outline, bottom), at_height(outline, top)])
    fan = np.array([[0, i, i + 1] for i in range(1, n - 1)])
    return vertices, np.concatenate([fan[:, ::-1], fan + n, strip(n, 0, n)]).astype(np.int32)


def _bored_block(low: tuple[float, float, float], high: tuple[float, float, float], radius: float, segments: int) -> tuple[FloatArray, Faces]:
    """A block with a round bore through the middle along z."""
    unit = circle(segments)
    centre = (np.array(low[:2]) + high[:2]) / 2
    half = (np.array(high[:2]) - low[:2]) / 2
    # the circle pushed out to the unit square: multiples of 45 degrees become its corners
    outer = unit / np.abs(unit).max(axis=1, keepdims=True) * half + centre
    inner = unit * radius + centre
    layers = [at_height(outer, low[2]), at_height(outer, high[2]), at_height(inner, high[2]), at_height(inner, low[2])]
    n = segments
    # one closed band around: outside, top, bore, bottom
    bands = [strip(n, k * n, ((k + 1) % 4) * n) for k in range(4)]
    return np.concatenate(layers), np.concatenate(bands).astype(np.int32)


def strip(n: int, lower: int, upper: int) -> NDArray[np.int64]:
    """Triangles between two rings of n vertices that start at the given indices, outward for upper above lower."""
    i = np.arange(n)
    j = (i + 1) % n
    return np.concatenate(
        [np.stack([lower + i, lower + j, upper + j], axis=1), np.stack([lower + i, upper + j, upper + i], axis=1)],
    )


def circle(segments: int) -> FloatArray:
    """(n, 2) corners of a regular polygon in the unit circle."""
    angle = np.arange(segments) * (2 * np.pi / segments)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def at_height(outline: FloatArray, z: float) -> FloatArray:
    """(n, 3) an outline (n, 2) at one z."""
    return np.column_stack([outline, np.full(len(outline), z)])
