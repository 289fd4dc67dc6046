"""Which cloud belongs to which pose."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.import_clouds import By, Matching, find_clouds, match_clouds, natural_key
from drivers.errors import DataError, FileError
from drivers.files.pose_list import PoseLabel


def match(labels: Sequence[PoseLabel], names: Sequence[str], by: By = "auto", *, allow_missing: bool = False) -> Matching:
    clouds = sorted(map(Path, names), key=lambda path: natural_key(path.name))
    return match_clouds(labels, clouds, by, file="poses.csv", allow_missing=allow_missing)


def names_of(found: Matching) -> list[str | None]:
    return [None if path is None else path.name for path in found.clouds]


def named(*names: str) -> list[PoseLabel]:
    return [PoseLabel(f"line {i + 2}", name=name) for i, name in enumerate(names)]


def numbered(*numbers: int) -> list[PoseLabel]:
    return [PoseLabel(f"line {i + 2}", number=number) for i, number in enumerate(numbers)]


def plain(n: int) -> list[PoseLabel]:
    return [PoseLabel(f"line {i + 2}") for i in range(n)]


@given(st.lists(st.integers(0, 10**6), unique=True, min_size=1))
def test_natural_order_is_that_of_the_numbers(numbers: list[int]) -> None:
    assert sorted((f"scan_{n}.ply" for n in numbers), key=natural_key) == [f"scan_{n}.ply" for n in sorted(numbers)]


@given(st.lists(st.text(max_size=8)))
def test_any_names_can_be_sorted(names: list[str]) -> None:
    keys = [natural_key(name) for name in names]
    assert sorted(keys) == sorted(keys, reverse=True)[::-1]


@pytest.mark.parametrize(
    ("labels", "clouds", "by", "expected"),
    [
        (plain(3), ["s1.ply", "s10.ply", "s2.ply"], "order", ["s1.ply", "s2.ply", "s10.ply"]),
        (named("b", "a"), ["a.ply", "b.ply"], "name", ["b.ply", "a.ply"]),
        (named("P10", "p20"), ["p20.ply", "p10.ply"], "name", ["p10.ply", "p20.ply"]),
        (numbered(2, 1), ["c_01.ply", "c_02.ply"], "number", ["c_02.ply", "c_01.ply"]),
        (
            named("pose 2", "pose 1"),
            ["2026-01-31_scan1_v3.pcd", "2026-01-31_scan2_v3.pcd"],
            "number",
            ["2026-01-31_scan2_v3.pcd", "2026-01-31_scan1_v3.pcd"],
        ),
        # nothing to go by but the order
        (named("left", "right"), ["0001.ply", "0002.ply"], "order", ["0001.ply", "0002.ply"]),
        ([PoseLabel("line 2", cloud="scans/B.ply"), PoseLabel("line 3", cloud="A")], ["A.ply", "B.ply"], "file", ["B.ply", "A.ply"]),
        ([PoseLabel("line 2", cloud="C:\\data\\b.ply", name="a")], ["b.ply"], "file", ["b.ply"]),
    ],
)
def test_the_first_way_that_applies(labels: list[PoseLabel], clouds: list[str], by: str, expected: list[str]) -> None:
    found = match(labels, clouds)
    assert (found.by, names_of(found)) == (by, expected)


def test_a_way_can_be_chosen() -> None:
    labels = numbered(2, 1)
    assert names_of(match(labels, ["c1.ply", "c2.ply"], "order")) == ["c1.ply", "c2.ply"]
    with pytest.raises(DataError, match="cannot be matched by name"):
        match(labels, ["c1.ply", "c2.ply"], "name")


@pytest.mark.parametrize(
    ("labels", "clouds", "message"),
    [
        (plain(3), ["1.ply", "2.ply"], "3 poses and 2 clouds, and no names or numbers"),
        (named("a", "b", "c"), ["a.ply", "b.ply", "d.ply"], "matched by name: no cloud for c (line 4) and no pose for d.ply"),
        # counted from 0 and from 1: shifted by one, if the order were trusted
        (numbered(1, 2, 3), ["s0.ply", "s1.ply", "s2.ply"], "matched by number: no cloud for 3 (line 4) and no pose for s0.ply"),
        ([PoseLabel("line 2", cloud="a"), PoseLabel("line 3", cloud="a")], ["a.ply", "b.ply"], "a.ply is claimed by several poses (line 2, line 3)"),
        ([PoseLabel("line 2", cloud="a"), PoseLabel("line 3")], ["a.ply"], "no cloud for line 3"),
    ],
)
def test_what_has_no_partner_is_named(labels: list[PoseLabel], clouds: list[str], message: str) -> None:
    with pytest.raises(DataError, match=re.escape(message)) as caught:
        match(labels, clouds)
    assert caught.value.remedy


def test_what_has_no_partner_may_be_left_out() -> None:
    found = match(named("a", "b", "c"), ["a.ply", "b.ply", "d.ply"], allow_missing=True)
    assert names_of(found) == ["a.ply", "b.ply", None]
    assert [path.name for path in found.unused] == ["d.ply"]
    with pytest.raises(DataError, match="no pose has a cloud"):
        match([PoseLabel("line 2", cloud="x")], ["a.ply"], allow_missing=True)


def test_clouds_are_found_by_folder_and_by_pattern(tmp_path: Path) -> None:
    for name in ("s10.ply", "s9.PLY", "notes.txt", "other.pcd"):
        (tmp_path / name).touch()
    assert [path.name for path in find_clouds(tmp_path)] == ["other.pcd", "s9.PLY", "s10.ply"]
    assert [path.name for path in find_clouds(tmp_path / "*.pcd")] == ["other.pcd"]
    (tmp_path / "s10.npz").touch()
    with pytest.raises(FileError, match="s10 is there in several formats"):
        find_clouds(tmp_path)
    for place in (tmp_path / "nowhere" / "*.ply", tmp_path / "*.npy"):
        with pytest.raises(FileError) as caught:
            find_clouds(place)
        assert caught.value.remedy


@given(
    st.lists(
        st.builds(
            PoseLabel, st.just("line"), st.sampled_from([None, "a", "b1", "2"]), st.sampled_from([None, 1, 2]), st.sampled_from([None, "a", "x"])
        ),
        min_size=1,
    ),
    st.lists(st.sampled_from(["a.ply", "b1.ply", "b2.ply", "1.ply"]), unique=True, min_size=1),
    st.booleans(),
)
def test_no_cloud_ever_serves_two_poses(labels: list[PoseLabel], clouds: list[str], allow_missing: bool) -> None:
    try:
        found = match(labels, clouds, allow_missing=allow_missing)
    except DataError:
        return
    taken = [path for path in found.clouds if path is not None]
    assert len(found.clouds) == len(labels)
    assert len(set(taken)) == len(taken)
    assert {*taken, *found.unused} == set(map(Path, clouds))
    assert allow_missing or len(taken) == len(labels) == len(clouds)
