"""The capture run on the simulated demo cell: planned poses, found spheres, and time that does not pass."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from acquire.capture import run_capture
from acquire.cell import devices_of, load_cell, robot_model_of
from acquire.centres import centres_of_session
from acquire.events import Captured, Finished
from acquire.session import SessionWriter
from acquire.sphere import SphereFinding
from drivers.files.session import read_session
from measure.demo_cell import CALIBRATION_SPHERES, write_demo_cell
from measure.planning import PlanSettings, make_plan


def test_every_planned_pose_of_the_demo_cell_gives_a_sphere(tmp_path: Path) -> None:
    cell = load_cell(write_demo_cell(tmp_path, seed=3))
    model = robot_model_of(cell)
    plan = make_plan(cell, PlanSettings("calibration", 6, CALIBRATION_SPHERES, seed=3)).plan
    with devices_of(cell) as devices, SessionWriter.create(tmp_path / "session", purpose="calibration", cell=cell) as writer:
        events = list(run_capture(devices, cell, plan, writer, model=model))
        clock_s = devices.robot.read_state().time_s
    assert events[-1] == Finished(6, 0, 0, stopped=False)
    assert clock_s > 5
    captured = [event for event in events if isinstance(event, Captured)]
    for event in captured:
        assert isinstance(event.finding, SphereFinding)
        # the first hand-eye is 2 mm and some mrad off, the cell's places 2 mm
        assert event.prediction_error_mm is not None
        assert 0.1 < event.prediction_error_mm < 15
        assert abs(event.finding.free_radius_mm - cell.spheres[str(event.shot.sphere)].radius_mm) < 0.3
        assert event.shot.stillness_rad is not None
        assert event.shot.stillness_rad < 1e-4
    rows = list(centres_of_session(read_session(tmp_path / "session"), cell, model=model))
    for row, event in zip(rows, captured, strict=True):
        assert isinstance(event.finding, SphereFinding)
        assert row.centre_in_camera_mm is not None
        np.testing.assert_allclose(row.centre_in_camera_mm, event.finding.centre_in_camera_mm, atol=1e-6)
