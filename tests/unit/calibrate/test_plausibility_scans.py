"""Sessions on disk whose scans or diameters are in another unit: `calibrate` names it, or says that it found nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate.solve import CalibrationSettings, calibrate
from drivers.errors import DataError
from drivers.files.session import read_session
from tests.support.solving import draw_shots
from tests.support.synthetic import SyntheticShot, paper_cell
from tests.support.synthetic_session import write_session

CELL = paper_cell(coupled=True)
PLAIN = CalibrationSettings(camera_error="none")


@pytest.fixture(scope="module")
def shots() -> list[SyntheticShot]:
    return draw_shots(CELL, np.random.default_rng(31), 10, n_points=600)


def told(folder: Path, shots: list[SyntheticShot], *, points_times: float = 1.0, diameter_mm: float = 38.1) -> DataError:
    scaled = [replace(shot, points_in_camera_mm=shot.points_in_camera_mm * points_times) for shot in shots]
    spheres: Mapping[str, object] = {"A": {"diameter_mm": diameter_mm, "expanded_uncertainty_mm": 0.001}}
    session = write_session(folder, CELL, {"A": scaled}, flange_from_camera=None, extra_cell={"spheres": spheres})
    with pytest.raises(DataError) as error:
        calibrate([read_session(session)], PLAIN)
    assert error.value.remedy
    return error.value


@pytest.mark.parametrize(
    ("points_times", "words"),
    [(1e-3, "in metres"), (1 / 25.4, "in inches"), (0.1, "in centimetres"), (10.0, "in tenths of a mm"), (1000.0, "in micrometres")],
)
def test_the_unit_of_the_scans_is_named(shots: list[SyntheticShot], tmp_path: Path, points_times: float, words: str) -> None:
    assert words in told(tmp_path / "s", shots, points_times=points_times).message


@pytest.mark.parametrize(
    ("diameter_mm", "words"),
    [
        (19.05, "diameter_mm holds the radius"),
        (76.2, "twice the diameter"),
        (1.5, "diameter_mm is in inches"),
        (3.81, "diameter_mm is in centimetres"),
    ],
)
def test_the_mistaken_diameter_is_named(shots: list[SyntheticShot], tmp_path: Path, diameter_mm: float, words: str) -> None:
    assert words in told(tmp_path / "s", shots, diameter_mm=diameter_mm).message


def test_scans_without_any_sphere_are_not_explained_away(shots: list[SyntheticShot], tmp_path: Path) -> None:
    flat = [replace(shot, points_in_camera_mm=shot.points_in_camera_mm * [1, 1, 0] + [0, 0, 400]) for shot in shots]
    message = told(tmp_path / "s", flat).message
    assert "none of 10 shots shows its sphere" in message
    assert "most likely" not in message
