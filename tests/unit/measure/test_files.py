"""Earlier results are kept, half-made folders vanish."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.errors import FileError, SettingsError
from measure.files import new_folder, replacing

FORMAT = "spherecal-plan/1"
OLD, NEW = f"format: {FORMAT}\nold: 1\n", f"format: {FORMAT}\nnew: 1\n"


def test_an_earlier_result_is_kept_under_another_name(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(OLD)
    with replacing(path, FORMAT) as former:
        path.write_text(NEW)
    assert path.read_text() == NEW
    assert former is not None
    assert former.read_text() == OLD
    assert former.suffix == ".yaml"


def test_the_same_result_again_leaves_one_file(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(OLD)
    with replacing(path, FORMAT):
        path.write_text(OLD)
    assert list(tmp_path.iterdir()) == [path]


def test_the_same_content_at_another_time_leaves_one_file(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text(f"format: {FORMAT}\nid: abc\ncreated_utc: 1\n")
    with replacing(path, FORMAT):
        path.write_text(f"format: {FORMAT}\nid: abc\ncreated_utc: 2\n")
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_brings_the_earlier_result_back(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(OLD)
    with pytest.raises(RuntimeError), replacing(path, FORMAT):
        raise RuntimeError
    assert [p.name for p in tmp_path.iterdir()] == ["plan.yaml"]
    assert path.read_text() == OLD


@pytest.mark.parametrize("content", [b"format: spherecal-cell/1\n", b"", b"\xff\x00", None])
def test_what_is_no_earlier_result_is_not_touched(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "precious"
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    with pytest.raises(SettingsError), replacing(path, FORMAT):
        pytest.fail("must not be entered")
    assert path.is_dir() if content is None else path.read_bytes() == content


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "demo"
    with pytest.raises(RuntimeError), new_folder(target) as working:
        _half_done(working)
    assert list(tmp_path.iterdir()) == []
    with new_folder(target) as working:
        (working / "a").write_text("x")
        assert not target.exists()
    assert [p.name for p in target.iterdir()] == ["a"]
    with pytest.raises(FileError), new_folder(tmp_path / "no" / "where"):
        pytest.fail("must not be entered")


def _half_done(working: Path) -> None:
    (working / "a").write_text("x")
    raise RuntimeError
