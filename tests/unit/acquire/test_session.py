"""Writing sessions: what is appended is read back, nothing is lost but the shot in hand, nothing half-made stays."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import Cell, load_cell
from acquire.session import SessionWriter
from acquire.session_folder import check_free
from drivers.errors import FileError, SettingsError
from drivers.files.session import read_scan, read_session
from drivers.models import load_robot_model

ROOT = Path(__file__).parents[3]

CELL = """\
format: spherecal-cell/1
name: writer
robot: {driver: recorded, model: ur5e}
camera: {driver: recorded}
flange_from_camera: null
spheres: {A: {diameter_mm: 38.1, expanded_uncertainty_mm: 0.001}}
identity: {robot_serial: r1}
"""


@pytest.fixture
def cell(tmp_path: Path) -> Cell:
    return _cell(tmp_path, CELL)


def _cell(folder: Path, text: str) -> Cell:
    (folder / "cells").mkdir(exist_ok=True)
    path = folder / "cells" / "cell.yaml"
    path.write_text(text, encoding="utf-8")
    return load_cell(path)


def _cloud(seed: int = 0) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    return np.random.default_rng(seed).normal(size=(3, 4, 3)).astype(np.float32)


def _begun(folder: Path, cell: Cell, n_shots: int = 2) -> Path:
    with SessionWriter.create(folder, purpose="calibration", cell=cell) as writer:
        for i in range(n_shots):
            writer.append(sphere="A", joints_rad=np.full(6, 0.1 * i), xyz_mm=_cloud(i))
    return folder


def test_what_is_appended_is_read_back(tmp_path: Path, cell: Cell) -> None:
    joints = np.random.default_rng(2).normal(size=6)
    with SessionWriter.create(tmp_path / "a" / "s", purpose="verification", cell=cell, plan_text="p: 1\n", identity={"camera_serial": 7}) as writer:
        first = writer.append(
            sphere="A",
            joints_rad=joints,
            base_from_flange=np.eye(4),
            xyz_mm=_cloud(),
            intensity=np.ones((3, 4)),
            frames_xyz_mm=[_cloud(1), _cloud(2)],
            pose_id="p1",
            target_joints_rad=joints + 1e-5,
            stillness_rad=1e-6,
            temperatures_c={"air": 21},
            approach=np.array([1.0, -1.0]),
            extra={"vendor": {"exposure_ms": 12}},
        )
        writer.append(sphere=None, joints_rad=joints, same_scan_as=0)
        writer.append(status="failed", reason="no frame", pose_id="p2")
        writer.append(sphere="A", joints_rad=joints, xyz_mm=_cloud(3), replaces=0)
        writer.append(joints_rad=joints, reference="tracker", target="reflector", point_in_reference_mm=[1, 2, 3])
        assert writer.next_index == 5
    session = read_session(tmp_path / "a" / "s")
    shot = session.all_shots[0]
    assert shot.joints_rad is not None
    assert np.array_equal(shot.joints_rad, joints)  # bit for bit
    assert (shot.scan, shot.line, shot.pose_id, shot.extra) == (first.scan, 1, "p1", {"vendor": {"exposure_ms": 12}})
    assert (shot.stillness_rad, shot.temperatures_c, shot.approach) == (1e-6, {"air": 21.0}, [1.0, -1.0])
    cloud = read_scan(session, shot)
    assert np.array_equal(cloud.xyz_mm, _cloud())
    assert cloud.comments == ("unit mm", "frame camera", "width 4", "height 3")
    assert cloud.properties["intensity"].shape == (3, 4)
    assert [frame.scan for frame in shot.frames] == ["scans/0000_0.ply", "scans/0000_1.ply"]
    assert session.all_shots[1].scan == shot.scan
    assert session.all_shots[2].reason == "no frame"
    assert [kept.index for kept in session.shots] == [1, 2, 3, 4]
    assert session.shots[-1].is_reference_point
    assert session.purpose == "verification"
    assert session.identity == {"camera_serial": 7}
    assert session.cell_path.read_bytes() == cell.data
    assert session.plan_path is not None
    assert session.plan_path.read_text(encoding="utf-8") == "p: 1\n"
    assert session.robot_model_path is not None
    assert session.robot_model_path.read_text(encoding="utf-8") == load_robot_model("ur5e").text


def test_the_identity_of_the_cell_is_the_default(tmp_path: Path, cell: Cell) -> None:
    assert read_session(_begun(tmp_path / "s", cell)).identity == {"robot_serial": "r1"}


@pytest.mark.parametrize("kind", ["file", "folder in use"])
def test_create_refuses_what_is_there(kind: str, tmp_path: Path, cell: Cell) -> None:
    target = tmp_path / "s"
    if kind == "file":
        target.write_text("x", encoding="utf-8")
    else:
        _begun(target, cell)
    before = sorted(path.name for path in tmp_path.rglob("*"))
    with pytest.raises(FileError, match="--resume"):
        SessionWriter.create(target, purpose="calibration", cell=cell)
    assert sorted(path.name for path in tmp_path.rglob("*")) == before


def test_create_takes_an_empty_folder(tmp_path: Path, cell: Cell) -> None:
    (tmp_path / "s").mkdir()
    assert read_session(_begun(tmp_path / "s", cell)).n_joints == 6


def test_a_create_that_fails_leaves_nothing(tmp_path: Path, cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SettingsError, match="workpiece"):
        SessionWriter.create(tmp_path / "a" / "s", purpose="fun", cell=cell)
    for name in ("os.fsync", "fcntl.flock"):
        with monkeypatch.context() as patch:

            def fail(*_: object) -> None:
                raise OSError(28, "No space left on device")

            patch.setattr(name, fail)
            with pytest.raises(FileError, match="No space left"):
                SessionWriter.create(tmp_path / "a" / "b" / "s", purpose="calibration", cell=cell)
        assert not (tmp_path / "a" / "b" / "s").exists()
    assert not list(tmp_path.rglob("*.tmp"))
    with pytest.raises(FileError, match="cannot be made"):
        SessionWriter.create(tmp_path / "cells" / "cell.yaml" / "s", purpose="calibration", cell=cell)


def test_a_missing_model_stops_the_create(tmp_path: Path) -> None:
    cell = _cell(tmp_path, CELL.replace("ur5e", "nowhere.yaml"))
    with pytest.raises(FileError, match="nowhere"):
        SessionWriter.create(tmp_path / "s", purpose="calibration", cell=cell)
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"joints_rad": [float("nan")] * 6}, "NaN"),
        ({"joints_rad": [0.0] * 5}, "5 axes"),
        ({"base_from_flange": np.eye(4) * 2}, "rigid"),
        ({"status": "fine"}, "skipped"),
        ({"replaces": 9}, "no earlier shot 9"),
    ],
)
def test_what_the_reader_would_refuse_is_not_written(values: dict[str, object], word: str, tmp_path: Path, cell: Cell) -> None:
    folder = _begun(tmp_path / "s", cell)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with SessionWriter.resume(folder) as writer, pytest.raises(FileError, match=word):
        writer.append(**({"joints_rad": np.zeros(6), "xyz_mm": _cloud()} | values))  # type: ignore[arg-type]
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_scan_of_nowhere_is_a_bug_of_the_caller(tmp_path: Path, cell: Cell) -> None:
    with SessionWriter.create(tmp_path / "s", purpose="calibration", cell=cell) as writer, pytest.raises(ValueError, match="no earlier shot"):
        writer.append(joints_rad=np.zeros(6), same_scan_as=3)


def test_a_full_disk_loses_only_the_shot_in_hand(tmp_path: Path, cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = _begun(tmp_path / "s", cell)
    lines = (folder / "shots.jsonl").read_bytes()
    fsync = os.fsync
    with SessionWriter.resume(folder) as writer:
        for allowed in range(3):  # the scan, its folder, the line
            calls = iter(range(100))

            def full(descriptor: int, allowed: int = allowed, calls: Iterator[int] = calls) -> None:
                if next(calls) >= allowed:
                    raise OSError(28, "No space left on device")
                fsync(descriptor)

            with monkeypatch.context() as patch:
                patch.setattr("os.fsync", full)
                with pytest.raises(FileError, match="No space left"):
                    writer.append(sphere="A", joints_rad=np.zeros(6), xyz_mm=_cloud(5))
            assert (folder / "shots.jsonl").read_bytes() == lines
        assert writer.append(sphere="A", joints_rad=np.zeros(6), xyz_mm=_cloud(6)).index == 2
    session = read_session(folder)
    assert [np.array_equal(read_scan(session, shot).xyz_mm, _cloud(seed)) for shot, seed in zip(session.shots, (0, 1, 6), strict=True)] == [True] * 3


def test_resume_goes_on_after_the_last_line_torn_anywhere(tmp_path: Path, cell: Cell, caplog: pytest.LogCaptureFixture) -> None:
    folder = _begun(tmp_path / "s", cell)
    path = folder / "shots.jsonl"
    data = path.read_bytes()
    start = data.index(b"\n") + 1
    for end in range(start, len(data) + 1):
        path.write_bytes(data[:end])
        caplog.clear()
        with caplog.at_level(logging.WARNING), SessionWriter.resume(folder, cell=cell) as writer:
            kept = 2 if end >= len(data) - 1 else 1
            assert len(writer.shots) == kept
            torn = start < end < len(data) - 1
            assert (writer.repaired is not None) == torn == bool(caplog.records)
        assert path.read_bytes() == (data if kept == 2 else data[:start])


def test_zeros_after_a_power_cut_are_taken_out(tmp_path: Path, cell: Cell) -> None:
    folder = _begun(tmp_path / "s", cell)
    with (folder / "shots.jsonl").open("ab") as stream:
        stream.write(bytes(500))
    (folder / "scans" / ".0002.ply.abc.tmp").write_bytes(b"half")
    with SessionWriter.resume(folder) as writer:
        assert writer.repaired
        assert writer.append(joints_rad=np.zeros(6), xyz_mm=_cloud()).line == 3
    assert len(read_session(folder).shots) == 3
    assert not list((folder / "scans").glob(".*"))


def test_damage_before_the_last_line_is_not_repaired(tmp_path: Path, cell: Cell) -> None:
    folder = _begun(tmp_path / "s", cell)
    path = folder / "shots.jsonl"
    path.write_bytes(b"{broken\n" + path.read_bytes())
    before = path.read_bytes()
    with pytest.raises(FileError, match="line 1"):
        SessionWriter.resume(folder)
    assert path.read_bytes() == before


def test_resume_refuses_another_cell_but_not_another_layout(tmp_path: Path, cell: Cell) -> None:
    folder = _begun(tmp_path / "s", cell)
    SessionWriter.resume(folder, cell=_cell(tmp_path, CELL + "# a comment\n")).close()
    with pytest.raises(SettingsError, match="another cell"):
        SessionWriter.resume(folder, cell=_cell(tmp_path, CELL.replace("38.1", "38.2")))
    (folder / "robot_model.yaml").write_text(load_robot_model("ur10e").text, encoding="utf-8")
    with pytest.raises(SettingsError, match="robot model has changed"):
        SessionWriter.resume(folder, cell=_cell(tmp_path, CELL))


@pytest.mark.parametrize("missing", ["session.yaml", "shots.jsonl"])
def test_resume_needs_a_session(missing: str, tmp_path: Path, cell: Cell) -> None:
    folder = _begun(tmp_path / "s", cell)
    (folder / missing).unlink()
    with pytest.raises(FileError, match=missing.replace(".", r"\.")):
        SessionWriter.resume(folder)
    assert not (folder / missing).exists()


def test_two_writers_at_once_are_refused(tmp_path: Path, cell: Cell) -> None:
    with SessionWriter.create(tmp_path / "s", purpose="calibration", cell=cell), pytest.raises(FileError, match="another process"):
        SessionWriter.resume(tmp_path / "s")
    SessionWriter.resume(tmp_path / "s").close()


def _kill_and_check(folder: Path, delay_s: float) -> int:
    """Let a child append, kill it after a delay; returns how many shots the session holds then."""
    child = subprocess.Popen([sys.executable, "-m", "tests.support.append_forever", str(folder)], stdout=subprocess.PIPE, cwd=ROOT, text=True)
    assert child.stdout is not None
    assert child.stdout.readline() == "ready\n"
    before = len((folder / "shots.jsonl").read_bytes().splitlines())
    time.sleep(delay_s)
    child.kill()
    told = [int(line) for line in child.stdout.read().splitlines(keepends=True) if line.endswith("\n")]
    child.wait()
    child.stdout.close()
    with SessionWriter.resume(folder) as writer:
        found = [shot.index for shot in writer.shots]
    assert found == list(range(len(found)))
    last_told = told[-1] if told else before - 1
    assert last_told + 1 <= len(found) <= last_told + 2  # killed between the line and its being told
    session = read_session(folder)
    for shot in session.shots[before:]:
        assert read_scan(session, shot).points_mm.shape == (2000, 3)
        assert all((folder / frame.scan).is_file() for frame in shot.frames)
    return len(found)


def _kill_many(folder: Path, cell: Cell, n_kills: int, seed: int) -> None:
    SessionWriter.create(folder, purpose="calibration", cell=cell).close()
    rng = np.random.default_rng(seed)
    counts = [_kill_and_check(folder, float(rng.uniform(0, 0.1))) for _ in range(n_kills)]
    assert counts == sorted(counts)
    assert counts[-1] > 0
    lines = (folder / "shots.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["index"] for line in lines] == list(range(counts[-1]))


def test_kill_9_loses_at_most_the_shot_in_hand(tmp_path: Path, cell: Cell) -> None:
    _kill_many(tmp_path / "s", cell, 4, seed=1)


@pytest.mark.qualify
def test_kill_9_many_times(tmp_path: Path, cell: Cell) -> None:
    seed = int.from_bytes(os.urandom(4))
    print("seed", seed)
    _kill_many(tmp_path / "s", cell, 100, seed)


def test_a_place_that_cannot_be_written_is_told_before_anything_begins(tmp_path: Path, cell: Cell) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    for folder in (tmp_path / "file" / "s", Path("/proc/spherecal/s")):  # /proc takes nothing, from root neither
        with pytest.raises(FileError, match="cannot be made") as caught:
            SessionWriter.create(folder, purpose="calibration", cell=cell)
        assert caught.value.remedy
        assert not folder.exists()
    check_free(tmp_path / "new" / "s")
