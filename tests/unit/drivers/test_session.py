"""Sessions: what is right is read whole, what is wrong is told with file, line, key and remedy."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.errors import FileError
from drivers.files.session import read_scan, read_session
from drivers.files.shots import Shot, parse_shot
from drivers.kinematics import se3
from tests.support.sessions import HEAD, IDENTITY, scan_bytes, shot_dict, write_lines, write_session


def _read_error(folder: Path) -> FileError:
    with pytest.raises(FileError) as caught:
        read_session(folder)
    assert caught.value.remedy
    assert "\n" not in str(caught.value)
    return caught.value


def test_a_good_session_is_read_whole(tmp_path: Path) -> None:
    def change(shots: list[dict[str, Any]]) -> None:
        shots[1] |= {"pose_id": "p7", "replaces": 0, "stillness_rad": 1e-5, "temperatures_c": {"air": 21}, "approach": [1, -1], "vendor": {"a": [1]}}
        shots[1]["frames"] = [{"scan": "scans/0000.ply", "sha256": shots[0]["sha256"]}]
        shots[2] |= {"status": "failed", "reason": "no frame", "scan": None, "sha256": None, "joints_rad": None}

    session = read_session(write_session(tmp_path / "s", 3, change))
    assert [shot.index for shot in session.shots] == [1, 2]
    assert [shot.index for shot in session.all_shots] == [0, 1, 2]
    assert [shot.line for shot in session.all_shots] == [1, 2, 3]
    shot = session.shots[0]
    assert (shot.pose_id, shot.replaces, shot.stillness_rad, shot.temperatures_c) == ("p7", 0, 1e-5, {"air": 21.0})
    assert (shot.approach, shot.extra, shot.frames[0].scan) == ([1, -1], {"vendor": {"a": [1]}}, "scans/0000.ply")
    assert session.shots[1].status == "failed"
    assert session.n_joints == 6
    assert (session.purpose, session.software, session.plan_path) == ("calibration", "by hand", None)
    points = np.frombuffer(scan_bytes(1)[-48:], "<f4").reshape(4, 3)
    assert np.array_equal(read_scan(session, shot).xyz_mm, points)


def test_external_points_need_no_scan_and_no_sphere(tmp_path: Path) -> None:
    point = {"reference": "tracker", "target": "reflector", "point_in_reference_mm": [1, 2.5, -3]}
    folder = write_session(tmp_path / "s", 1)
    write_lines(folder, [json.dumps({"index": 4, "joints_rad": [0] * 6, "scan": None} | point)])
    (shot,) = read_session(folder).shots
    assert shot.is_reference_point
    assert shot.point_in_reference_mm is not None
    assert shot.point_in_reference_mm.tolist() == [1, 2.5, -3]


def test_a_session_without_shots_is_valid(tmp_path: Path) -> None:
    assert read_session(write_session(tmp_path / "s", 0)).shots == ()


def test_rounded_rotations_are_taken_and_made_exact(tmp_path: Path) -> None:
    exact = se3.exp([900, 10, -20, 0.3, -2.0, 1.0])
    folder = write_session(tmp_path / "s", 1, lambda shots: shots[0].update(base_from_flange=exact.round(5).tolist()))
    found = read_session(folder).shots[0].base_from_flange
    assert found is not None
    assert se3.is_rigid(found, 1e-14)
    assert np.allclose(found[:3, :3], exact[:3, :3], atol=2e-5)
    assert np.allclose(found[:3, 3], exact[:3, 3], atol=1e-5)


def test_the_digest_covers_every_file_but_the_scans(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "s")
    digests = {read_session(folder).digest}
    for name in ("session.yaml", "cell.yaml", "shots.jsonl"):
        (folder / name).write_text((folder / name).read_text(encoding="utf-8") + "\n", encoding="utf-8")
        digests.add(read_session(folder).digest)
    for name in ("plan.yaml", "robot_model.yaml"):
        (folder / name).write_text("a: 1\n", encoding="utf-8")
        digests.add(read_session(folder).digest)
    assert len(digests) == 6
    (folder / "notes.txt").write_text("x", encoding="utf-8")
    assert read_session(folder).digest in digests
    assert read_session(folder).robot_model_path == folder / "robot_model.yaml"


POINT: dict[str, object] = {"reference": "t", "target": "r", "point_in_reference_mm": [0, 0, 0]}

LINE_DAMAGE: dict[str, tuple[dict[str, object], str]] = {
    "five axes": ({"joints_rad": [0.0] * 5}, "5 axes"),
    "no axes": ({"joints_rad": []}, "joints_rad"),
    "a word for an axis": ({"joints_rad": [0, 0, "x", 0, 0, 0]}, "joints_rad[2]"),
    "truth for an axis": ({"joints_rad": [0, 0, True, 0, 0, 0]}, "joints_rad[2]"),
    "NaN": ({"joints_rad": [0, 0, float("nan"), 0, 0, 0]}, "joints_rad[2]"),
    "infinite": ({"stillness_rad": float("inf")}, "stillness_rad"),
    "huge": ({"stillness_rad": 10**400}, "stillness_rad"),
    "five target axes": ({"target_joints_rad": [0.0] * 5}, "target_joints_rad"),
    "scaled pose": ({"base_from_flange": [[2.0, 0, 0, 0], *IDENTITY[1:]]}, "no rigid transform"),
    "mirrored pose": ({"base_from_flange": [[-1.0, 0, 0, 0], *IDENTITY[1:]]}, "mirrors"),
    "transposed pose": ({"base_from_flange": [*IDENTITY[:3], [100.0, 0, 0, 1]]}, "transposed"),
    "short pose": ({"base_from_flange": IDENTITY[:3]}, "4 x 4"),
    "pose of words": ({"base_from_flange": [["a"] * 4] * 4}, "base_from_flange[0][0]"),
    "no pose at all": ({"base_from_flange": None, "joints_rad": None}, "neither axis angles nor"),
    "index twice": ({"index": 0}, "used twice"),
    "no index": ({"index": None}, "index"),
    "index of letters": ({"index": "1"}, "index"),
    "negative index": ({"index": -1}, "index"),
    "unknown status": ({"status": "fine"}, "ok, failed, skipped"),
    "missing scan": ({"scan": "scans/0009.ply"}, "scans/0009.ply is missing"),
    "absolute scan": ({"scan": "/etc/passwd"}, "inside the folder"),
    "escaping scan": ({"scan": "scans/../../x.ply"}, "inside the folder"),
    "windows scan": ({"scan": "C:\\x.ply"}, "inside the folder"),
    "no digest": ({"sha256": None}, "sha256"),
    "odd digest": ({"sha256": "abc"}, "sha256"),
    "sphere of numbers": ({"sphere": 3}, "sphere"),
    "replaces a later one": ({"replaces": 2}, "no earlier shot 2"),
    "frames no list": ({"frames": {}}, "frames"),
    "frame missing": ({"frames": [{"scan": "scans/0009.ply", "sha256": "0" * 64}]}, "frames[0]"),
    "temperature of words": ({"temperatures_c": {"air": "warm"}}, "air"),
    "no date": ({"time_utc": "yesterday"}, "time_utc"),
    "half an external point": ({"reference": "tracker"}, "together"),
    "external point and scan": (POINT, "not both"),
    "external point of two": ({"scan": None, "reference": "t", "target": "r", "point_in_reference_mm": [0, 0]}, "list of 3"),
    "external point without axes": ({"scan": None, "joints_rad": None, **POINT}, "axis angles"),
}


@pytest.mark.parametrize("name", LINE_DAMAGE)
def test_a_wrong_line_is_told_with_its_number(name: str, tmp_path: Path) -> None:
    changes, words = LINE_DAMAGE[name]
    error = _read_error(write_session(tmp_path / "s", 3, lambda shots: shots[1].update(changes)))
    assert error.file == str(tmp_path / "s" / "shots.jsonl")
    assert error.where is not None
    assert error.where.startswith("line 2")
    assert words in str(error)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('{"index": 1', "JSON"),
        ("[1]", "no JSON object"),
        ('{"index": 1, "index": 1}', "twice"),
        ('{"index": 1, "x": {"a": 1, "a": 2}}', "twice"),
        ('{"index": 1, "x": {"a": [NaN]}}', "x.a[0]"),
        ('{"index": 1, "x": 1e999}', "x: NaN or infinite"),
        ("[" * 5000, "JSON"),
        (f'{{"index": {"9" * 5000}}}', "JSON"),
    ],
)
def test_broken_lines(line: str, words: str, tmp_path: Path) -> None:
    folder = write_session(tmp_path / "s", 3)
    good = [json.dumps(shot_dict(i)) for i in range(3)]
    write_lines(folder, [good[0], line, good[2]])
    error = _read_error(folder)
    assert words in str(error)
    assert error.where == "line 2"


def test_a_falling_index_is_told(tmp_path: Path) -> None:
    error = _read_error(write_session(tmp_path / "s", 2, lambda shots: shots[0].update(index=7)))
    assert error.where == "line 2"
    assert "falls after 7" in error.message


def test_every_torn_last_line_is_told_with_the_way_out(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "s", 2)
    data = (folder / "shots.jsonl").read_bytes()
    start = data.index(b"\n") + 1
    for end in range(start + 1, len(data) - 1):
        (folder / "shots.jsonl").write_bytes(data[:end])
        error = _read_error(folder)
        assert error.where == "line 2"
        assert "--resume" in str(error)
    (folder / "shots.jsonl").write_bytes(data[:-1])  # only its line end is missing
    assert len(read_session(folder).shots) == 2


HEAD_DAMAGE = {
    "unknown format": (HEAD.replace("session/1", "session/2"), "spherecal-session/1"),
    "no format": (HEAD.replace("format", "fromat"), "format"),
    "unknown key": (HEAD + "operater: me\n", "operater"),
    "no purpose": (HEAD.replace("purpose: calibration\n", ""), "purpose"),
    "unknown purpose": (HEAD.replace("calibration", "fun"), "workpiece"),
    "no date": (HEAD.replace("2026-01-31T12:00:00Z", "today"), "created_utc"),
    "cell outside": (HEAD.replace("cell: cell.yaml", "cell: ../cell.yaml"), "inside the folder"),
    "cell missing": (HEAD.replace("cell: cell.yaml", "cell: other.yaml"), "no such file"),
    "a list": ("- 1\n", "key: value"),
    "empty": ("", "key: value"),
    "identity": (HEAD + "identity: 3\n", "identity"),
    "number as key": (HEAD + "3: 4\n", "quotes"),
}


@pytest.mark.parametrize("name", HEAD_DAMAGE)
def test_a_wrong_head_is_told(name: str, tmp_path: Path) -> None:
    text, words = HEAD_DAMAGE[name]
    folder = write_session(tmp_path / "s")
    (folder / "session.yaml").write_text(text, encoding="utf-8")
    assert words in str(_read_error(folder))


@pytest.mark.parametrize("name", ["session.yaml", "shots.jsonl", "cell.yaml"])
def test_missing_files_are_told(name: str, tmp_path: Path) -> None:
    folder = write_session(tmp_path / "s")
    (folder / name).unlink()
    assert name in str(_read_error(folder))


def test_no_folder_and_a_file_instead(tmp_path: Path) -> None:
    assert "no such folder" in str(_read_error(tmp_path / "none"))
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert "not a session folder" in str(_read_error(tmp_path / "file"))


def _flip(data: bytes) -> bytes:
    return data[:-3] + bytes([data[-3] ^ 64]) + data[-2:]


@pytest.mark.parametrize(
    ("spoil", "words"), [(lambda data: data[:-5], "cut off"), (_flip, "sha256"), (lambda _: b"", "ply"), (lambda data: data + b"\0", "more than")]
)
def test_a_scan_that_changed_since_the_capture_is_refused(spoil: Callable[[bytes], bytes], words: str, tmp_path: Path) -> None:
    session = read_session(write_session(tmp_path / "s"))
    path = session.folder / "scans" / "0001.ply"
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(FileError, match=words) as caught:
        read_scan(session, session.shots[1])
    assert caught.value.file == str(path)
    assert caught.value.remedy


def test_a_scan_that_is_gone_or_never_was(tmp_path: Path) -> None:
    session = read_session(write_session(tmp_path / "s"))
    (session.folder / "scans" / "0001.ply").unlink()
    with pytest.raises(FileError, match="cannot be read"):
        read_scan(session, session.shots[1])
    with pytest.raises(FileError, match="no scan"):
        read_scan(session, Shot(index=9))


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda child: st.lists(child, max_size=6) | st.dictionaries(st.text(max_size=5), child, max_size=3),
    max_leaves=12,
)


@given(st.dictionaries(st.sampled_from([*sorted(shot_dict(0)), "status", "frames", "temperatures_c", "replaces", "reference", "x"]), _JSON))
def test_any_values_are_a_shot_or_a_file_error(changes: dict[str, Any]) -> None:
    with suppress(FileError):
        shot = parse_shot(json.dumps(shot_dict(0) | changes), folder=None, file=Path("x"), where="line 1")
        assert shot.status in {"ok", "failed", "skipped"}
        assert shot.joints_rad is None or np.isfinite(shot.joints_rad).all()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
@given(
    start=st.integers(0, 10_000),
    replacement=st.binary(max_size=8),
    length=st.integers(0, 8),
    name=st.sampled_from(["session.yaml", "shots.jsonl"]),
)
def test_random_mutations_of_a_file(start: int, replacement: bytes, length: int, name: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = write_session(tmp_path_factory.mktemp("s") / "s")
    data = (folder / name).read_bytes()
    start %= len(data)
    (folder / name).write_bytes(data[:start] + replacement + data[start + length :])
    with suppress(FileError):
        read_session(folder)


REAL = ["r40_a", "r40_b"]


@pytest.mark.parametrize("name", REAL)
def test_real_recordings_are_read(name: str, real_data: Path) -> None:
    session = read_session(real_data / "line_scanner" / name)
    assert len(session.shots) == 15
    assert session.n_joints is None
    assert all(read_scan(session, shot).points_mm.shape[0] > 500 for shot in session.shots)
