"""Voxel fusion against a slow exact reference, and its laws: order, splitting and thread count change nothing."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from drivers.errors import DataError, SettingsError
from measure import fuse_kernels
from measure.fuse import FusedCloud, VoxelGrid, flying_pixel_mask

FloatArray = NDArray[np.float64]


def fuse(clouds: list[FloatArray], voxel_mm: float) -> FusedCloud:
    grid = VoxelGrid(voxel_mm)
    for cloud in clouds:
        grid.add(cloud)
    return grid.fused()


def reference(points_mm: FloatArray, voxel_mm: float) -> dict[tuple[int, int, int], list[FloatArray]]:
    """Points of each voxel by plain floor division, for finite points."""
    voxels: dict[tuple[int, int, int], list[FloatArray]] = {}
    for point in points_mm[np.isfinite(points_mm).all(axis=1)]:
        i, j, k = (int(x) for x in np.floor(point / voxel_mm))
        voxels.setdefault((i, j, k), []).append(point)
    return voxels


def assert_same_bits(a: FusedCloud, b: FusedCloud) -> None:
    assert a.points_mm.tobytes() == b.points_mm.tobytes()
    assert a.count.tobytes() == b.count.tobytes()
    assert a.spread_mm.tobytes() == b.spread_mm.tobytes()


@pytest.mark.parametrize("voxel_mm", [0.1, 0.5, 3.0, 700.0])
def test_mean_count_and_spread_are_those_of_the_exact_reference(voxel_mm: float) -> None:
    rng = np.random.default_rng(1)
    points = rng.normal([900, -400, 300], [3, 3, 0.3], size=(4000, 3))
    points[::97] = np.nan
    fused = fuse([points[:1500], points[1500:]], voxel_mm)
    expected = reference(points, voxel_mm)
    assert fused.points_mm.shape[0] == len(expected)
    for point, count, spread, (key, members) in zip(fused.points_mm, fused.count, fused.spread_mm, sorted(expected.items()), strict=True):
        mean = [float(sum(Fraction(float(m[axis])) for m in members) / len(members)) for axis in range(3)]
        rms = float(np.sqrt(((np.array(members) - mean) ** 2).sum(axis=1).mean()))
        assert count == len(members), key
        # half a step of the fixed-point fraction per axis
        np.testing.assert_allclose(point, mean, rtol=0, atol=voxel_mm * 2.0**-19 + 1e-12)
        assert abs(spread - rms) < voxel_mm * 2.0**-17


@settings(max_examples=60, deadline=None)
@given(
    points=hnp.arrays(np.float64, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(-1e4, 1e4, width=32)),
    seed=st.integers(0, 2**32 - 1),
    cuts=st.lists(st.integers(0, 60), max_size=4),
)
def test_no_order_and_no_split_changes_a_bit(points: FloatArray, seed: int, cuts: list[int]) -> None:
    whole = fuse([points], 0.7)
    shuffled = np.random.default_rng(seed).permutation(points, axis=0)
    parts = np.split(shuffled, sorted(min(cut, len(points)) for cut in cuts))
    assert_same_bits(whole, fuse(parts, 0.7))
    merged = VoxelGrid(0.7)
    for part in parts:
        worker = VoxelGrid(0.7)
        worker.add(part)
        merged.merge(worker)
    assert_same_bits(whole, merged.fused())


def test_the_table_grows_far_beyond_its_first_size() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-2000, 2000, size=(60_000, 3))
    grid = VoxelGrid(0.5)
    added = grid.add(points)
    assert added.n_added == grid.n_voxels == 60_000
    assert_same_bits(grid.fused(), fuse([points[::-1]], 0.5))


def test_filling_a_table_to_its_load_limit_leaves_a_free_slot() -> None:
    """A fixed table that fills up probes for ever; every size around the first limit must come back."""
    limit = int(0.7 * 4096)
    line = np.zeros((limit + 2, 3))
    line[:, 0] = np.arange(limit + 2) + 0.5
    for n in (limit - 1, limit, limit + 1, limit + 2):
        grid = VoxelGrid(1.0)
        grid.add(line[:n])
        assert grid.n_voxels == n
        assert grid.add(line[:n]).n_added == n
        assert grid.n_voxels == n


def test_invalid_and_far_rows_are_counted_and_left_out() -> None:
    grid = VoxelGrid(0.5)
    far = [[1e300, 0, 0], [0, -6e5, 0], [0, 0, 5.3e5], [1e19, 1e19, 1e19]]
    bad = [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf]]
    added = grid.add(np.array([[1.1, 2.2, 3.3], *far, *bad]))
    assert (added.n_added, added.n_invalid, added.n_outside) == (1, 3, 4)
    np.testing.assert_allclose(grid.fused().points_mm, [[1.1, 2.2, 3.3]], atol=1e-5)


@pytest.mark.parametrize("side", [-1, 1])
def test_the_last_voxels_of_the_range_do_not_collide(side: int) -> None:
    edge = side * (fuse_kernels.HALF_RANGE - 1.5) * 0.5
    corners = np.array(np.meshgrid([edge, 0.25], [edge, 0.25], [edge, 0.25])).reshape(3, -1).T
    grid = VoxelGrid(0.5)
    assert grid.add(corners).n_added == 8
    fused = grid.fused()
    np.testing.assert_allclose(fused.points_mm, corners[np.lexsort(corners.T[::-1])], atol=1e-5)


def test_nothing_in_nothing_out() -> None:
    grid = VoxelGrid(1.0)
    assert grid.add(np.empty((0, 3))).n_added == 0
    assert grid.add(np.full((2, 5, 3), np.nan)).n_invalid == 10
    fused = grid.fused()
    assert fused.points_mm.shape == (0, 3)
    assert fused.count.shape == fused.spread_mm.shape == (0,)


def test_thin_voxels_can_be_left_out() -> None:
    grid = VoxelGrid(1.0)
    grid.add(np.array([[0.5, 0.5, 0.5], [0.6, 0.5, 0.5], [5.5, 0.5, 0.5]]))
    assert grid.fused(min_count=2).count.tolist() == [2]


def test_an_overfull_voxel_is_told_and_not_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = VoxelGrid(1.0)
    grid.add(np.array([[0.5, 0.5, 0.5]]))
    row = np.flatnonzero(grid._table[:, fuse_kernels.KEY])[0]
    grid._table[row, fuse_kernels.COUNT] = fuse_kernels.COUNT_LIMIT
    with pytest.raises(DataError, match="smaller voxels"):
        grid.add(np.array([[0.5, 0.5, 0.5]]))


@pytest.mark.parametrize("voxel_mm", [0.0, -1.0, np.nan, np.inf])
def test_a_voxel_size_must_be_positive(voxel_mm: float) -> None:
    with pytest.raises(SettingsError, match="voxel"):
        VoxelGrid(voxel_mm)


def test_grids_of_different_voxels_do_not_merge() -> None:
    with pytest.raises(SettingsError, match="merged"):
        VoxelGrid(1.0).merge(VoxelGrid(2.0))


def plane_grid(tilt_rad: float, step: float = 1 / 900.0) -> NDArray[np.float32]:
    """An organised scan (60, 80, 3) of a plane 400 mm away, turned about the camera's y axis."""
    u, v = np.meshgrid((np.arange(80) - 40) * step, (np.arange(60) - 30) * step)
    z = 400.0 / (1.0 - np.tan(tilt_rad) * u)
    return np.stack([u * z, v * z, z], axis=-1).astype(np.float32)


@pytest.mark.parametrize("tilt_deg", [0, 45, 75])
def test_a_surface_is_kept_but_for_its_corners(tilt_deg: float) -> None:
    keep = flying_pixel_mask(plane_grid(np.deg2rad(tilt_deg)))
    assert keep.all()


def test_points_between_front_and_back_are_dropped() -> None:
    scan = plane_grid(0.0)
    scan[:, 40:] *= np.float32(1.25)  # a second plane 100 mm behind
    scan[:, 40] *= np.float32(0.9)  # its first column hangs in the air
    scan[10, 10] = np.nan
    keep = flying_pixel_mask(scan)
    assert not keep[:, 40].any()
    assert not keep[10, 10]
    assert keep[:, :40].sum() == 60 * 40 - 1
    assert keep[1:-1, 41:].all()


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (3, 4)])
def test_scans_without_valid_neighbours_keep_nothing(shape: tuple[int, int]) -> None:
    assert not flying_pixel_mask(np.full((*shape, 3), np.nan, dtype=np.float32)).any()
