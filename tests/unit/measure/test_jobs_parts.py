"""A part is taken when it is complete, and never before."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from acquire.plan import Plan, PlannedPose, write_plan
from acquire.session import SessionWriter
from drivers.errors import FileError
from drivers.files.ply import write_ply
from drivers.files.session import read_session
from measure.jobs.parts import MARKER, Look, contents_of, input_digest, kind_of, look_at, part_name, parts_in, parts_of_list
from tests.support.recorded import record_session, write_cell


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("part")
    record_session(folder / "session", write_cell(folder), np.random.default_rng(1), shots_per_sphere=1, n_points=50, purpose="workpiece")
    return folder / "session"


@pytest.fixture
def session(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "session"))


def look(folder: Path, settle_s: float = 0.0) -> Look:
    kind = kind_of(folder)
    assert kind is not None
    return look_at(folder, kind, contents_of(folder), settle_s)


def test_a_whole_session_is_ready_and_its_digest_is_the_session_s(session: Path) -> None:
    assert look(session).state == "ready"
    assert input_digest(session, "session", None) == read_session(session).digest


def test_a_session_whose_writer_is_open_is_left_alone_and_taken_when_it_is_closed(session: Path) -> None:
    with SessionWriter.resume(session) as writer:
        writer.append(joints_rad=np.zeros(6), xyz_mm=np.ones((5, 3), dtype=np.float32))
        found = look(session)
        assert (found.state, found.reason) == ("held", "a capture is writing to it")
    assert look(session).state == "ready"


def test_looking_does_not_keep_a_capture_from_going_on(session: Path) -> None:
    look(session)
    SessionWriter.resume(session).close()


def test_a_folder_that_just_changed_settles_first(session: Path) -> None:
    assert look(session, settle_s=60.0).state == "settling"
    # an old file that a copy brings now has its old mtime, and is new here all the same
    scan = session / "scans" / "0000.ply"
    os.utime(scan, (1e9, 1e9))
    assert look(session, settle_s=60.0).state == "settling"


def test_a_line_cut_off_by_a_kill_waits_for_the_resume_but_a_broken_one_within_does_not(session: Path) -> None:
    lines = (session / "shots.jsonl").read_bytes()
    (session / "shots.jsonl").write_bytes(lines[:-20])
    assert look(session).state == "held"
    (session / "shots.jsonl").write_bytes(lines[:100] + b"\n" + lines[100:])
    assert look(session).state == "ready"
    (session / "shots.jsonl").write_bytes(lines.rstrip(b"\n"))
    assert look(session).state == "ready"


def test_every_pose_of_the_plan_must_have_a_line_unless_a_person_says_it_is_complete(session: Path) -> None:
    poses = tuple(PlannedPose(name, None, np.zeros(6)) for name in ("p1", "p2"))
    write_plan(Plan("0" * 64, "workpiece", poses), session / "plan.yaml")
    assert "2 of the 2 poses" in look(session).reason
    with SessionWriter.resume(session) as writer:
        writer.append(joints_rad=np.zeros(6), xyz_mm=np.ones((5, 3), dtype=np.float32), pose_id="p1")
    assert "1 of the 2 poses" in look(session).reason
    (session / MARKER).touch()
    assert look(session).state == "ready"
    (session / MARKER).unlink()
    with SessionWriter.resume(session) as writer:
        writer.append(joints_rad=np.zeros(6), status="skipped", pose_id="p2")
    assert look(session).state == "ready"


def test_copies_under_way_and_changes_are_seen(session: Path) -> None:
    before = contents_of(session).fingerprint
    (session / "scans" / "0009.ply.part").touch()
    assert look(session).reason == "0009.ply.part is still being copied"
    assert contents_of(session).fingerprint != before
    (session / "scans" / "0009.ply.part").unlink()
    assert contents_of(session).fingerprint == before


def test_scans_with_poses_wait_for_their_clouds(tmp_path: Path) -> None:
    folder = tmp_path / "scans part"
    (folder / "clouds").mkdir(parents=True)
    (folder / "poses.csv").write_text("name,x,y,z,rx,ry,rz\nscan_1,1,2,3,0,0,0\nscan_2,4,5,6,0,0,0\n", encoding="utf-8")
    assert look(folder).state == "held"
    write_ply(folder / "clouds" / "scan_1.ply", np.ones((4, 3)))
    assert look(folder).reason == "1 of its 2 poses have no cloud yet"
    write_ply(folder / "clouds" / "scan_2.ply", np.ones((4, 3)))
    assert look(folder).state == "ready"
    assert part_name(folder) == "scans_part"
    digest = input_digest(folder, "scans", "c")
    write_ply(folder / "clouds" / "scan_2.ply", 2 * np.ones((4, 3)))
    assert len({digest, input_digest(folder, "scans", "c"), input_digest(folder, "scans", "d")}) == 3


def test_only_parts_are_parts(session: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    shutil.copytree(session, tmp_path / ".hidden.tmp")
    assert list(parts_in(tmp_path)) == [session]


def test_a_list_names_folders_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "parts.txt"
    path.write_text("# morning\nb\n\na  # twice\nb\n/elsewhere/c\n", encoding="utf-8")
    assert parts_of_list(path) == (tmp_path / "b", tmp_path / "a", Path("/elsewhere/c"))
    path.write_text("# nothing\n", encoding="utf-8")
    with pytest.raises(FileError, match="names no part"):
        parts_of_list(path)
