"""From sessions on disk: what `calibrate` itself says of mistaken data, and of single shots."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import drivers.models
from calibrate.solve import CalibrationSettings, calibrate
from drivers.errors import DataError
from drivers.files.session import read_session
from drivers.files.yaml import dump_yaml, parse_yaml
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from tests.support.solving import draw_shots
from tests.support.synthetic import SyntheticShot, paper_cell
from tests.support.synthetic_session import pose_only, write_session

CELL = paper_cell(coupled=True)
PILLOW = CalibrationSettings(camera_error="pillow")
Line = dict[str, object]


@pytest.fixture(scope="module")
def shots() -> list[SyntheticShot]:
    return draw_shots(CELL, np.random.default_rng(41), 24, n_points=150)


def edited(folder: Path, change: Callable[[list[Line]], None]) -> Path:
    lines = [json.loads(line) for line in (folder / "shots.jsonl").read_text().splitlines()]
    change(lines)
    (folder / "shots.jsonl").write_text("\n".join(json.dumps(line) for line in lines) + "\n")
    return folder


def exchange(lines: list[Line], first: int, second: int) -> None:
    lines[first]["joints_rad"], lines[second]["joints_rad"] = lines[second]["joints_rad"], lines[first]["joints_rad"]


def test_two_exchanged_shots_are_rejected_and_both_are_named(shots: list[SyntheticShot], tmp_path: Path) -> None:
    folder = write_session(tmp_path / "s", CELL, {"A": shots}, flange_from_camera=None)
    result = calibrate([read_session(edited(folder, lambda lines: exchange(lines, 6, 19)))], PILLOW)
    assert result.statistics.used == 22
    told = {r.index: r.reason for r in result.rejected}
    assert sorted(told) == [6, 19]
    assert "the pose of shot 19 and the other way round: the two look exchanged" in told[6]
    assert "the pose of shot 6 and the other way round" in told[19]


def test_a_shifted_list_ends_in_an_error_with_file_and_remedy(shots: list[SyntheticShot], tmp_path: Path) -> None:
    def shift(lines: list[Line]) -> None:
        joints = [line["joints_rad"] for line in lines]
        for line, q in zip(lines, joints[1:] + joints[:1], strict=True):
            line["joints_rad"] = q

    folder = write_session(tmp_path / "s", CELL, {"A": shots}, flange_from_camera=None)
    with pytest.raises(DataError) as error:
        calibrate([read_session(edited(folder, shift))], PILLOW)
    assert "shifted by one shot" in error.value.message
    assert "mm apart" in error.value.message
    assert str(error.value.file).endswith("shots.jsonl")
    assert "Pair every scan" in str(error.value.remedy)


@pytest.mark.parametrize("method", ["clouds", "stepwise"])
def test_poses_in_metres_are_named_whatever_the_method(method: str, shots: list[SyntheticShot], tmp_path: Path) -> None:
    poses = [shot.true_base_from_camera @ se3.inverse(CELL.flange_from_camera) for shot in shots]
    in_metres = [se3.from_rotation_translation(pose[:3, :3], pose[:3, 3] / 1000) for pose in poses]
    folder = pose_only(write_session(tmp_path / "s", CELL, {"A": shots}, flange_from_camera=CELL.flange_from_camera), in_metres)
    with pytest.raises(DataError, match="the poses are in metres"):
        calibrate([read_session(folder)], CalibrationSettings(camera_error="pillow", method=method))


def _reverse(lines: list[Line]) -> None:
    for line in lines:
        line["joints_rad"] = list(line["joints_rad"])[::-1]  # type: ignore[call-overload]


def _turn_third(lines: list[Line]) -> None:
    for line in lines:
        line["joints_rad"] = (np.array(line["joints_rad"]) * [1, 1, -1, 1, 1, 1]).tolist()


def _invert(pose: FloatArray) -> FloatArray:
    return se3.inverse(pose)


def _in_metres(pose: FloatArray) -> FloatArray:
    return se3.from_rotation_translation(pose[:3, :3], pose[:3, 3] / 1000.0)


def expecting(folder: Path, shots: list[SyntheticShot], model: str = CELL.nominal.name) -> Path:
    """A session whose cell file says, as most do, where the camera sits and where the sphere stands."""
    sphere = {"diameter_mm": 38.1, "expanded_uncertainty_mm": 0.001, "centre_in_base_mm": CELL.centre_in_base_mm.tolist()}
    extra = {"spheres": {"A": sphere}, "robot": {"driver": "recorded", "model": model}}
    return write_session(folder, CELL, {"A": shots}, flange_from_camera=CELL.flange_from_camera, extra_cell=extra)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (_reverse, "the axes come in reverse order"),
        (_turn_third, "axis 3 is recorded with the opposite sign"),
    ],
)
def test_an_expectation_that_mistaken_angles_make_wrong_hides_no_mistake(
    change: Callable[[list[Line]], None], text: str, shots: list[SyntheticShot], tmp_path: Path
) -> None:
    """By wrong poses and a good guess every sphere is expected elsewhere: that no scan shows it there is no reason to stop."""
    with pytest.raises(DataError, match=text):
        calibrate([read_session(edited(expecting(tmp_path / "s", shots), change))], PILLOW)


def test_an_expectation_that_a_missing_coupling_makes_wrong_hides_no_mistake(shots: list[SyntheticShot], tmp_path: Path) -> None:
    folder = expecting(tmp_path / "s", shots)
    model = Path(drivers.models.__file__).parent / f"{CELL.nominal.name}.yaml"
    data = parse_yaml(model.read_text(), file=model)
    assert isinstance(data, dict)
    data.pop("coupling")
    (folder / "robot_model.yaml").write_text(dump_yaml(data | {"name": "uncoupled"}))
    with pytest.raises(DataError, match=r"theta_3 = q_3 - q_2 is missing"):
        calibrate([read_session(folder)], PILLOW)


@pytest.mark.parametrize(("change", "text"), [(_invert, "flange_from_base, the inverse"), (_in_metres, "the poses are in metres")])
def test_an_expectation_that_mistaken_poses_make_wrong_hides_no_mistake(
    change: Callable[[FloatArray], FloatArray], text: str, shots: list[SyntheticShot], tmp_path: Path
) -> None:
    poses = [change(shot.true_base_from_camera @ se3.inverse(CELL.flange_from_camera)) for shot in shots]
    with pytest.raises(DataError, match=text):
        calibrate([read_session(pose_only(expecting(tmp_path / "s", shots), poses))], PILLOW)
