"""The scene of a run: frames, clouds and curves are those of the calibration, before and after."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import Cell, robot_model_of
from calibrate.observations import Observations, gather_observations
from calibrate.result import Calibration
from drivers.files.session import Session
from drivers.kinematics import se3
from measure.run_scene import scene_of
from measure.verify import verify
from measure.viewer import write_recording
from tests.support.recorded import PLACES, nominal_calibration, record_session, write_cell


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    return write_cell(tmp_path_factory.mktemp("cell"))


@pytest.fixture(scope="module")
def session(cell: Cell) -> Session:
    return record_session(cell.folder / "calib", cell, np.random.default_rng(1), shots_per_sphere=3, purpose="calibration")


@pytest.fixture(scope="module")
def observations(cell: Cell, session: Session) -> Observations:
    return gather_observations([session], cell=cell, model=robot_model_of(cell))


@pytest.fixture(scope="module")
def calibration(cell: Cell, session: Session) -> Calibration:
    return nominal_calibration(cell, [session])


def test_every_shot_is_a_step_with_the_calibrated_robot(calibration: Calibration, cell: Cell, observations: Observations) -> None:
    scene = scene_of(calibration, cell, observations.shots)
    assert len(scene.steps) == len(observations.shots)
    for step, shot in zip(scene.steps, observations.shots, strict=True):
        assert step.base_from_links.shape == (7, 4, 4)
        assert shot.joints_rad is not None
        flange = calibration.base_from_flange(shot.joints_rad)
        np.testing.assert_allclose(step.base_from_links[-1], flange, atol=1e-9)
        np.testing.assert_allclose(step.base_from_camera, flange @ calibration.flange_from_camera, atol=1e-9)
        np.testing.assert_allclose(step.after_in_base_mm, calibration.points_in_base_mm(shot.points_in_camera_mm, joints_rad=shot.joints_rad))
        assert cell.flange_from_camera is not None
        before = se3.apply(shot.base_from_flange @ cell.flange_from_camera, shot.points_in_camera_mm)
        np.testing.assert_allclose(step.before_in_base_mm, before)
        assert {name.split(":")[0] for name in step.curves} == {"before", "after"}


def test_spheres_carry_the_errors_of_their_own_points(calibration: Calibration, cell: Cell, observations: Observations) -> None:
    scene = scene_of(calibration, cell, observations.shots)
    assert {mark.name for mark in scene.spheres} == set(PLACES)
    for mark in scene.spheres:
        assert mark.after is not None
        assert mark.before is not None
        assert len(mark.after.points_in_base_mm) == sum(len(s.points_in_camera_mm) for s in observations.shots if s.sphere == mark.name)
        np.testing.assert_allclose(np.linalg.norm(mark.centre_in_base_mm - np.array(PLACES[mark.name])), 0, atol=3)
        assert abs(float(np.median(mark.after.radial_error_mm))) < 0.5


def test_without_a_first_guess_there_is_no_before(calibration: Calibration, cell: Cell, observations: Observations) -> None:
    scene = scene_of(calibration, cell.model_copy(update={"flange_from_camera": None}), observations.shots)
    assert all(len(step.before_in_base_mm) == 0 for step in scene.steps)
    assert all(mark.before is None for mark in scene.spheres)
    assert all(name.startswith("after") for step in scene.steps for name in step.curves)


def test_verification_and_workpiece_follow_and_the_whole_is_written(
    calibration: Calibration, cell: Cell, observations: Observations, tmp_path: Path
) -> None:
    unseen = record_session(tmp_path / "verif", cell, np.random.default_rng(2), shots_per_sphere=3)
    workpiece = record_session(tmp_path / "part", cell, np.random.default_rng(3), shots_per_sphere=1, purpose="workpiece")
    result = verify(calibration, [unseen])
    scene = scene_of(
        calibration, cell, observations.shots, verification=result, workpiece=workpiece, stitched_in_base_mm=np.zeros((3, 3))
    )
    assert len(scene.steps) == 6 + 6 + 2
    assert scene.steps[-1].label.startswith("workpiece")
    assert {mark.name for mark in scene.spheres} == {"A", "B", "A (verification)", "B (verification)"}
    assert "unseen shots" in scene.texts["summary"]
    assert write_recording(tmp_path / "run.rrd", scene).stat().st_size > 10_000


def test_pose_only_calibrations_show_the_flange(calibration: Calibration, cell: Cell, observations: Observations) -> None:
    pose_only = replace(calibration, model=None, link_twists=np.zeros((0, 6)))
    scene = scene_of(pose_only, cell, [replace(shot, joints_rad=None) for shot in observations.shots])
    assert all(step.base_from_links.shape == (1, 4, 4) for step in scene.steps)


def test_nothing_at_hand_is_an_empty_scene(calibration: Calibration, cell: Cell) -> None:
    scene = scene_of(calibration, cell, [])
    assert scene.steps == ()
    assert "Not verified yet" in scene.texts["summary"]
