"""A truth that is drawn for a cell file: certificates hold, places are near, and contradictions are told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquire.cell import devices_of, load_cell
from drivers.errors import SettingsError
from drivers.files.yaml import dump_yaml
from drivers.kinematics import mdh
from drivers.models import load_robot_model
from drivers.simulated.truth_file import load_truth
from measure.cli import app
from measure.cli_run import run_app
from measure.new_truth import truth_of_cell

LENGTHS = (("A", "B", 300.012), ("B", "C", 240.5), ("C", "A", 245.0))
U_MM = 0.004


def cell_file(folder: Path, **changes: object) -> Path:
    """Three spheres, a length for every pair, a table."""
    spheres: dict[str, dict[str, object]] = {
        name: {"diameter_mm": 38.1, "expanded_uncertainty_mm": 0.002, "centre_in_base_mm": list(place)}
        for name, place in (("A", (420, -150, 120)), ("B", (420, 150, 120)), ("C", (600, 0, 180)))
    }
    data: dict[str, Any] = {
        "format": "spherecal-cell/1",
        "name": "drawn",
        "robot": {"driver": "simulated", "model": "ur5e", "truth": "truth.yaml"},
        "camera": {"driver": "simulated"},
        "flange_from_camera": None,
        "spheres": spheres,
        "lengths": [{"between": [a, b], "length_mm": mm, "expanded_uncertainty_mm": U_MM} for a, b, mm in LENGTHS],
        "obstacles": [{"name": "table", "kind": "box", "centre_in_base_mm": [500, 0, -20], "size_mm": [800, 800, 40]}],
    }
    path = folder / "cell.yaml"
    path.write_text(dump_yaml(data | changes), encoding="utf-8")
    return path


@pytest.mark.parametrize("seed", [0, 1, 977])
def test_certificates_hold_and_nothing_hangs_on_the_clock(seed: int, tmp_path: Path) -> None:
    cell = load_cell(cell_file(tmp_path))
    truth = truth_of_cell(cell, seed)
    assert truth == truth_of_cell(cell, seed)
    assert truth != truth_of_cell(cell, seed + 1)
    centres = {name: np.array(sphere.centre_in_base_mm) for name, sphere in truth.spheres.items()}
    for first, second, length_mm in LENGTHS:
        assert abs(np.linalg.norm(centres[first] - centres[second]) - length_mm) < 2 * U_MM
    for name, sphere in cell.spheres.items():
        assert np.linalg.norm(centres[name] - np.array(sphere.centre_in_base_mm)) < 20
        assert abs(truth.spheres[name].diameter_mm - sphere.diameter_mm) < 2 * sphere.expanded_uncertainty_mm
    assert len(truth.boxes) == 1
    assert truth.robot.drift_per_hour == (0.0,) * 6


def test_the_command_writes_what_the_simulated_cell_reads(tmp_path: Path) -> None:
    path = cell_file(tmp_path)
    assert run_app(app, ["new", "truth", str(path), "-o", str(tmp_path / "truth.yaml"), "--seed", "3", "-q"]) == 0
    assert load_truth(tmp_path / "truth.yaml") == truth_of_cell(load_cell(path), 3)
    assert run_app(app, ["new", "truth", str(path), "-o", str(tmp_path / "truth.yaml"), "-q"]) == 1
    robot = devices_of(load_cell(path)).robot
    robot.open()
    joints = robot.read_state().joints_rad
    robot.close()
    assert joints is not None
    assert mdh.base_from_flange(load_robot_model("ur5e"), joints)[2, 3] > 300  # a UR does not begin stretched out flat


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"lengths": [{"between": ["A", "B"], "length_mm": 500.0, "expanded_uncertainty_mm": 0.01}]}, "places"),
        ({"spheres": {"A": {"diameter_mm": 38.1, "expanded_uncertainty_mm": 0.001}}, "lengths": []}, "has no place"),
        ({"robot": {"driver": "simulated", "model": None, "truth": "truth.yaml"}}, "no robot model"),
    ],
)
def test_what_cannot_be_drawn_is_told(changes: dict[str, object], word: str, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=word) as caught:
        truth_of_cell(load_cell(cell_file(tmp_path, **changes)), 0)
    assert caught.value.remedy
