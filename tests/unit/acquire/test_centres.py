"""Centres of a session: one row a shot, reasons told, one scan at a time, CSV that reads back."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from acquire.capture import run_capture
from acquire.cell import Cell, cell_of_session, robot_model_of
from acquire.centres import centres_of_session, write_centres_csv
from acquire.events import Captured
from acquire.plan import Plan
from acquire.session import SessionWriter
from drivers.errors import CameraTimeout, FileError
from drivers.files.session import Session, read_session
from tests.support.fake_devices import CENTRE_MM, RADIUS_MM, fake_cell, fake_devices, fake_plan
from tests.support.scenes import cap


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[Session, Cell]:
    """Shots: sphere, failed, sphere, workpiece, a scan without a sphere."""
    cell = fake_cell(tmp_path)
    devices, _, camera = fake_devices()
    camera.faults = [None, CameraTimeout("late"), CameraTimeout("late")]
    with SessionWriter.create(tmp_path / "session", purpose="calibration", cell=cell) as writer:
        poses = (*fake_plan(3).poses, *(pose for pose in fake_plan(4, sphere=None).poses if pose.id == "p3"))
        captured = [event for event in run_capture(devices, cell, Plan("0" * 64, "calibration", poses), writer) if isinstance(event, Captured)]
        writer.append(sphere="A", joints_rad=[0.1, 0.2], base_from_flange=np.eye(4), xyz_mm=cap(30, centre_mm=CENTRE_MM, radius_mm=RADIUS_MM))
    assert len(captured) == 3
    return read_session(tmp_path / "session"), cell


def test_every_shot_has_its_row(recorded: tuple[Session, Cell]) -> None:
    session, cell = recorded
    rows = list(centres_of_session(session, cell))
    assert [row.reason for row in rows] == [None, "failed", None, "no_sphere_named", "too_few_points"]
    assert [row.used for row in rows] == [True, False, True, False, False]
    for row in rows:
        if row.used:
            assert row.centre_in_camera_mm is not None
            assert row.covariance_mm2 is not None
            np.testing.assert_allclose(row.centre_in_camera_mm, CENTRE_MM, atol=0.03)
            assert (np.linalg.eigvalsh(row.covariance_mm2) > 0).all()
            assert row.prediction_error_mm == pytest.approx(np.linalg.norm(CENTRE_MM - [8, -4, 333]), abs=0.05)
        else:
            assert row.message


def test_csv_reads_back(recorded: tuple[Session, Cell], tmp_path: Path) -> None:
    session, cell = recorded
    rows = list(centres_of_session(session, cell))
    write_centres_csv(rows, tmp_path / "centres.csv")
    with (tmp_path / "centres.csv").open(encoding="utf-8", newline="") as stream:
        read = list(csv.DictReader(stream))
    assert [int(line["index"]) for line in read] == [row.index for row in rows]
    assert [line["reason"] or None for line in read] == [row.reason for row in rows]
    for line, row in zip(read, rows, strict=True):
        if row.centre_in_camera_mm is None:
            assert line["x_mm"] == line["xx_mm2"] == ""
        else:
            np.testing.assert_allclose([float(line[key]) for key in ("x_mm", "y_mm", "z_mm")], row.centre_in_camera_mm, rtol=1e-8)


def test_scans_are_read_one_at_a_time_and_a_missing_one_is_an_error(recorded: tuple[Session, Cell]) -> None:
    session, cell = recorded
    rows = centres_of_session(session, cell)
    assert next(rows).used
    (session.folder / str(session.shots[2].scan)).unlink()
    assert not next(rows).used
    with pytest.raises(FileError):
        next(rows)


def test_real_arcs_have_no_centre_but_are_used(real_data: Path) -> None:
    session = read_session(real_data / "line_scanner" / "r40_a")
    cell = cell_of_session(session)
    rows = list(centres_of_session(session, cell, model=robot_model_of(cell, session)))
    assert len(rows) == 15
    assert all(row.used and row.centre_in_camera_mm is None and row.n_points > 1000 for row in rows)
