"""From sessions on disk: what `calibrate` itself says of mistaken data, and of single shots."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calibrate.solve import CalibrationSettings, calibrate
from drivers.errors import DataError
from drivers.files.session import read_session
from drivers.kinematics import se3
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
