"""Which sessions a calibration can measure, and which are refused by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import DataError, FileError
from drivers.files.session import Session, read_session
from measure.placing import check_fits, nominal_base_from_camera
from tests.support import damage
from tests.support.recorded import TrueSystem, record_session, write_cell
from tests.support.synthetic import PAPER_FLANGE_FROM_CAMERA, abb_robot, paper_cell, paper_robot

SYSTEM = TrueSystem(paper_cell())


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return record_session(tmp_path / "session", write_cell(tmp_path), np.random.default_rng(1), shots_per_sphere=2, n_points=50)


def test_a_session_of_the_same_robot_fits(session: Session) -> None:
    check_fits(SYSTEM, session)
    check_fits(TrueSystem(paper_cell(), pose_only=True), session)


def test_another_robot_is_refused(session: Session) -> None:
    other = TrueSystem(replace(paper_cell(), nominal=abb_robot()))
    with pytest.raises(DataError, match="Use the calibration of this robot") as caught:
        check_fits(other, session)
    assert caught.value.file == str(session.folder)


def test_sessions_that_contradict_themselves_are_refused(session: Session) -> None:
    damage.unknown_sphere(session.folder)
    with pytest.raises(FileError, match="no sphere"):
        check_fits(SYSTEM, read_session(session.folder))


def test_five_joints_are_refused_with_their_line(session: Session) -> None:
    damage.five_joints(session.folder)
    with pytest.raises(FileError, match="axes"):
        check_fits(SYSTEM, read_session(session.folder))


def test_before_is_the_nominal_robot_with_the_first_guess() -> None:
    q = np.array([0.1, 0.2, -0.3, 0.4, 0.5, -0.6])
    by_joints = nominal_base_from_camera(paper_robot(), PAPER_FLANGE_FROM_CAMERA, q, None)
    assert by_joints is not None
    by_pose = nominal_base_from_camera(None, PAPER_FLANGE_FROM_CAMERA, None, by_joints @ np.linalg.inv(PAPER_FLANGE_FROM_CAMERA))
    assert by_pose is not None
    np.testing.assert_allclose(by_pose, by_joints, atol=1e-9)
    assert nominal_base_from_camera(paper_robot(), None, q, None) is None
    assert nominal_base_from_camera(None, PAPER_FLANGE_FROM_CAMERA, None, None) is None
