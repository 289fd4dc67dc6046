"""PLY: exact round trips, every broken variant told, random bytes never anything but a cloud or a FileError."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from drivers.errors import FileError
from drivers.files.ply import PointCloud, encode_ply, parse_ply, read_ply, write_ply

_POINTS = hnp.arrays(
    np.float32,
    hnp.array_shapes(min_dims=1, max_dims=2, min_side=0, max_side=6).map(lambda shape: (*shape, 3)),
    elements=st.floats(width=32, allow_nan=False, allow_infinity=False),
)


def _cube(n: int = 5) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    return np.random.default_rng(1).uniform(-300, 300, (n, 3)).astype(np.float32)


@given(_POINTS, st.sampled_from([np.uint8, np.int16, np.uint32, np.float32, np.float64]))
def test_points_shape_and_properties_come_back(xyz: np.ndarray[tuple[int, ...], np.dtype[np.float32]], kind: type[np.generic]) -> None:
    values = np.arange(xyz[..., 0].size).reshape(xyz.shape[:-1]).astype(kind)
    cloud = parse_ply(encode_ply(xyz, properties={"quality": values}, comments=["unit mm", "frame camera"]), file="x")
    assert np.array_equal(cloud.xyz_mm, xyz)
    assert cloud.xyz_mm.dtype == np.float32
    assert np.array_equal(cloud.properties["quality"], values)
    assert cloud.properties["quality"].dtype == kind
    assert cloud.comments[:2] == ("unit mm", "frame camera")


def test_holes_are_nan_in_all_three(tmp_path: Path) -> None:
    xyz = np.ones((2, 3, 3), dtype=np.float32)
    xyz[0, 1] = np.nan
    xyz[1, 2, 0] = np.inf
    write_ply(tmp_path / "a.ply", xyz)
    cloud = read_ply(tmp_path / "a.ply")
    assert cloud.xyz_mm.shape == (2, 3, 3)
    assert np.isnan(cloud.xyz_mm).all(axis=-1).sum() == 2
    assert np.isfinite(cloud.points_mm).all(axis=-1).sum() == 4
    cloud.xyz_mm[:] = 0  # owned: the file stays
    assert np.isnan(read_ply(tmp_path / "a.ply").xyz_mm).any()
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_a_rewritten_cloud_keeps_its_grid_comments_once() -> None:
    first = parse_ply(encode_ply(np.zeros((2, 3, 3))), file="x")
    again = parse_ply(encode_ply(first.xyz_mm, comments=(*first.comments, "two\nlines")), file="x")
    assert again.comments == ("two lines", "width 3", "height 2")


def test_double_and_extra_properties_in_any_order() -> None:
    dtype = np.dtype([("nx", "<f4"), ("z", "<f8"), ("red", "u1"), ("x", "<f8"), ("y", "<f8")])
    records = np.zeros(4, dtype=dtype)
    records["x"], records["y"], records["z"], records["red"] = 1.5, 2.5, [1e300, 3, 4, 5], 7
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float32 nx\nproperty double z\nproperty uchar red\n"
    header += "property double x\nproperty float64 y\nend_header\n"
    cloud = parse_ply(header.encode() + records.tobytes(), file="x")
    assert np.isnan(cloud.xyz_mm[0]).all()  # beyond float32: no point
    assert cloud.xyz_mm[1:].tolist() == [[1.5, 2.5, 3], [1.5, 2.5, 4], [1.5, 2.5, 5]]
    assert cloud.properties["red"].tolist() == [7] * 4


ASCII = "ply\nformat ascii 1.0\ncomment unit mm\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n"


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_ascii_and_faces_after_the_vertices(newline: str) -> None:
    text = ASCII + "element face 1\nproperty list uchar int vertex_indices\nend_header\n1 2.5 -3e1 255\nnan nan nan 0\n3 0 1 1\n"
    cloud = parse_ply(text.replace("\n", newline).encode(), file="x")
    assert cloud.xyz_mm[0].tolist() == [1, 2.5, -30]
    assert np.isnan(cloud.xyz_mm[1]).all()
    assert cloud.properties["red"].tolist() == [255, 0]


def test_binary_with_faces_and_an_element_before() -> None:
    header = "ply\nformat binary_little_endian 1.0\nelement view 2\nproperty short id\nelement vertex 1\nproperty float x\nproperty float y\n"
    header += "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    body = b"\x01\x02\x03\x04" + np.array([1, 2, 3], "<f4").tobytes() + b"\x03" + bytes(12)
    assert parse_ply(header.encode() + body, file="x").xyz_mm.tolist() == [[1, 2, 3]]


GOOD = encode_ply(_cube())
BROKEN = {
    "empty": (b"", "begin"),
    "other magic": (b"obj\n" + GOOD[4:], "begin"),
    "cut in the header": (GOOD[:60], "end_header"),
    "cut in the points": (GOOD[:-1], "cut off"),
    "too long": (GOOD + b"\0", "more than its header"),
    "count too large": (GOOD.replace(b"vertex 5", b"vertex 999999999999"), "cut off"),
    "count too small": (GOOD.replace(b"vertex 5", b"vertex 4"), "more than its header"),
    "count negative": (GOOD.replace(b"vertex 5", b"vertex -5"), "not understood"),
    "no vertex": (GOOD.replace(b"element vertex", b"element corner"), "element vertex"),
    "no z": (GOOD.replace(b"float z", b"float w"), "no z"),
    "whole-number x": (GOOD.replace(b"float x", b"int x"), "whole numbers"),
    "x twice": (GOOD.replace(b"property float z", b"property float z\nproperty float x"), "twice"),
    "unknown type": (GOOD.replace(b"float z", b"half z"), "not understood"),
    "list": (GOOD.replace(b"property float z", b"property float z\nproperty list uchar int i"), "list"),
    "list before": (GOOD.replace(b"element vertex", b"element a 1\nproperty list uchar int i\nelement vertex"), "list"),
    "big endian": (GOOD.replace(b"little", b"big"), "big_endian"),
    "no format": (GOOD.replace(b"format binary_little_endian 1.0\n", b""), "not given"),
    "grid": (GOOD.replace(b"element", b"comment width 3\ncomment height 2\nelement"), "grid"),
    "ascii too short": ((ASCII + "end_header\n1 2 3 4\n").encode(), "cut off"),
    "ascii too long": ((ASCII + "end_header\n" + "1 2 3 4\n" * 3).encode(), "longer"),
    "ascii word": ((ASCII + "end_header\n1 2 3 4\n1 two 3 4\n").encode(), "broken"),
    "ascii ragged": ((ASCII + "end_header\n1 2 3 4\n1 2 3\n").encode(), "broken"),
    "ascii column": ((ASCII + "end_header\n1 2 3\n1 2 3\n").encode(), "3 numbers"),
    "ascii lie": ((ASCII.replace("vertex 2", "vertex 99999999999") + "end_header\n1 2 3 4\n").encode(), "cut off"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_variants_are_file_errors(name: str, tmp_path: Path) -> None:
    data, word = BROKEN[name]
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(FileError, match=word) as caught:
        read_ply(tmp_path / "a.ply")
    assert caught.value.file == str(tmp_path / "a.ply")
    assert caught.value.remedy


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "none.ply", tmp_path):
        with pytest.raises(FileError) as caught:
            read_ply(path)
        assert caught.value.remedy
    with pytest.raises(FileError, match="cannot be written"):
        write_ply(tmp_path / "no" / "a.ply", np.zeros((1, 3)))


def test_a_failed_write_leaves_the_former_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_ply(tmp_path / "a.ply", np.ones((1, 3)))

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(FileError, match="No space left"):
        write_ply(tmp_path / "a.ply", np.zeros((1, 3)))
    assert read_ply(tmp_path / "a.ply").xyz_mm.tolist() == [[1, 1, 1]]
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize("properties", [{"q": np.zeros(4)}, {"x": np.zeros(5)}, {"a b": np.zeros(5)}, {"q": np.zeros(5, dtype=np.int64)}])
def test_what_cannot_be_written_is_a_bug_of_the_caller(properties: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]]) -> None:
    with pytest.raises(ValueError, match="does not fit"):
        encode_ply(_cube(), properties=properties)
    with pytest.raises(ValueError, match="points must be"):
        encode_ply(np.zeros((3, 2)))


def _check(data: bytes) -> None:
    with suppress(FileError):
        cloud = parse_ply(data, file="x")
        assert isinstance(cloud, PointCloud)
        finite = np.isfinite(cloud.xyz_mm)
        assert (finite.all(axis=-1) | np.isnan(cloud.xyz_mm).all(axis=-1)).all()
        assert all(values.shape == cloud.xyz_mm.shape[:-1] for values in cloud.properties.values())


@given(st.binary(max_size=300), st.sampled_from([b"", b"ply\n", GOOD[: GOOD.index(b"element")], (ASCII + "end_header\n").encode()]))
def test_random_bytes(data: bytes, start: bytes) -> None:
    _check(start + data)


_WORDS = [b"ascii", b"double", b"int", b"vertex", b"0", b"5", b"99999999999999999", b"-1", b"width 5", b"height 1", b"nan", b"\r\n", b"list"]


@given(st.lists(st.tuples(st.integers(0, len(GOOD)), st.integers(0, 20), st.binary(max_size=6) | st.sampled_from(_WORDS)), max_size=4), st.booleans())
def test_random_mutations(edits: list[tuple[int, int, bytes]], text: bool) -> None:
    data = (ASCII + "comment width 2\ncomment height 1\nend_header\n1 2 3 4\n5 6 7 8\n").encode() if text else GOOD
    for start, length, replacement in edits:
        data = data[:start] + replacement + data[start + length :]
    _check(data)
