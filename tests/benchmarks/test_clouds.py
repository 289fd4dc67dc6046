"""A million points: reading and writing PLY beside Open3D, and voxel fusion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.files.ply import read_ply, write_ply
from measure.fuse import VoxelGrid
from tests.support.timing import best_of, tell

pytestmark = pytest.mark.bench

N_POINTS = 1_000_000


@pytest.fixture(scope="module")
def points_mm() -> NDArray[np.float32]:
    """A million points of a wavy surface about 0.2 mm apart, with noise, base frame."""
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(1000) * 0.2, np.arange(1000) * 0.2)
    z = 300 + 5 * np.sin(x / 20) * np.cos(y / 15) + rng.normal(0, 0.05, x.shape)
    return np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)


def test_ply_beside_open3d(points_mm: NDArray[np.float32], tmp_path: Path) -> None:
    import open3d

    path = tmp_path / "cloud.ply"
    tell("PLY write, 1 M points, fsync", best_of(5, lambda: write_ply(path, points_mm, comments=("unit mm",))))
    ours_s = best_of(5, lambda: read_ply(path))
    theirs_s = best_of(5, lambda: open3d.t.io.read_point_cloud(path))
    legacy_s = best_of(3, lambda: open3d.io.read_point_cloud(path))
    tell("PLY read, 1 M points", ours_s)
    tell("PLY read, 1 M points, Open3D tensor", theirs_s, f"{theirs_s / ours_s:.1f} x ours")
    tell("PLY read, 1 M points, Open3D legacy", legacy_s, f"{legacy_s / ours_s:.1f} x ours")
    assert np.array_equal(read_ply(path).points_mm, points_mm)
    assert ours_s < min(theirs_s, legacy_s)


def test_voxel_fusion(points_mm: NDArray[np.float32]) -> None:
    VoxelGrid(0.5).add(points_mm[:10])
    grid = VoxelGrid(0.5)
    cold_s = best_of(1, lambda: grid.add(points_mm))
    warm_s = best_of(5, lambda: grid.add(points_mm))
    tell("voxel fusion 0.5 mm, 1 M points, empty table", cold_s, f"{N_POINTS / cold_s / 1e6:.0f} Mpoints/s")
    tell("voxel fusion 0.5 mm, 1 M points, again", warm_s, f"{N_POINTS / warm_s / 1e6:.0f} Mpoints/s, {grid.n_voxels} voxels")
    assert int(grid.fused().count.sum()) == 6 * N_POINTS
