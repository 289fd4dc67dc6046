"""PCD and NPZ: Open3D as the oracle, every broken variant told, random bytes never anything but a cloud or a FileError."""

from __future__ import annotations

import io
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import FileError
from drivers.files.clouds import parse_cloud, parse_npz
from drivers.files.pcd import parse_pcd
from drivers.files.ply import encode_ply
from tests.support.pcd_bytes import encode_pcd

ENCODINGS = ("ascii", "binary", "binary_compressed")
GRID = np.random.default_rng(4).uniform(-300, 300, (6, 7, 3)).astype(np.float32)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_grid_and_its_fields_come_back(encoding: str) -> None:
    points, colour = GRID.copy(), np.arange(42, dtype=np.uint32).reshape(6, 7)
    points[2, 3] = np.nan
    cloud = parse_cloud(encode_pcd(points, encoding, extra=colour), file="x")
    assert np.array_equal(cloud.xyz_mm, points, equal_nan=True)
    assert np.array_equal(cloud.properties["rgb"], colour)
    assert cloud.comments == ()
    assert parse_pcd(encode_pcd(GRID[0], encoding, viewpoint="0 0 9 1 0 0 0"), file="x").comments == ("viewpoint 0 0 9 1 0 0 0",)


@pytest.mark.parametrize(("ascii_", "compressed"), [(True, False), (False, False), (False, True)])
def test_open3d_writes_what_is_read(tmp_path: Path, ascii_: bool, compressed: bool) -> None:
    import open3d

    # repeated values make the compressor copy, overlapping copies included
    points = np.tile(GRID.reshape(-1, 3).astype(np.float64), (40, 1))
    points[100:900] = 7.0
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    path = tmp_path / "a.pcd"
    assert open3d.io.write_point_cloud(path, cloud, write_ascii=ascii_, compressed=compressed)
    assert np.allclose(parse_cloud(path.read_bytes(), file=path).xyz_mm, points, rtol=1e-5 if ascii_ else 1e-7)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("change", ["cut", "longer", "points", "field", "type", "packed"])
def test_broken_files_are_told(encoding: str, change: str) -> None:
    data = encode_pcd(GRID, encoding)
    broken = {
        "cut": data[:-5] if encoding != "ascii" else data[: data.rindex(b"\n", 0, -1)],
        "longer": data + b"1 2 3\n" * 2,
        "points": data.replace(b"POINTS 42", b"POINTS 43"),
        "field": data.replace(b"FIELDS x y z", b"FIELDS x y w"),
        "type": data.replace(b"TYPE F F F", b"TYPE F F U"),
        "packed": data.replace(b"WIDTH 7", b"WIDTH 5").replace(b"POINTS 42", b"POINTS 30"),
    }[change]
    with pytest.raises(FileError):
        parse_cloud(broken, file="x")


def npz(**arrays: object) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def test_npz_points_by_their_name_and_what_fits_beside_them() -> None:
    cloud = parse_cloud(npz(points=GRID.astype(np.float64), snr=GRID[..., 0], other=np.zeros(3)), file="x")
    assert np.array_equal(cloud.xyz_mm, GRID)
    assert set(cloud.properties) == {"snr"}


NO_CLOUDS = [npz(cloud=GRID), npz(xyz=GRID[..., :2]), npz(xyz=GRID.astype(int)), npz(xyz=np.array([None] * 3)), npz(xyz=GRID)[:-30]]


@pytest.mark.parametrize("data", [*NO_CLOUDS, b"PK\x03\x04", b"", b"\0" * 99])
def test_other_archives_are_refused(data: bytes) -> None:
    with pytest.raises(FileError):
        parse_cloud(data, file="x")


WHOLE = [*(encode_pcd(GRID[:2], encoding) for encoding in ENCODINGS), npz(xyz=GRID[:1]), encode_ply(GRID[:2])]


def damaged(data: bytes, place: int, put: bytes) -> bytes:
    """Some bytes replaced."""
    at = place % len(data)
    return data[:at] + put + data[at + len(put) :]


@given(st.one_of(st.binary(max_size=200), st.builds(damaged, st.sampled_from(WHOLE), st.integers(0, 10_000), st.binary(min_size=1, max_size=4))))
def test_random_damage_gives_a_cloud_or_a_file_error(data: bytes) -> None:
    with suppress(FileError):
        cloud = parse_cloud(data, file="x")
        assert cloud.xyz_mm.shape[-1] == 3
    with suppress(FileError):
        parse_npz(data, file="x")
