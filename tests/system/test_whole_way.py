"""The whole way through the command line on a small simulated cell: what each verb promises in DESIGN section 4."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from drivers.files.ply import read_ply
from drivers.files.session import read_session
from measure.demo_cell import true_centres_in_base_mm
from tests.system.conftest import N_CALIBRATION, N_VERIFICATION, Cli, SmallCell

LENGTH_KEYS = {"between", "measured_mm", "reference_mm", "error_mm", "expanded_uncertainty_mm"}


def test_centres_finds_every_sphere_and_writes_a_table(small: SmallCell, tmp_path: Path, cli: Cli) -> None:
    out = tmp_path / "centres.csv"
    told = cli("centres", small.calibration_session, "-o", out, "--json").told
    assert told["n_shots"] == N_CALIBRATION
    assert told["used"] + len(told["rejected"]) == N_CALIBRATION
    assert told["used"] >= 0.9 * N_CALIBRATION
    assert len(out.read_text().splitlines()) >= told["used"] + 1


def test_calibrate_tells_the_contracts_keys(small: SmallCell, calibration: Path, tmp_path: Path, cli: Cli) -> None:
    out = tmp_path / "calibration.yaml"
    shutil.copy(calibration, out)
    result = cli("calibrate", small.calibration_session, "-o", out, "--json")
    assert result.code == 0, result.err
    told = result.told
    keys = "method camera_error n_shots used rejected rank n_parameters train_rms_mm cross_validated_rms_mm verdict reasons seconds id out"
    assert set(keys.split()) <= set(told)
    assert told["n_shots"] == told["used"] + len(told["rejected"]) == N_CALIBRATION
    assert told["verdict"] in ("pass", "marginal")
    assert told["cross_validated_rms_mm"] < 0.2
    assert told["id"] in out.read_text()
    assert told["out"] == str(out)
    assert list(tmp_path.iterdir()) == [out]  # the same content again: the earlier file needs no keeping


def test_calibrate_by_centres_tells_the_same_keys_and_its_method(small: SmallCell, calibration: Path, tmp_path: Path, cli: Cli) -> None:
    out = tmp_path / "centres.yaml"
    result = cli("calibrate", small.calibration_session, "-o", out, "--method", "centres", "--camera-error", "pillow", "--json")
    assert result.code == 0, result.err
    told = result.told
    assert (told["method"], told["camera_error"]) == ("centres", "pillow")
    assert told["n_shots"] == told["used"] + len(told["rejected"]) == N_CALIBRATION
    assert told["cross_validated_rms_mm"] < 0.2
    assert "method: centres" in out.read_text()
    verified = cli("verify", out, small.verification_session, "--json").told
    by_clouds = cli("verify", calibration, small.verification_session, "--json").told
    assert verified["centre_rms_mm"] < 1.5 * by_clouds["centre_rms_mm"]


def test_verify_beats_the_uncalibrated_cell_on_lengths_it_never_saw(small: SmallCell, calibration: Path, cli: Cli) -> None:
    result = cli("verify", calibration, small.verification_session, "--json")
    assert result.code == 0, result.err
    told = result.told
    assert told["n_shots"] == N_VERIFICATION
    assert told["verdict"] in ("conform", "not_proven")
    assert all(set(length) >= LENGTH_KEYS for length in told["lengths"])
    assert len(told["lengths"]) == 6
    assert set(told["spheres"]) == set("GHIJ")
    errors = np.array([length["error_mm"] for length in told["lengths"]])
    uncalibrated = np.array(list(told["before"]["length_errors_mm"].values()))
    assert np.abs(errors).max() < 0.3
    assert np.sqrt((errors**2).mean()) < 0.3 * np.sqrt((uncalibrated**2).mean())
    assert told["centre_rms_mm"] < 0.15 * told["before"]["centre_rms_mm"]


def test_verify_refuses_the_training_shots(small: SmallCell, calibration: Path, cli: Cli) -> None:
    result = cli("verify", calibration, small.calibration_session, "--json")
    assert result.code == 1
    assert result.err.count("\n") == 1


def test_stitch_puts_the_workpiece_where_it_stands(small: SmallCell, calibration: Path, tmp_path: Path, cli: Cli) -> None:
    out = tmp_path / "cloud.ply"
    told = cli("stitch", calibration, small.workpiece_session, "-o", out, "--voxel", 1.0, "--json").told
    cloud = read_ply(out)
    points = cloud.xyz_mm
    assert len(points) == told["n_points"] > 1000
    assert told["n_points_in"] >= told["n_points"]
    assert any("unit mm" in comment for comment in cloud.comments)
    # the top of the table is the plane z = 60; the true base and the calibrated one differ by tenths of a mm
    table = points[np.abs(points[:, 2] - 60) < 2]
    assert len(table) > 200
    assert abs(float(np.median(table[:, 2])) - 60) < 1.0


def test_report_and_show_write_their_files(small: SmallCell, calibration: Path, tmp_path: Path, cli: Cli) -> None:
    report, recording = tmp_path / "report.html", tmp_path / "run.rrd"
    assert cli("report", calibration, small.verification_session, "-o", report, "--json").told["out"] == str(report)
    page = report.read_text(encoding="utf-8")
    assert "<html" in page
    assert not re.search(r"""(?:src|href)\s*=\s*["']?https?:|url\(\s*["']?https?:|@import""", page)  # nothing is fetched
    assert cli("show", calibration, small.calibration_session, "-o", recording, "--json").told["out"] == str(recording)
    assert recording.stat().st_size > 1000
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.html", "report.json", "run.rrd"]


def test_the_calibrated_spheres_lie_where_they_stand(small: SmallCell, calibration: Path) -> None:
    from calibrate import Calibration

    found = Calibration.load(calibration).sphere_centres_in_base_mm
    true = true_centres_in_base_mm()
    for first, second in (("A", "B"), ("C", "D"), ("E", "F"), ("A", "F")):
        length, expected = np.linalg.norm(found[first] - found[second]), np.linalg.norm(true[first] - true[second])
        assert abs(length - expected) < 0.15


def test_the_hidden_truth_is_never_needed(small: SmallCell, tmp_path: Path, cli: Cli) -> None:
    truth = small.folder / "truth.yaml"
    hidden = truth.rename(tmp_path / "hidden.yaml")
    try:
        assert cli("calibrate", small.calibration_session, "-o", tmp_path / "c.yaml", "--json").code == 0
    finally:
        hidden.rename(truth)


def test_a_session_holds_what_the_robot_said_it_did(small: SmallCell) -> None:
    session = read_session(small.calibration_session)
    assert session.purpose == "calibration"
    assert len(session.shots) == N_CALIBRATION
    assert all(shot.joints_rad is not None and shot.target_joints_rad is not None for shot in session.shots)
    assert session.plan_path is not None
    assert session.robot_model_path is not None


@pytest.mark.parametrize("environment", [{"NO_COLOR": "1", "TERM": "dumb"}, {"FORCE_COLOR": "1", "COLUMNS": "80"}])
def test_every_stage_works_without_a_terminal(environment: dict[str, str], small: SmallCell, tmp_path: Path) -> None:
    process = subprocess.run(
        [sys.executable, "-m", "measure.cli", "capture", str(small.cell), str(small.folder / "workpiece_plan.yaml"), "-o", "s", "--yes"],
        cwd=tmp_path,
        env={**os.environ, **environment},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    assert "Traceback" not in process.stderr
    assert max(len(line) for line in process.stderr.splitlines()) <= 80
    assert (tmp_path / "s" / "shots.jsonl").exists()
