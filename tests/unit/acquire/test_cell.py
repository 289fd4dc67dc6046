"""The cell file: what is right is read, what is wrong is told with key path, line, and what is allowed."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from acquire.cell import Cell, cell_of_session, devices_of, load_cell, parse_cell, robot_model_of
from acquire.obstacles import BoxObstacle, CylinderObstacle, MeshObstacle
from drivers.errors import FileError, SettingsError
from drivers.files.session import read_session
from tests.support.sessions import write_session

FULL = """\
format: spherecal-cell/1
name: demo
robot: {driver: simulated, model: abb_irb1410, truth: truth.yaml, instant: true}
camera: {driver: simulated, kind: area, working_range_mm: [250, 750], field_of_view_deg: [55, 36], sight_crossing_mm: [60, 0, 500], serial: 7}
flange_from_camera: [[0, -1, 0, 60], [1, 0, 0, 60], [0, 0, 1, 85], [0, 0, 0, 1]]
spheres:
  A: {diameter_mm: 38.1, expanded_uncertainty_mm: 1e-3, centre_in_base_mm: [900, 100, 300], certificate: "x", form_mm: 0.001, cte_per_k: 5.5e-6}
  B: {diameter_mm: 38, expanded_uncertainty_mm: 0}
lengths: [{between: [A, B], length_mm: 500.012, expanded_uncertainty_mm: 0.003}]
limits: {centre_rms_mm: 0.2, length_error_mm: 0.2, diameter_error_mm: 0.1, form_mm: 0.3}
work_volume_mm: [[700, -300, 200], [1100, 300, 600]]
obstacles:
- {name: table, kind: box, size_mm: [1000, 800, 20], centre_in_base_mm: [900, 0, -10]}
- {name: post, kind: cylinder, diameter_mm: 80, height_mm: 500, centre_in_base_mm: [0, 500, 250], rotation_deg: [0, 90, 0]}
- {name: fixture, kind: mesh, file: fixture.stl}
motion: {speed_rad_s: 0.5, settle_s: 1, frames: 2}
identity: {robot_serial: "14-1", payload_kg: 3.5}
"""

MINIMAL = """\
format: spherecal-cell/1
name: least
robot: {driver: recorded, model: null}
camera: {driver: recorded}
flange_from_camera: null
spheres: {}
"""


def _load(folder: Path, text: str) -> Cell:
    path = folder / "cell.yaml"
    path.write_text(text, encoding="utf-8")
    return load_cell(path)


def _error(folder: Path, text: str) -> FileError:
    with pytest.raises(FileError) as caught:
        _load(folder, text)
    assert caught.value.file == str(folder / "cell.yaml")
    assert caught.value.remedy
    assert "\n" not in str(caught.value)
    return caught.value


def test_a_full_cell(tmp_path: Path) -> None:
    cell = _load(tmp_path, FULL)
    assert cell.robot.settings == {"truth": "truth.yaml", "instant": True}
    assert cell.camera.settings == {"serial": 7}
    assert cell.camera.working_range_mm == (250, 750)
    assert cell.spheres["A"].radius_mm == 19.05
    assert cell.spheres["A"].radius_standard_uncertainty_mm == pytest.approx(0.001 / 4)
    assert cell.lengths[0].standard_uncertainty_mm == pytest.approx(0.0015)
    assert cell.flange_from_camera is not None
    assert cell.flange_from_camera.dtype == np.float64
    assert cell.flange_from_camera[1, 3] == 60
    assert cell.work_volume_box_mm is not None
    assert cell.work_volume_box_mm.shape == (2, 3)
    assert [type(item) for item in cell.obstacles] == [BoxObstacle, CylinderObstacle, MeshObstacle]
    assert np.allclose(cell.obstacles[1].base_from_obstacle[:3, 2], [1, 0, 0])
    assert (cell.motion.speed_rad_s, cell.motion.settle_s, cell.motion.frames) == (0.5, 1, 2)
    assert cell.identity == {"robot_serial": "14-1", "payload_kg": 3.5}
    assert cell.folder == tmp_path
    assert cell.data == FULL.encode()


def test_certificates_hold_at_20_degrees_unless_they_say_otherwise(tmp_path: Path) -> None:
    plain = _load(tmp_path, FULL)
    assert (plain.lengths[0].cte_per_k, plain.lengths[0].reference_temperature_c) == (None, 20.0)
    told = _load(tmp_path, FULL.replace("0.003}]", "0.003, cte_per_k: 1.15e-5, reference_temperature_c: 23}]"))
    assert (told.lengths[0].cte_per_k, told.lengths[0].reference_temperature_c) == (1.15e-5, 23.0)


def test_the_least_cell_has_the_defaults(tmp_path: Path) -> None:
    cell = _load(tmp_path, MINIMAL)
    assert (cell.lengths, cell.limits, cell.work_volume_mm, cell.obstacles, cell.flange_from_camera) == ((), None, None, (), None)
    assert (cell.motion.speed_rad_s, cell.motion.settle_s, cell.motion.frames) == (0.3, 0.5, 1)
    assert cell.camera.kind == "area"
    assert robot_model_of(cell) is None


def test_a_cell_cannot_be_changed(tmp_path: Path) -> None:
    cell = _load(tmp_path, FULL)
    with pytest.raises(ValidationError):
        cell.name = "other"
    assert cell.flange_from_camera is not None
    with pytest.raises(ValueError, match="read-only"):
        cell.flange_from_camera[0, 0] = 2


HAND_EYE = "[[0, -1, 0, 60], [1, 0, 0, 60], [0, 0, 1, 85], [0, 0, 0, 1]]"

WRONG = {
    "misspelt key": ("name: demo", "nmae: demo", "nmae", "flange_from_camera"),
    "missing key": ("name: demo\n", "", "name", "missing"),
    "missing model": ("model: abb_irb1410, ", "", "robot.model", "missing"),
    "misspelt key of a sphere": ("certificate", "certificat", "spheres.A.certificat", "form_mm"),
    "word for a number": ("38.1", "large", "spheres.A.diameter_mm", "'large'"),
    "text for a number": ("38.1", "'38.1'", "spheres.A.diameter_mm", "number"),
    "truth for a number": ("38.1", "true", "spheres.A.diameter_mm", "number"),
    "metres": ("38.1", "0.0381", "spheres.A.diameter_mm", "metres"),
    "negative": ("38.1", "-38.1", "spheres.A.diameter_mm", "greater than 0"),
    "not finite": ("38.1", ".nan", "spheres.A.diameter_mm", "nan"),
    "two coordinates": ("[900, 100, 300]", "[900, 100]", "spheres.A.centre_in_base_mm", "missing"),
    "four coordinates": ("[900, 100, 300]", "[900, 100, 300, 1]", "spheres.A.centre_in_base_mm", "too long"),
    "number as a name": ("  B:", "  2:", "spheres.2", "quotes"),
    "length to nowhere": ("[A, B]", "[A, C]", "lengths.0", "'C'"),
    "length to itself": ("[A, B]", "[A, A]", "lengths.0", "twice"),
    "expansion in millionths": ("5.5e-6", "5.5", "spheres.A.cte_per_k", "less than 0.001"),
    "expansion of a length": ("0.003}]", "0.003, cte_per_k: 11.5}]", "lengths.0.cte_per_k", "less than 0.001"),
    "reference in kelvin": ("0.003}]", "0.003, reference_temperature_c: 293.15}]", "lengths.0.reference_temperature_c", "less than 100"),
    "length without uncertainty": ("500.012, expanded_uncertainty_mm: 0.003", "500.012, expanded_uncertainty_mm: 0", "lengths.0", "greater than 0"),
    "limit of nothing": ("centre_rms_mm: 0.2", "centre_rms_mm: 0", "limits.centre_rms_mm", "greater than 0"),
    "stretched hand-eye": ("[0, 0, 1, 85]", "[0, 0, 1.001, 85]", "flange_from_camera", "rigid"),
    "mirrored hand-eye": ("[0, 0, 1, 85]", "[0, 0, -1, 85]", "flange_from_camera", "mirrors"),
    "transposed hand-eye": (HAND_EYE, "[[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [60, 60, 85, 1]]", "flange_from_camera", "transposed"),
    "three rows": (", [0, 0, 0, 1]]", "]", "flange_from_camera", "4 rows"),
    "ragged hand-eye": ("[0, 0, 1, 85]", "[0, 0, 1]", "flange_from_camera", "4 rows"),
    "words in the hand-eye": ("[0, 0, 1, 85]", "[0, 0, one, 85]", "flange_from_camera", "4 rows"),
    "other format": ("cell/1", "cell/9", "format", "spherecal-cell/1"),
    "camera kind": ("kind: area", "kind: volume", "camera.kind", "line_profile"),
    "range backwards": ("[250, 750]", "[750, 250]", "camera.working_range_mm", "nearest"),
    "view of nothing": ("[55, 36]", "[55, 0]", "camera.field_of_view_deg", "degrees"),
    "volume inside out": ("[[700, -300, 200]", "[[700, 400, 200]", "work_volume_mm", "lower corner"),
    "obstacle kind": ("kind: box", "kind: ball", "obstacles.0", "cylinder"),
    "obstacle without kind": ("kind: box, ", "", "obstacles.0", "kind"),
    "obstacle key": ("size_mm", "sizes_mm", "obstacles.0.sizes_mm", "unknown key"),
    "half a frame": ("frames: 2", "frames: 1.5", "motion.frames", "integer"),
    "identity list": ('"14-1"', "[1]", "identity.robot_serial", "list"),
    "section as a number": ("motion: {speed_rad_s: 0.5, settle_s: 1, frames: 2}", "motion: 3", "motion", "mapping"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_told_with_its_key_and_line(name: str, tmp_path: Path) -> None:
    old, new, where, word = WRONG[name]
    assert old in FULL
    error = _error(tmp_path, FULL.replace(old, new, 1))
    assert error.where is not None
    assert where in error.where or where in error.message
    assert word in str(error)
    assert "pydantic" not in str(error)
    if error.where != "top level" and "missing key" not in name:
        line = FULL[: FULL.index(old)].count("\n") + 1
        assert f"(line {line})" in error.where


@pytest.mark.parametrize(("text", "word"), [("", "no keys"), ("- 1\n", "no keys"), ("a: [\n", "YAML"), (MINIMAL + "spheres: {}\n", "twice")])
def test_no_cell_at_all(text: str, word: str, tmp_path: Path) -> None:
    assert word in str(_error(tmp_path, text))


def test_further_errors_are_counted(tmp_path: Path) -> None:
    assert "(and 2 more)" in str(_error(tmp_path, FULL.replace("38.1", "x").replace("500.012", "x").replace("frames: 2", "frames: x")))


def test_the_model_of_a_session_wins(tmp_path: Path) -> None:
    folder = write_session(tmp_path / "s")
    session = read_session(folder)
    cell = cell_of_session(session)
    nominal = robot_model_of(cell, session)
    assert nominal is not None
    assert nominal.name == "ur5e"
    (folder / "robot_model.yaml").write_text(nominal.text.replace("ur5e", "mine"), encoding="utf-8")
    own = robot_model_of(cell, read_session(folder))
    assert own is not None
    assert own.name == "mine"
    (folder / "robot_model.yaml").write_text("broken: [\n", encoding="utf-8")
    with pytest.raises(FileError, match=r"robot_model\.yaml"):
        robot_model_of(cell, read_session(folder))


def test_a_model_beside_the_cell(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"mine\.yaml"):
        robot_model_of(_load(tmp_path, FULL.replace("abb_irb1410", "mine.yaml")))


def test_unknown_drivers_are_told(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="recorded"):
        devices_of(_load(tmp_path, MINIMAL.replace("robot: {driver: recorded", "robot: {driver: kuka")))


_WORDS = ["{", "}", "[", "]", ":", ",", "\n", "  ", "-1", ".nan", "null", "1e999", "''", "A", "kind", "&a ", "*a", "!x ", "[[[]]]", "\x00", "é"]


@given(st.lists(st.tuples(st.integers(0, len(FULL)), st.integers(0, 12), st.sampled_from(_WORDS)), min_size=1, max_size=3))
def test_random_edits_give_a_cell_or_a_file_error(edits: list[tuple[int, int, str]]) -> None:
    text = FULL
    for start, length, new in edits:
        text = text[:start] + new + text[start + length :]
    with suppress(FileError):
        assert isinstance(parse_cell(text.encode(), path=Path("cell.yaml")), Cell)
