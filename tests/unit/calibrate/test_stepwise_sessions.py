"""`--method stepwise` on recorded sessions: solved by the paper's method, judged and stored as any other calibration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate import Calibration
from calibrate.solve import CalibrationSettings, calibrate
from drivers.errors import DataError, SettingsError
from drivers.files.session import read_session
from tests.support.once import once_a_run
from tests.support.solving import draw_shots, off_by
from tests.support.synthetic import paper_cell
from tests.support.synthetic_session import write_session

STEPWISE = CalibrationSettings(method="stepwise")


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Calibration]:
    """A session and what the paper's method makes of it."""

    def make(folder: Path) -> tuple[Path, Calibration]:
        cell, rng = paper_cell(), np.random.default_rng(8)
        guess = off_by(cell.flange_from_camera, rng)
        session = write_session(folder / "s", cell, {"A": draw_shots(cell, rng, 40, n_points=150)}, flange_from_camera=guess)
        return session, calibrate([read_session(session)], STEPWISE)

    return once_a_run(tmp_path_factory, "stepwise", make)


@pytest.fixture(scope="module")
def session(both: tuple[Path, Calibration]) -> Path:
    return both[0]


@pytest.fixture(scope="module")
def stepwise(both: tuple[Path, Calibration]) -> Calibration:
    return both[1]


def test_the_file_says_which_method_it_was(stepwise: Calibration, tmp_path: Path) -> None:
    stepwise.save(tmp_path / "c.yaml")
    loaded = Calibration.load(tmp_path / "c.yaml")
    assert loaded.method == stepwise.to_json_dict()["method"] == "stepwise"
    assert loaded.camera_error.name == "pillow"
    assert loaded.id == stepwise.id
    np.testing.assert_array_equal(loaded.link_twists, stepwise.link_twists)


def test_it_is_held_out_and_its_covariance_says_what_it_misses(stepwise: Calibration) -> None:
    statistics = stepwise.statistics
    assert statistics.used == statistics.n_shots == 40
    assert 0.03 < statistics.cross_validated_rms_mm < 0.5
    assert statistics.predicted_centre_rms_mm is not None
    assert statistics.predicted_centre_rms_mm * statistics.covariance_scale**0.5 >= 0.99 * statistics.cross_validated_rms_mm
    assert (statistics.rank, statistics.n_parameters) == (27, 45)


def test_what_one_sphere_leaves_of_a_length_is_told_without_work_volume_or_limits(stepwise: Calibration) -> None:
    told = [reason for reason in stepwise.reasons if "uses no certified length" in reason]
    assert ["about the only sphere place has U = " in reason for reason in told] == [True], stepwise.reasons


def test_whole_clouds_predict_unseen_shots_better(stepwise: Calibration, session: Path) -> None:
    clouds = calibrate([read_session(session)], CalibrationSettings(camera_error="pillow"))
    assert clouds.method == "clouds"
    assert clouds.statistics.cross_validated_rms_mm < 0.9 * stepwise.statistics.cross_validated_rms_mm


def test_without_a_camera_error_it_is_method_2(session: Path) -> None:
    found = calibrate([read_session(session)], replace(STEPWISE, camera_error="none"))
    assert found.camera_error.name == "none"
    assert (found.statistics.rank, found.statistics.n_parameters) == (24, 42)


def test_pose_only_sessions_solve_the_hand_eye_block(pose_only_session: Path) -> None:
    found = calibrate([read_session(pose_only_session)], STEPWISE)
    assert found.model is None
    assert found.statistics.cross_validated_rms_mm < 0.3
    error = found.flange_from_camera @ np.linalg.inv(paper_cell().flange_from_camera)
    assert np.abs(error[:3, :3] - np.eye(3)).max() < 2e-3


@pytest.mark.qualify
def test_a_certified_length_is_not_used_and_the_verdict_says_so(tmp_path: Path) -> None:
    cell, rng = paper_cell(), np.random.default_rng(10)
    there = replace(cell, centre_in_base_mm=np.array([820.0, -250.0, 380.0]))
    shots = {"A": draw_shots(cell, rng, 16, n_points=100), "B": draw_shots(there, rng, 16, n_points=100)}
    length = ("A", "B", float(np.linalg.norm(cell.centre_in_base_mm - there.centre_in_base_mm)), 0.005)
    folder = write_session(tmp_path / "s", cell, shots, flange_from_camera=cell.flange_from_camera, lengths=[length])
    found = calibrate([read_session(folder)], STEPWISE)
    assert any("stepwise uses no certified length" in reason for reason in found.reasons)
    apart = found.sphere_centres_in_base_mm["A"] - found.sphere_centres_in_base_mm["B"]
    assert abs(float(np.linalg.norm(apart)) - length[2]) < 1.0


@pytest.mark.parametrize("model", ["affine", "field"])
def test_a_camera_error_that_is_not_the_papers_is_refused(session: Path, model: str) -> None:
    with pytest.raises(SettingsError, match=model):
        calibrate([read_session(session)], replace(STEPWISE, camera_error=model))


def test_an_unknown_method_is_refused(session: Path) -> None:
    with pytest.raises(SettingsError, match="'guess'"):
        calibrate([read_session(session)], CalibrationSettings(method="guess"))


def test_too_few_shots_are_told(tmp_path: Path) -> None:
    cell, rng = paper_cell(), np.random.default_rng(9)
    folder = write_session(tmp_path / "s", cell, {"A": draw_shots(cell, rng, 3, n_points=150)}, flange_from_camera=cell.flange_from_camera)
    with pytest.raises(DataError, match="pairs of consecutive shots"):
        calibrate([read_session(folder)], STEPWISE)
