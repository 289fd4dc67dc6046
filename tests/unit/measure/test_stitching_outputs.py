"""Fused clouds as files: what was fused comes back, by readers of others; a missing library is told before any work."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import FileError, SettingsError
from drivers.files.clouds import parse_cloud
from drivers.files.ply import write_ply
from measure.fuse import FusedCloud, VoxelGrid
from measure.stitching.outputs import CloudLabel, check_suffix, read_fused, write_cloud

LABEL = CloudLabel(("unit mm", "frame base", "calibration abc", "session def", "voxel_mm 0.5", "scans 2"), "base frame, calibration abc")
COLUMNS = {"count": "count", "scans": "scans", "weight": "weight", "spread": "spread_mm", "uncertainty": "uncertainty_mm"}


@pytest.fixture(scope="module")
def grid() -> VoxelGrid:
    rng = np.random.default_rng(1)
    grid = VoxelGrid(0.5, unit_variance_mm2=0.004)
    for _ in range(2):
        normals = rng.normal([0, 0, 12_000], 2000, size=(4000, 3)).astype(np.int16)
        variances = rng.integers(0, 2_000_000, 4000).astype(np.uint32)
        grid.add(rng.normal([900, -400, 300], [8, 8, 0.2], size=(4000, 3)), normals=normals, variances=variances)
    return grid


def written(grid: VoxelGrid, out: Path) -> FusedCloud:
    write_cloud(out, grid.pieces(), grid.n_fused(), LABEL)
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    return grid.fused()


def test_ply_comes_back_as_it_was(grid: VoxelGrid, tmp_path: Path) -> None:
    cloud, again = written(grid, tmp_path / "cloud.ply"), read_fused(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(again.points_mm, cloud.points_mm.astype(np.float32))
    for name in (*COLUMNS.values(), "normals", "voxel_mm"):
        np.testing.assert_array_equal(getattr(again, name), getattr(cloud, name))
    header = (tmp_path / "cloud.ply").read_bytes().split(b"end_header")[0].decode()
    assert all(f"comment {line}\n" in header for line in LABEL.comments)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_open3d_reads_points_and_normals(grid: VoxelGrid, tmp_path: Path, suffix: str) -> None:
    import open3d

    cloud, out = written(grid, tmp_path / f"cloud{suffix}"), tmp_path / f"cloud{suffix}"
    theirs = open3d.io.read_point_cloud(out)
    np.testing.assert_allclose(np.asarray(theirs.points), cloud.points_mm, atol=1e-4)
    np.testing.assert_allclose(np.asarray(theirs.normals), cloud.normals, atol=1e-6)
    ours = parse_cloud(out.read_bytes(), file=out)
    np.testing.assert_array_equal(ours.points_mm, cloud.points_mm.astype(np.float32))


def test_laz_keeps_a_tenth_of_a_micrometre_and_every_column(grid: VoxelGrid, tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    cloud = written(grid, tmp_path / "cloud.laz")
    theirs = laspy.read(tmp_path / "cloud.laz")
    np.testing.assert_allclose(theirs.xyz, cloud.points_mm, atol=0.51e-4)
    for name, ours in COLUMNS.items():
        np.testing.assert_array_equal(theirs[name], getattr(cloud, ours))
    (note,) = theirs.header.vlrs.get_by_id("spherecal")
    assert b"calibration abc" in note.record_data


def test_e57_is_in_metres_and_named(grid: VoxelGrid, tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    cloud = written(grid, tmp_path / "cloud.e57")
    file = pye57.E57(str(tmp_path / "cloud.e57"))
    theirs = file.read_scan_raw(0)
    found = np.stack([theirs[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    np.testing.assert_allclose(found * 1000, cloud.points_mm, atol=1e-9)
    assert "calibration abc" in file.get_header(0)["name"].value()


@pytest.mark.parametrize(("library", "suffix"), [("pye57", ".e57"), ("laspy", ".laz"), ("lazrs", ".laz")])
def test_a_missing_library_is_told_with_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str, suffix: str) -> None:
    if suffix == ".laz":
        pytest.importorskip("laspy")  # it looks for its packers once, when it is loaded
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(SettingsError, match=r"spherecal\[clouds\]"):
        check_suffix(tmp_path / f"cloud{suffix}")


def test_a_failing_piece_leaves_no_file(grid: VoxelGrid, tmp_path: Path) -> None:
    def breaks() -> object:
        yield from grid.pieces()
        raise FileError("the disk has gone", remedy="none")

    for suffix in (".ply", ".pcd", ".laz"):
        if suffix == ".laz":
            pytest.importorskip("lazrs")
        with pytest.raises(FileError, match="gone"):
            write_cloud(tmp_path / f"cloud{suffix}", breaks(), grid.n_fused(), LABEL)  # type: ignore[arg-type]
        assert not list(tmp_path.iterdir())


def test_clouds_of_others_lack_what_they_do_not_tell(tmp_path: Path) -> None:
    write_ply(tmp_path / "plain.ply", np.array([[1.0, 2.0, 3.0]]))
    plain = read_fused(tmp_path / "plain.ply")
    assert np.isnan([plain.uncertainty_mm[0], plain.voxel_mm, *plain.normals[0]]).all()
    assert plain.count.tolist() == [1]
    write_ply(tmp_path / "metres.ply", np.array([[1.0, 2.0, 3.0]]), comments=("unit m",))
    with pytest.raises(FileError, match="in m"):
        read_fused(tmp_path / "metres.ply")
