"""`new cell` writes what the strict reader accepts; `doctor` finds what is wrong and moves nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.cell import Cell, load_cell, robot_model_of
from drivers.errors import SettingsError, SpherecalError
from drivers.files.schema import check
from drivers.files.yaml import parse_yaml
from drivers.kinematics import mdh
from drivers.protocols import Frame3D, RobotState, Safety
from measure.cell_text import CellAnswers, cell_text
from measure.cli import app
from measure.cli_run import run_app
from measure.demo_cell import write_demo_cell
from measure.doctor import robot_problems
from measure.doctor_camera import frame_facts


def parsed(text: str) -> Cell:
    return check(Cell, parse_yaml(text, file="cell.yaml"), file="cell.yaml", text=text)


def test_a_new_cell_holds_what_was_asked(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "c.yaml"
    spheres = ["--sphere", "A:38.1:0.001", "--sphere", "B:50:0.002", "--length", "A:B:500.01:0.005"]
    assert run_app(app, ["new", "cell", "-o", str(out), "--name", "no", "--model", "ur5e", *spheres, "--json"]) == 0
    assert json.loads(capfd.readouterr().out) == {"out": str(out)}
    cell = load_cell(out)
    assert cell.name == "no"  # and not a Boolean
    assert cell.spheres["B"].diameter_mm == 50
    assert cell.lengths[0].between == ("A", "B")
    assert cell.robot.model == "ur5e"


def test_an_existing_file_is_kept(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "c.yaml"
    out.write_text("mine")
    assert run_app(app, ["new", "cell", "-o", str(out)]) == 1
    assert out.read_text() == "mine"
    assert "--force" in capfd.readouterr().err
    assert run_app(app, ["new", "cell", "-o", str(out), "--force", "-q"]) == 0
    assert load_cell(out).spheres == {}


@pytest.mark.parametrize("text", ["A", "A:38", "A:x:0.1", "A:-3:0.1", "A:nan:0.1", ":38:0.1", "A:38:0.1:3"])
def test_a_sphere_written_wrongly_is_told_and_nothing_is_written(text: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run_app(app, ["new", "cell", "-o", str(tmp_path / "c.yaml"), "--sphere", text]) == 1
    assert "NAME:DIAMETER:U" in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []


names = st.text(st.characters(codec="utf-8", exclude_characters=":"), min_size=1, max_size=8).map(str.strip).filter(bool)


@given(name=names, sphere=names)
def test_any_name_survives_or_is_refused_by_name(name: str, sphere: str) -> None:
    try:
        cell = parsed(cell_text(CellAnswers(name=name, spheres=[f"{sphere}:38.1:0.001"])))
    except SpherecalError:  # e.g. a name with a control character, which YAML refuses
        return
    assert cell.name == name
    assert list(cell.spheres) == [sphere]


def test_doctor_passes_the_demo_cell_and_names_what_is_missing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = write_demo_cell(tmp_path, 0)
    before = sorted(tmp_path.iterdir())
    assert run_app(app, ["doctor", str(path), "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert (told["robot"]["ok"], told["camera"]["ok"], told["problems"]) == (True, True, [])
    assert len(told["robot"]["joints_rad"]) == 6
    assert run_app(app, ["doctor", str(path), "--offline", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["robot"]["ok"] is None
    assert sorted(tmp_path.iterdir()) == before
    (tmp_path / "truth.yaml").unlink()
    assert run_app(app, ["doctor", str(path), "--offline", "--json"]) == 3
    assert "truth.yaml" in json.loads(capfd.readouterr().out)["problems"][0]


def test_doctor_knows_a_wrong_reading(tmp_path: Path) -> None:
    model = robot_model_of(load_cell(write_demo_cell(tmp_path, 0)))
    if model is None:
        pytest.fail("the demo has a robot")
    joints = np.array([0.1, 0.2, -0.3, 0.4, 0.5, 0.6])
    good = RobotState(joints, mdh.base_from_flange(model, joints), 0.0, moving=False)
    assert robot_problems(good, model) == []
    assert "degrees" in robot_problems(replace(good, joints_rad=np.degrees(joints), base_from_flange=None), model)[0]
    assert "axes" in robot_problems(replace(good, joints_rad=joints[:5]), model)[0]
    assert "stop" in robot_problems(replace(good, safety=Safety.PROTECTIVE_STOP), model)[0]
    tool = np.eye(4)
    tool[2, 3] = 150.0
    assert "tool" in robot_problems(replace(good, base_from_flange=mdh.base_from_flange(model, joints) @ tool), model)[0]


def test_doctor_knows_metres() -> None:
    xyz = np.full((4, 5, 3), 0.35, dtype=np.float32)
    assert frame_facts(Frame3D(xyz * 1000, 0, 0.0), (250, 450))[1] == []
    assert "metres" in frame_facts(Frame3D(xyz, 0, 0.0), (250, 450))[1][0]
    assert frame_facts(Frame3D(xyz * np.float32(np.nan), 0, 0.0), None)[0]["n_points"] == 0


def test_settings_errors_are_the_users(tmp_path: Path) -> None:
    with pytest.raises(SettingsError):
        cell_text(CellAnswers(lengths=["A:B:500"]))
