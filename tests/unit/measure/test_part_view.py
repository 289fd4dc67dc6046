"""`stitch --spheres-in-view`: the spheres of a workpiece's session correct the calibration, or it says why not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate.solve import CalibrationSettings, calibrate
from measure.cli import app
from measure.cli_run import run_app
from measure.part_view import correct_by_session
from tests.support.recorded import record_session, write_cell

PLACES = {"A": (880.0, -120.0, 300.0), "B": (980.0, 80.0, 260.0), "C": (800.0, 100.0, 400.0), "D": (900.0, 150.0, 330.0)}


def test_a_session_with_spheres_is_asked_and_one_without_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cell = write_cell(tmp_path, PLACES)
    draw = np.random.default_rng(1)
    trained = record_session(tmp_path / "calib", cell, draw, places=PLACES, shots_per_sphere=6, n_points=150, purpose="calibration")
    part = record_session(tmp_path / "part", cell, np.random.default_rng(2), places=PLACES, shots_per_sphere=3, n_points=150, purpose="workpiece")
    calibration = calibrate([trained], CalibrationSettings(camera_error="none", robot_terms="none"))
    asked = correct_by_session(calibration, part)
    assert (asked.n_spheres, asked.n_shots) == (4, 12)
    assert asked.accepted == (asked.calibration.id != calibration.id)
    nobody = correct_by_session(calibration, replace(part, shots=tuple(replace(shot, sphere=None) for shot in part.shots)))
    assert not nobody.accepted
    assert "0 shots of 0 spheres are too few" in nobody.reason
    calibration.save(tmp_path / "c.yaml")
    arguments = ["stitch", str(tmp_path / "c.yaml"), str(tmp_path / "part"), "-o", str(tmp_path / "p.ply"), "--spheres-in-view", "--json"]
    assert run_app(app, arguments) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["part_correction"]["accepted"] == asked.accepted
    assert told["calibration"] == asked.calibration.id
