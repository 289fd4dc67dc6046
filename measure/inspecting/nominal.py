"""The nominal: a triangle mesh of the part, its units and faults seen to, and exact signed distances from it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.errors import FileError
from drivers.files.disk import read_bytes, sha256_hex
from drivers.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    import trimesh

SUFFIXES = (".stl", ".ply", ".obj", ".off")
_CAD = (".step", ".stp", ".iges", ".igs", ".x_t", ".sldprt", ".jt")
_SMALLEST_PART_MM = 2.0
_LARGEST_PART_MM = 50_000.0


class Surface(NamedTuple):
    """Of query points (n, 3), the nearest of the mesh."""

    signed_mm: FloatArray
    """(n,) positive outside of the material."""
    nearest_mm: FloatArray
    """(n, 3)."""
    normal: FloatArray
    """(n, 3) of the face, edge or corner there; out of the material."""
    at_border: NDArray[np.bool_]
    """(n,) nearest to the rim of a hole in the mesh: neither distance nor sign mean anything there."""


@dataclass(frozen=True, slots=True, eq=False)
class Nominal:
    """A mesh, ready to be asked."""

    file: Path
    sha256: str
    vertices_mm: FloatArray
    """(v, 3)."""
    faces: NDArray[np.int64]
    """(f, 3) counter-clockwise from outside."""
    notes: tuple[str, ...]
    """What was wrong with it, and what was done."""

    @property
    def box_mm(self) -> FloatArray:
        """(2, 3) lower and upper corner."""
        return np.stack([self.vertices_mm.min(axis=0), self.vertices_mm.max(axis=0)])


def load_nominal(path: str | Path) -> Nominal:
    """Read a mesh in mm.

    Faces that look inward are turned, solid by solid; a mesh with holes is used and told.

    Raises:
        FileError: missing, of an unknown kind, no mesh, not finite, or of a size that no part in mm has.
    """
    file = Path(path)
    if file.suffix.lower() in _CAD:
        raise FileError(
            f"{file.suffix.upper()[1:]} models are not read: every free reader of them rests on a library under LGPL",
            file=file,
            remedy="Save the part as STL from the CAD system, in mm, with a chord tolerance far below the part's.",
        )
    if file.suffix.lower() not in SUFFIXES:
        raise FileError(f"is no mesh that is known ({file.suffix or 'no suffix'})", file=file, remedy=f"Name one of {', '.join(SUFFIXES)}.")
    data = read_bytes(file)
    mesh = _parsed(data, file)
    notes = _require_size(mesh, file)
    return Nominal(file, sha256_hex(data), *_sound(mesh, notes), tuple(notes))


def _parsed(data: bytes, file: Path) -> trimesh.Trimesh:
    import io

    import trimesh

    remedy = "Export the part again as binary STL in mm."
    try:
        loaded = trimesh.load(io.BytesIO(data), file_type=file.suffix.lower()[1:], force="mesh", process=True)
    except Exception as error:  # trimesh's readers let out whatever a broken file makes happen
        raise FileError(f"cannot be read as a mesh ({type(error).__name__}: {error})", file=file, remedy=remedy) from error
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        raise FileError("holds no triangles", file=file, remedy=remedy)
    if not np.isfinite(loaded.vertices).all():
        raise FileError("has corners that are not finite", file=file, remedy=remedy)
    return loaded


def _require_size(mesh: trimesh.Trimesh, file: Path) -> list[str]:
    size = float(np.ptp(mesh.vertices, axis=0).max())
    if size < _SMALLEST_PART_MM:
        raise FileError(f"is {size:.3g} long: probably in metres", file=file, remedy="Export it in mm.")
    if size > _LARGEST_PART_MM:
        raise FileError(f"is {size:.3g} long: probably in micrometres", file=file, remedy="Export it in mm.")
    return []


def _sound(mesh: trimesh.Trimesh, notes: list[str]) -> tuple[FloatArray, NDArray[np.int64]]:
    """Faces turned so that every solid has them outward; what was found goes to the notes."""
    mesh.merge_vertices()
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    n_turned = 0
    for rows in _solids(faces):
        turned = _turned(vertices, faces[rows])
        faces[rows[turned]] = faces[rows[turned]][:, ::-1]
        n_turned += int(turned.sum())
    if n_turned:
        notes.append(f"{n_turned} of {len(faces)} faces of the nominal looked into the part and were turned")
    n_border = _border_edges(faces)
    if n_border:
        notes.append(f"the nominal has holes ({n_border} open edges): points nearest to their rims are left out of the deviations")
    return vertices, faces


def _turned(vertices: FloatArray, faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which faces (f, 3) of one solid must be turned for all of them to look outward.

    Neighbours must run their common edge in opposite directions; each piece that hangs together keeps the sense of most
    of its faces. Then the volume they enclose must be positive, which an open shell has a sign of too.
    """
    turned = np.zeros(len(faces), dtype=np.bool_)
    if not _is_consistent(faces):
        edges, owner = _directed(faces)
        _, which, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
        order = np.argsort(which.reshape(-1), kind="stable")
        first = np.cumsum(count) - count
        pairs = np.stack([order[first[count == 2]], order[first[count == 2] + 1]], axis=1)
        same = (edges[pairs[:, 0]] == edges[pairs[:, 1]]).all(axis=1)
        turned = _spread(owner[pairs], same, len(faces))
    wound = np.where(turned[:, None], faces[:, ::-1], faces)
    corners = vertices[wound] - vertices[wound].reshape(-1, 3).mean(axis=0)
    volume = float(np.einsum("ni,ni->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))
    return np.asarray(~turned if volume < 0 else turned)


def _spread(pairs: NDArray[np.int64], differ: NDArray[np.bool_], n_faces: int) -> NDArray[np.bool_]:
    """Turn faces (n,) so that every pair agrees, as few of each piece as that takes."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    both = np.concatenate([pairs, pairs[:, ::-1]])
    graph = coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(n_faces, n_faces)).tocsr()
    differs = dict(zip(map(tuple, both.tolist()), [*differ.tolist(), *differ.tolist()], strict=True))
    n_pieces, piece = connected_components(graph, directed=False)
    turned = np.zeros(n_faces, dtype=np.bool_)
    for number in range(n_pieces):
        members = np.flatnonzero(piece == number)
        order, before = breadth_first_order(graph, members[0], directed=False)
        for face in order[1:].tolist():
            turned[face] = turned[before[face]] ^ differs[int(before[face]), face]
        if turned[members].sum() > len(members) / 2:
            turned[members] = ~turned[members]
    return turned


def _is_consistent(faces: NDArray[np.int64]) -> bool:
    """Whether no edge is run more often one way than the other, but for the rims of holes."""
    edges, _ = _directed(faces)
    _, which, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    balance = np.bincount(which.reshape(-1), np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0))
    return bool(((balance == 0) | (count == 1)).all())


def _directed(faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Edges (3 f, 2) as faces run them, and the face of each."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return edges, np.tile(np.arange(len(faces)), 3)


def _solids(faces: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Rows of faces that hang together by their corners."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges, _ = _directed(faces)
    n = int(faces.max()) + 1
    n_solids, of_corner = connected_components(coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n)), directed=False)
    label = of_corner[faces[:, 0]]
    order = np.argsort(label, kind="stable")
    return np.split(order, np.cumsum(np.bincount(label, minlength=n_solids))[:-1])


def _border_edges(faces: NDArray[np.int64]) -> int:
    edges, _ = _directed(faces)
    _, count = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    return int((count == 1).sum())
