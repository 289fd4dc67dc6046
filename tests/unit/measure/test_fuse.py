"""The voxel table: exact against slow arithmetic; order, splitting, threads and tiles change no bit."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from drivers.errors import DataError, FileError, SettingsError
from measure import fuse_kernels
from measure.fuse import FusedCloud, VoxelGrid

FloatArray = NDArray[np.float64]
UNIT_VARIANCE_MM2 = 0.004


@dataclass(frozen=True)
class Scan:
    """Points with all that a grid takes."""

    points_mm: FloatArray
    weights: NDArray[np.uint8]
    normals: NDArray[np.int16]
    variances: NDArray[np.uint32]

    def rows(self, chosen: NDArray[np.int64]) -> Scan:
        return Scan(self.points_mm[chosen], self.weights[chosen], self.normals[chosen], self.variances[chosen])


def draw_scan(rng: np.random.Generator, n: int = 1500) -> Scan:
    points = rng.normal([900, -400, 300], [3, 3, 0.3], size=(n, 3))
    points[::97] = np.nan
    normals = rng.normal([0, 0, 12_000], 2000, size=(n, 3)).astype(np.int16)
    return Scan(points, rng.integers(0, 256, n).astype(np.uint8), normals, rng.integers(0, 2_000_000, n).astype(np.uint32))


def add(grid: VoxelGrid, scan: Scan) -> None:
    grid.add(scan.points_mm, weights=scan.weights, normals=scan.normals, variances=scan.variances)


def fuse(scans: list[Scan], voxel_mm: float = 0.7, *, n_threads: int = 1, **settings: object) -> FusedCloud:
    grid = VoxelGrid(voxel_mm, unit_variance_mm2=UNIT_VARIANCE_MM2, **settings)  # type: ignore[arg-type]
    with ThreadPoolExecutor(n_threads) as pool:
        for future in [pool.submit(add, grid, scan) for scan in scans]:
            future.result()
    return grid.fused()


def bits(cloud: FusedCloud, *, but: tuple[str, ...] = ()) -> dict[str, bytes]:
    names = ("points_mm", "count", "weight", "scans", "spread_mm", "normals", "uncertainty_mm")
    return {name: getattr(cloud, name).tobytes() for name in names if name not in but}


def exact_cloud(scans: list[Scan], voxel_mm: float) -> dict[tuple[int, ...], dict[str, FloatArray]]:
    """Every figure of every voxel by fractions, from the fixed-point places that the table documents."""
    steps = fuse_kernels.FRACTION
    members: dict[tuple[int, ...], list[tuple[int, list[Fraction], list[int], int, int]]] = {}
    for number, scan in enumerate(scans):
        for point, weight, normal, variance in zip(scan.points_mm, scan.weights, scan.normals, scan.variances, strict=True):
            if not np.isfinite(point).all() or weight == 0:
                continue
            cell = np.floor(point / voxel_mm)
            place = [Fraction(int(f * steps)) + Fraction(1, 2) for f in point / voxel_mm - cell]
            members.setdefault(tuple(int(c) for c in cell), []).append((int(weight), place, [int(c) for c in normal], int(variance), number))
    return {key: exact_voxel(key, inside, voxel_mm) for key, inside in members.items()}


def exact_voxel(key: tuple[int, ...], members: list[tuple[int, list[Fraction], list[int], int, int]], voxel_mm: float) -> dict[str, FloatArray]:
    total = sum(w for w, *_ in members)
    mean = [Fraction(sum(w * place[a] for w, place, *_ in members)) / total for a in range(3)]
    moments = np.array([[float(sum(w * (p[a] - mean[a]) * (p[b] - mean[b]) for w, p, *_ in members) / total) for b in range(3)] for a in range(3)])
    step = voxel_mm / fuse_kernels.FRACTION
    normal = np.array([sum(w * n[a] for w, _, n, *_ in members) for a in range(3)], dtype=np.float64)
    normal /= np.linalg.norm(normal)
    n_scans, count = len({number for *_, number in members}), len(members)
    predicted = UNIT_VARIANCE_MM2 * fuse_kernels.UNIT_WEIGHT * count / total
    systematic = sum(w * v for w, _, _, v, _ in members) / total * fuse_kernels.VARIANCE_STEP_MM2
    figures = {
        "points_mm": [float((key[a] + mean[a] / fuse_kernels.FRACTION) * Fraction(voxel_mm)) for a in range(3)],
        "count": count,
        "weight": total / fuse_kernels.UNIT_WEIGHT,
        "scans": n_scans,
        "spread_mm": float(np.sqrt(np.trace(moments))) * step,
        "normals": normal,
        "uncertainty_mm": np.sqrt(systematic + max(predicted, float(normal @ moments @ normal) * step**2) / n_scans),
    }
    return {name: np.asarray(value, dtype=np.float64) for name, value in figures.items()}


@pytest.mark.parametrize("voxel_mm", [0.1, 0.5, 3.0, 700.0])
def test_every_figure_is_that_of_the_exact_reference(voxel_mm: float) -> None:
    rng = np.random.default_rng(1)
    scans = [draw_scan(rng, 300) for _ in range(3)]
    fused, expected = fuse(scans, voxel_mm), exact_cloud(scans, voxel_mm)
    assert len(fused.count) == len(expected)
    for row, (_key, voxel) in enumerate(sorted(expected.items())):
        for name, value in voxel.items():
            np.testing.assert_allclose(getattr(fused, name)[row], value, rtol=2e-6 if name == "uncertainty_mm" else 3e-7, atol=1e-6 * voxel_mm)
        assert fused.count[row] == voxel["count"]
        assert fused.scans[row] == voxel["scans"]


def test_the_means_are_those_of_the_points_to_a_fraction_of_a_voxel() -> None:
    """Against weighted means of the points themselves: what the fixed-point places lose."""
    scan = draw_scan(np.random.default_rng(4), 4000)
    used = np.isfinite(scan.points_mm).all(axis=1) & (scan.weights > 0)
    points, weights = scan.points_mm[used], scan.weights[used].astype(np.float64)
    _, voxel = np.unique(np.floor(points / 0.5), axis=0, return_inverse=True)
    means = np.stack([np.bincount(voxel, weights * points[:, a]) / np.bincount(voxel, weights) for a in range(3)], axis=1)
    np.testing.assert_allclose(fuse([scan], 0.5).points_mm, means, rtol=0, atol=0.5 * 2.0**-16)


@settings(max_examples=40, deadline=None)
@given(
    points=hnp.arrays(np.float64, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(-1e4, 1e4, width=32)),
    seed=st.integers(0, 2**32 - 1),
    cuts=st.lists(st.integers(0, 60), max_size=4),
)
def test_no_order_and_no_split_changes_a_bit(points: FloatArray, seed: int, cuts: list[int]) -> None:
    rng, n = np.random.default_rng(seed), len(points)
    scan = Scan(points, rng.integers(0, 256, n).astype(np.uint8), rng.integers(-9, 9, (n, 3)).astype(np.int16), np.zeros(n, dtype=np.uint32))
    whole = fuse([scan])
    order = rng.permutation(n)
    assert bits(fuse([scan.rows(order)])) == bits(whole)
    parts = [scan.rows(rows) for rows in np.split(order, sorted(min(cut, n) for cut in cuts))]
    # a scan cut into pieces is several scans, and nothing else differs
    assert bits(fuse(parts), but=("scans", "uncertainty_mm")) == bits(whole, but=("scans", "uncertainty_mm"))
    merged = VoxelGrid(0.7, unit_variance_mm2=UNIT_VARIANCE_MM2)
    for part in parts:
        worker = VoxelGrid(0.7)
        add(worker, part)
        merged.merge(worker)
    assert bits(merged.fused()) == bits(fuse(parts))


def test_threads_order_and_tiles_change_no_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    scans = [draw_scan(rng, 3000) for _ in range(12)]
    expected = bits(fuse(scans, 0.3))
    for n_threads, order in itertools.product((1, 2, 4), (np.arange(12), np.arange(12)[::-1], rng.permutation(12))):
        assert bits(fuse([scans[i] for i in order], 0.3, n_threads=n_threads)) == expected
    for n_threads in (1, 4):
        assert bits(fuse(scans, 0.3, n_threads=n_threads, memory_mb=0.3, spill_folder=tmp_path)) == expected


def test_tiles_are_told_merged_and_cleared_away(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    grid, whole = VoxelGrid(0.2, memory_mb=0.5, spill_folder=tmp_path), VoxelGrid(0.2)
    for _ in range(6):
        scan = draw_scan(rng, 3000)
        add(grid, scan)
        add(whole, scan)
    assert grid.n_tiles >= 3
    assert grid.n_voxels == whole.n_voxels == grid.n_fused()
    assert grid.n_fused(min_count=2) == len(whole.fused(min_count=2).count)
    add(grid, scan)  # filling goes on after a look
    add(whole, scan)
    assert bits(grid.fused(min_count=2)) == bits(whole.fused(min_count=2))
    assert list(tmp_path.iterdir())
    del grid
    assert not list(tmp_path.iterdir())


def test_a_table_that_cannot_go_to_disk_is_told(tmp_path: Path) -> None:
    grid = VoxelGrid(0.2, memory_mb=0.1, spill_folder=tmp_path / "none")
    with pytest.raises(FileError, match="does not fit in memory"):
        add(grid, draw_scan(np.random.default_rng(7)))


def test_means_alone_are_the_same_and_take_less() -> None:
    scans = [draw_scan(np.random.default_rng(8)) for _ in range(2)]
    full, means = fuse(scans), fuse(scans, full=False)
    assert bits(means, but=("spread_mm", "normals", "uncertainty_mm")) == bits(full, but=("spread_mm", "normals", "uncertainty_mm"))
    assert np.isnan(means.spread_mm).all()


def test_the_table_grows_far_beyond_its_first_size() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-2000, 2000, size=(60_000, 3))
    grid, backwards = VoxelGrid(0.5), VoxelGrid(0.5)
    added = grid.add(points)
    backwards.add(points[::-1])
    assert added.n_added == grid.n_voxels == 60_000
    assert bits(grid.fused()) == bits(backwards.fused())


def test_filling_a_table_to_its_load_limit_leaves_a_free_slot() -> None:
    """A fixed table that fills up probes for ever; every size around the first limits must come back."""
    for first in (fuse_kernels.FIRST_CAPACITY, fuse_kernels.FIRST_CAPACITY * 3 // 2, 4 * fuse_kernels.FIRST_CAPACITY):
        for n in range(first - 1, first + 3):
            keys = np.zeros((n, 3))
            # one block of voxels, so that all fall into one part
            keys[:, 0], keys[:, 1], keys[:, 2] = np.arange(n) % 32 + 0.5, np.arange(n) // 32 % 32 + 0.5, np.arange(n) // 1024 + 0.5
            grid = VoxelGrid(1.0)
            grid.add(keys)
            assert grid.n_voxels == n
            assert grid.add(keys).n_added == n
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
    assert fused.count.shape == fused.spread_mm.shape == fused.uncertainty_mm.shape == (0,)


def test_thin_voxels_can_be_left_out() -> None:
    grid = VoxelGrid(1.0)
    grid.add(np.array([[0.5, 0.5, 0.5], [0.6, 0.5, 0.5], [5.5, 0.5, 0.5]]))
    assert grid.fused(min_count=2).count.tolist() == [2]


def test_an_overfull_voxel_is_told_and_not_wrong() -> None:
    grid = VoxelGrid(1.0)
    grid.add(np.array([[0.5, 0.5, 0.5]]))
    (part,) = [part for part in grid._parts if part.n_rows]
    part.rows.view(np.int32)[0, fuse_kernels.WEIGHT] = fuse_kernels.WEIGHT_LIMIT
    with pytest.raises(DataError, match="smaller voxels"):
        grid.add(np.array([[0.5, 0.5, 0.5]]))


@pytest.mark.parametrize("voxel_mm", [0.0, -1.0, np.nan, np.inf])
def test_a_voxel_size_must_be_positive(voxel_mm: float) -> None:
    with pytest.raises(SettingsError, match="voxel"):
        VoxelGrid(voxel_mm)


@pytest.mark.parametrize("memory_mb", [0.0, np.nan])
def test_a_memory_budget_must_be_positive(memory_mb: float) -> None:
    with pytest.raises(SettingsError, match="memory"):
        VoxelGrid(1.0, memory_mb=memory_mb)


@pytest.mark.parametrize(("voxel_mm", "full"), [(2.0, True), (1.0, False)])
def test_grids_of_different_kinds_do_not_merge(voxel_mm: float, full: bool) -> None:
    with pytest.raises(SettingsError, match="merged"):
        VoxelGrid(1.0).merge(VoxelGrid(voxel_mm, full=full))


@pytest.mark.parametrize("memory_mb", [700.0, 0.2])
def test_the_cloud_of_a_box_is_the_part_of_the_whole_cloud_that_touches_it(memory_mb: float, tmp_path: Path) -> None:
    points = np.random.default_rng(4).uniform(-40, 40, (20_000, 3))
    grid = VoxelGrid(2.0, memory_mb=memory_mb, spill_folder=tmp_path)
    for part in np.array_split(points, 4):
        grid.add(part)
    box = np.array([[-13.0, -40.0, 1.5], [9.9, 4.0, 100.0]])
    whole, part_of_it = grid.fused(min_count=2), grid.fused(min_count=2, box_mm=box)
    voxels = np.floor(whole.points_mm / 2.0)
    inside = ((voxels >= np.floor(box[0] / 2.0)) & (voxels <= np.floor(box[1] / 2.0))).all(axis=1)
    assert 0 < inside.sum() < len(inside)
    np.testing.assert_array_equal(part_of_it.points_mm, whole.points_mm[inside])
    np.testing.assert_array_equal(part_of_it.count, whole.count[inside])
    assert len(grid.fused(box_mm=box + 1000).count) == 0
