"""kill -9 at any moment of a run: it resumes, and what it recorded calibrates as if nothing had happened."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import load_cell
from acquire.plan import load_plan, write_plan
from acquire.session import SessionWriter
from calibrate.result import Calibration
from calibrate.solve import CalibrationSettings, calibrate
from drivers.files.session import read_scan, read_session
from tests.support.source import ROOT
from tests.system.conftest import SmallCell

N_POSES = 24
"""Enough for a calibration."""


def run_once(small: SmallCell, plan: Path, out: Path, kill_after_s: float | None) -> bool:
    """One process; whether it came to its end before it was killed."""
    command = [sys.executable, "-m", "tests.support.capture_once", str(small.cell), str(plan), str(out)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "started\n", child.stderr.read() if child.stderr else ""
        if kill_after_s is not None:
            time.sleep(kill_after_s)
            child.kill()
        _, err = child.communicate(timeout=120)
    assert child.returncode in (0, -9), err
    return child.returncode == 0


def killed_run(small: SmallCell, folder: Path, longest_s: float, rng: np.random.Generator, most_kills: int) -> tuple[Path, int]:
    """A session that was killed again and again, then finished; and how often it was."""
    plan = load_plan(small.folder / "calibration_plan.yaml")
    write_plan(type(plan)(plan.cell_sha256, plan.purpose, plan.poses[:N_POSES]), folder / "plan.yaml")
    out, n_kills = folder / "s", 0
    while n_kills < most_kills:
        before = len(read_session(out).all_shots) if out.exists() else 0
        if run_once(small, folder / "plan.yaml", out, float(rng.uniform(0, longest_s))):
            return out, n_kills
        n_kills += 1
        if out.exists():
            SessionWriter.resume(out).close()
            assert len(read_session(out).all_shots) >= before
    assert run_once(small, folder / "plan.yaml", out, None)
    return out, n_kills


def uninterrupted(small: SmallCell, killed: Path, out: Path) -> Path:
    """The same shots, written by one process."""
    session = read_session(killed)
    with SessionWriter.create(out, purpose="calibration", cell=load_cell(small.cell)) as writer:
        for shot in session.shots:
            writer.append(
                sphere=shot.sphere,
                joints_rad=shot.joints_rad,
                base_from_flange=shot.base_from_flange,
                xyz_mm=read_scan(session, shot).xyz_mm,
                temperatures_c=shot.temperatures_c,
                pose_id=shot.pose_id,
            )
    return out


def solved(folder: Path) -> Calibration:
    return calibrate([read_session(folder)], CalibrationSettings(camera_error="pillow"))


def check(small: SmallCell, killed: Path, folder: Path) -> None:
    session = read_session(killed)
    assert [shot.pose_id for shot in session.shots] == [pose.id for pose in load_plan(killed / "plan.yaml").poses]
    assert all(shot.status == "ok" for shot in session.shots)
    assert {path.name for path in (killed / "scans").iterdir()} == {Path(str(shot.scan)).name for shot in session.shots}
    ours, theirs = solved(killed), solved(uninterrupted(small, killed, folder / "u"))
    np.testing.assert_allclose(ours.link_twists, theirs.link_twists, atol=1e-9)
    np.testing.assert_allclose(ours.flange_from_camera, theirs.flange_from_camera, atol=1e-9)
    for name, centre in theirs.sphere_centres_in_base_mm.items():
        np.testing.assert_allclose(ours.sphere_centres_in_base_mm[name], centre, atol=1e-7)


def test_a_run_that_was_killed_calibrates_as_one_that_was_not(small: SmallCell, tmp_path: Path) -> None:
    killed, n_kills = killed_run(small, tmp_path, 0.8, np.random.default_rng(2), 1)
    assert n_kills > 0
    check(small, killed, tmp_path)


@pytest.mark.qualify
def test_a_hundred_kills(small: SmallCell, tmp_path: Path) -> None:
    seed = int.from_bytes(os.urandom(4))
    print("seed", seed)
    rng, n_kills, n_sessions = np.random.default_rng(seed), 0, 0
    while n_kills < 100:
        folder = tmp_path / str(n_sessions)
        folder.mkdir()
        killed, kills = killed_run(small, folder, 3.0, rng, 100 - n_kills)
        check(small, killed, folder)
        shutil.rmtree(folder)
        n_kills, n_sessions = n_kills + kills, n_sessions + 1
    print(f"{n_kills} kills over {n_sessions} sessions")
