"""Shared by the tests of the solver: one BLAS thread, and small calibrations that several modules look at."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate import Calibration
from calibrate.solve import CalibrationSettings, calibrate
from drivers.files.session import read_session
from drivers.kinematics import se3
from tests.support.solving import draw_shots, one_thread
from tests.support.synthetic import paper_cell
from tests.support.synthetic_session import pose_only, write_session

PLACES = {"A": (900.0, 100.0, 300.0), "B": (820.0, -250.0, 380.0)}
LIMITS = {"centre_rms_mm": 0.2, "length_error_mm": 0.5, "diameter_error_mm": 0.2, "form_mm": 0.3}


@pytest.fixture(autouse=True)
def _one_blas_thread() -> Iterator[None]:
    with one_thread():
        yield


@pytest.fixture(scope="session")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    """Two spheres with a certified length, the whole robot, pillow."""
    cell, rng = paper_cell(), np.random.default_rng(5)
    placed = {name: replace(cell, centre_in_base_mm=np.array(place)) for name, place in PLACES.items()}
    shots = {name: draw_shots(at, rng, 20, n_points=150) for name, at in placed.items()}
    length = ("A", "B", float(np.linalg.norm(np.subtract(PLACES["A"], PLACES["B"]))), 0.005)
    folder = write_session(
        tmp_path_factory.mktemp("two") / "s", cell, shots, flange_from_camera=None, lengths=[length], extra_cell={"limits": LIMITS}
    )
    return calibrate([read_session(folder)], CalibrationSettings(camera_error="pillow"))


@pytest.fixture(scope="session")
def pose_only_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """30 shots with true flange poses and no axis angles."""
    cell, rng = paper_cell(), np.random.default_rng(6)
    shots = draw_shots(cell, rng, 30, n_points=150)
    poses = [shot.true_base_from_camera @ se3.inverse(cell.flange_from_camera) for shot in shots]
    return pose_only(write_session(tmp_path_factory.mktemp("poses") / "s", cell, {"A": shots}, flange_from_camera=None), poses)


@pytest.fixture(scope="session")
def pose_only_calibration(pose_only_session: Path) -> Calibration:
    """Hand-eye and camera alone."""
    return calibrate([read_session(pose_only_session)], CalibrationSettings(camera_error="pillow"))
