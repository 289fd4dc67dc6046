"""Signed distances from a mesh: nearest face by Open3D, the rest exact in float64.

The sign is that of the pseudonormal of what is nearest (J. A. Baerentzen and H. Aanaes, IEEE TVCG 11, 2005): the
face's normal, the sum of both faces' normals at an edge, the sum weighted by angles at a corner. It needs no closed mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.kinematics.se3 import FloatArray
from measure.inspecting.nominal import Nominal, Surface

if TYPE_CHECKING:
    import open3d

_ON_RIM = 1e-7
_CHUNK = 1 << 17


@dataclass(frozen=True, slots=True, eq=False)
class NominalSurface:
    """A nominal that answers quickly."""

    nominal: Nominal
    _scene: open3d.t.geometry.RaycastingScene
    _middle_mm: FloatArray
    _face_normal: FloatArray
    """(f, 3)."""
    _edge_normal: FloatArray
    """(f, 3, 3) of the edge opposite to each corner."""
    _corner_normal: FloatArray
    """(v, 3)."""
    _edge_is_border: NDArray[np.bool_]
    """(f, 3)."""
    _corner_is_border: NDArray[np.bool_]
    """(v,)."""

    @classmethod
    def of(cls, nominal: Nominal) -> NominalSurface:
        """Prepare; imports Open3D."""
        import open3d

        vertices, faces = nominal.vertices_mm, nominal.faces
        middle = nominal.box_mm.mean(axis=0)
        scene = open3d.t.geometry.RaycastingScene()
        near_origin = np.ascontiguousarray(vertices - middle, dtype=np.float32)
        scene.add_triangles(open3d.core.Tensor.from_numpy(near_origin), open3d.core.Tensor.from_numpy(np.ascontiguousarray(faces, dtype=np.uint32)))
        corners = vertices[faces]
        normal = _unit(np.asarray(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dtype=np.float64))
        edges = np.sort(np.concatenate([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]]), axis=1)
        _, which, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
        which = which.reshape(-1)
        sums = np.column_stack([np.asarray(np.bincount(which, np.tile(normal[:, i], 3)), dtype=np.float64) for i in range(3)])
        border = (count == 1)[which].reshape(3, -1).T
        corner_border = np.zeros(len(vertices), dtype=np.bool_)
        corner_border[edges[(count == 1)[which]]] = True
        by_edge = np.swapaxes(_unit(sums)[which].reshape(3, -1, 3), 0, 1)
        return cls(nominal, scene, middle, normal, by_edge, _corner_normals(vertices, faces, normal), border, corner_border)

    def nearest(self, points_mm: FloatArray) -> Surface:
        """Of finite points (n, 3) in the part's frame."""
        import open3d

        parts = []
        for start in range(0, max(len(points_mm), 1), _CHUNK):
            chunk = points_mm[start : start + _CHUNK]
            query = open3d.core.Tensor.from_numpy(np.ascontiguousarray(chunk - self._middle_mm, dtype=np.float32))
            face = self._scene.compute_closest_points(query)["primitive_ids"].numpy().astype(np.int64)
            parts.append(self._exact(chunk, face))
        return Surface(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _exact(self, points: FloatArray, face: NDArray[np.int64]) -> Surface:
        corners = self.nominal.vertices_mm[self.nominal.faces[face]]
        share = _barycentric(points, corners)
        nearest = np.einsum("nc,nci->ni", share, corners)
        on = share > _ON_RIM
        n_on = on.sum(axis=1)
        normal = self._face_normal[face].copy()
        border = np.zeros(len(points), dtype=np.bool_)
        at_edge = n_on == 2
        opposite = np.argmin(on[at_edge], axis=1)
        normal[at_edge] = self._edge_normal[face[at_edge], opposite]
        border[at_edge] = self._edge_is_border[face[at_edge], opposite]
        at_corner = n_on == 1
        corner = self.nominal.faces[face[at_corner], np.argmax(share[at_corner], axis=1)]
        normal[at_corner] = self._corner_normal[corner]
        border[at_corner] = self._corner_is_border[corner]
        way = points - nearest
        side = np.where(np.einsum("ni,ni->n", way, normal) < 0, -1.0, 1.0)
        return Surface(side * np.linalg.norm(way, axis=1), nearest, normal, border)


def _unit(vectors: FloatArray) -> FloatArray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1.0))


def _corner_normals(vertices: FloatArray, faces: NDArray[np.int64], normal: FloatArray) -> FloatArray:
    sums = np.zeros_like(vertices)
    for k in range(3):
        here, following, before = (vertices[faces[:, (k + j) % 3]] for j in range(3))
        cosine = np.einsum("ni,ni->n", _unit(following - here), _unit(before - here))
        angle = np.arccos(np.clip(cosine, -1, 1))
        for i in range(3):
            sums[:, i] += np.bincount(faces[:, k], angle * normal[:, i], len(vertices))
    return _unit(sums)


def _barycentric(points: FloatArray, corners: FloatArray) -> FloatArray:
    """(n, 3) shares of the corners (n, 3, 3) in the nearest point of each triangle.

    The regions of Ericson, "Real-Time Collision Detection", 2005, 5.1.5: inside, three edges, three corners.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac, ap = b - a, c - a, points - a
    d00, d01, d11 = (np.einsum("ni,ni->n", u, v) for u, v in ((ab, ab), (ab, ac), (ac, ac)))
    d20, d21 = np.einsum("ni,ni->n", ap, ab), np.einsum("ni,ni->n", ap, ac)
    area = np.maximum(d00 * d11 - d01 * d01, 1e-300)
    v, w = (d11 * d20 - d01 * d21) / area, (d00 * d21 - d01 * d20) / area
    share = np.column_stack([1 - v - w, v, w])
    outside = np.flatnonzero((share < 0).any(axis=1))
    if len(outside):
        share[outside] = _on_edges(points[outside], corners[outside])
    return share


def _on_edges(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Shares of the nearest point on the rim of each triangle: the best of its three edges."""
    best = np.full(len(points), np.inf)
    shares = np.zeros((len(points), 3))
    for k in range(3):
        start, end = corners[:, k], corners[:, (k + 1) % 3]
        way = end - start
        t = np.clip(np.einsum("ni,ni->n", points - start, way) / np.maximum(np.einsum("ni,ni->n", way, way), 1e-300), 0.0, 1.0)
        distance = np.linalg.norm(points - start - t[:, None] * way, axis=1)
        nearer = distance < best
        best[nearer] = distance[nearer]
        row = np.zeros((len(points), 3))
        row[:, k], row[:, (k + 1) % 3] = 1 - t, t
        shares[nearer] = row[nearer]
    return shares
