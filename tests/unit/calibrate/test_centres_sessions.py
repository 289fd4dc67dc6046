"""`calibrate` by centres on sessions: what it says, what changes nothing, what it rejects and refuses, and honest intervals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate import Calibration
from calibrate.observations import Observations, SphereShot
from calibrate.solve import CalibrationSettings, calibrate, solve_observations
from drivers.errors import SettingsError
from drivers.files.session import read_session
from tests.support.solving import draw_shots, noise_free, off_by
from tests.support.synthetic import SyntheticShot, paper_cell
from tests.support.synthetic_session import write_session
from tests.support.unseen import misses_mm, places_in_base_mm, random_unseen_lengths
from tests.support.volume import volume_cell

CENTRES = CalibrationSettings(camera_error="pillow", method="centres")
CELL = paper_cell()


def run(folder: Path, settings: CalibrationSettings = CENTRES) -> Calibration:
    return calibrate([read_session(folder)], settings)


@pytest.fixture(scope="module")
def shots() -> list[SyntheticShot]:
    return draw_shots(CELL, np.random.default_rng(20), 40, n_points=100)


@pytest.fixture(scope="module")
def tests() -> list[SyntheticShot]:
    return noise_free(CELL, np.random.default_rng(21), 20, n_points=20)


@pytest.fixture(scope="module")
def plain(shots: list[SyntheticShot], tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    return run(write_session(tmp_path_factory.mktemp("plain") / "s", CELL, {"A": shots}, flange_from_camera=None))


def test_the_result_says_how_it_was_made_and_unseen_points_come_out_where_they_are(
    plain: Calibration, tests: list[SyntheticShot], tmp_path: Path
) -> None:
    assert np.sqrt((misses_mm(plain, tests, CELL) ** 2).mean()) < 0.06
    assert (plain.statistics.n_shots, plain.statistics.used, plain.statistics.rank) == (40, 40, 27)
    assert plain.to_json_dict()["method"] == plain.method == "centres"
    plain.save(tmp_path / "c.yaml")
    assert Calibration.load(tmp_path / "c.yaml").method == "centres"
    assert plain.verdict == "marginal"
    assert any("certified length" in reason for reason in plain.reasons)


def test_neither_order_nor_first_guess_changes_the_result(
    shots: list[SyntheticShot], tests: list[SyntheticShot], plain: Calibration, tmp_path: Path
) -> None:
    order = np.random.default_rng(22).permutation(40).tolist()
    guess = off_by(CELL.flange_from_camera, np.random.default_rng(23), 30.0, 0.3)
    for name, hand_eye, turned in (("order", None, order), ("guess", guess, list(range(40)))):
        other = run(write_session(tmp_path / name, CELL, {"A": shots}, flange_from_camera=hand_eye, order=turned))
        np.testing.assert_allclose(places_in_base_mm(other, tests), places_in_base_mm(plain, tests), atol=1e-6)
        assert other.statistics.cross_validated_rms_mm == pytest.approx(plain.statistics.cross_validated_rms_mm, abs=1e-6)


def test_auto_takes_the_pillow_where_the_camera_has_one(shots: list[SyntheticShot], tmp_path: Path) -> None:
    found = run(write_session(tmp_path / "s", CELL, {"A": shots}, flange_from_camera=None), CalibrationSettings(method="centres"))
    assert found.camera_error.name == "pillow"
    assert found.statistics.compared["pillow"] < found.statistics.compared["none"]


def test_spoiled_shots_are_rejected_with_a_reason(tmp_path: Path) -> None:
    rng = np.random.default_rng(25)
    members = draw_shots(CELL, rng, 50, n_points=80)
    chosen = rng.choice(50, 3, replace=False).tolist()
    for i in chosen:
        direction = rng.normal(size=3)
        members[i] = replace(members[i], points_in_camera_mm=members[i].points_in_camera_mm + 2.0 * direction / np.linalg.norm(direction))
    found = run(write_session(tmp_path / "s", CELL, {"A": members}, flange_from_camera=None))
    rejected = {shot.index for shot in found.rejected}
    assert rejected >= set(chosen)
    assert len(rejected) <= 4
    assert all("outlier" in shot.reason and "mm" in shot.reason for shot in found.rejected)


def test_poses_without_axis_angles_are_solved_for_hand_eye_and_camera(pose_only_session: Path) -> None:
    found = run(pose_only_session)
    assert found.model is None
    assert (found.statistics.rank, found.statistics.n_parameters) == (9, 9)
    np.testing.assert_allclose(found.sphere_centres_in_base_mm["A"], CELL.centre_in_base_mm, atol=0.1)
    np.testing.assert_allclose(found.flange_from_camera[:3, :3], CELL.flange_from_camera[:3, :3], atol=2e-3)


def test_a_line_profile_sensor_is_refused_with_the_method_that_takes_it() -> None:
    volume, rng = volume_cell(1, "one"), np.random.default_rng(2)
    camera = volume.cell.camera.model_copy(update={"kind": "line_profile"})
    cell = volume.cell.model_copy(update={"camera": camera})
    shots = tuple(SphereShot("s", i, "A", f"{i:064d}", np.zeros(6), np.eye(4), rng.uniform(-10, 10, (40, 3)), 19.05, None) for i in range(12))
    with pytest.raises(SettingsError) as told:
        solve_observations(Observations(shots, ()), cell, volume.model, CalibrationSettings(method="centres"))
    assert "clouds" in str(told.value.remedy)


@pytest.mark.qualify
def test_intervals_of_unseen_lengths_cover(tmp_path: Path) -> None:
    """As in `test_coverage`; one length in a calibration would be fairer, and dearer."""
    settings = {"n_shots": 34, "n_points": 60, "n_lengths": 10}
    lengths = [one for s in range(3) for one in random_unseen_lengths(60 + s, tmp_path / str(s), method="centres", **settings)]
    z = np.array([one.error_mm / one.sigma_mm for one in lengths])
    assert np.mean(np.abs(z) <= 1.96) >= 0.85
    assert 0.3 < np.sqrt((z**2).mean()) < 1.5
    assert np.median([one.sigma_mm for one in lengths]) < 0.12
