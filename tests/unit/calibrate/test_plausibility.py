"""Axis angles against recorded flange poses: every likely mistake is planted and must be named."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calibrate.plausibility import check_reported_poses, likely_cause
from drivers.errors import DataError
from drivers.files.session import Session, read_session
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from tests.support.sessions import write_session
from tests.support.synthetic import abb_robot, paper_robot

N_SHOTS = 12
ABB = abb_robot()
TOOL = se3.from_rotation_translation(se3.exp_so3([0.3, -0.2, 1.0]), [20.0, -35.0, 180.0])
WORK_OBJECT = se3.from_rotation_translation(se3.exp_so3([0.0, 0.1, -0.7]), [400.0, 150.0, -60.0])

Mistake = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


def poses() -> tuple[FloatArray, FloatArray]:
    """Axis angles (m, 6) and the flange poses (m, 4, 4) that belong to them."""
    q = np.random.default_rng(1).uniform(-1, 1, (N_SHOTS, 6)) * [1.0, 0.4, 0.4, 1.5, 1.2, 2.0]
    return q, mdh.base_from_flange(ABB, q)


def in_metres(pose: FloatArray) -> FloatArray:
    result = pose.copy()
    result[:, :3, 3] /= 1000.0
    return result


MISTAKES: dict[str, tuple[Mistake, RobotModel, str]] = {
    "degrees": (lambda q, t: (np.degrees(q), t), ABB, "in degrees"),
    "metres": (lambda q, t: (q, in_metres(t)), ABB, "in metres"),
    "inverse": (lambda q, t: (q, se3.inverse(t)), ABB, "inverse"),
    "reversed axes": (lambda q, t: (q[:, ::-1], t), ABB, "reverse order"),
    "missing coupling": (lambda q, t: (q, t), RobotModel(**{f: getattr(ABB, f) for f in ABB.__slots__} | {"coupling": np.eye(6)}), "missing"),
    "coupling too much": (
        lambda q, t: (q, mdh.base_from_flange(RobotModel(**{f: getattr(ABB, f) for f in ABB.__slots__} | {"coupling": np.eye(6)}), q)),
        ABB,
        "does not belong",
    ),
    "shift by one": (lambda q, t: (q, np.roll(t, 1, axis=0)), ABB, "shifted by one"),
    "shift the other way": (lambda q, t: (q, np.roll(t, -1, axis=0)), ABB, "shifted by one"),
    "tool": (lambda q, t: (q, t @ TOOL), ABB, "tool"),
    "work object": (lambda q, t: (q, WORK_OBJECT @ t), ABB, "work object"),
}


def session(folder: Path, q: FloatArray, t: FloatArray | None) -> Session:
    def change(shots: list[dict[str, object]]) -> None:
        for i, shot in enumerate(shots):
            shot["joints_rad"] = q[i].tolist()
            shot["base_from_flange"] = None if t is None else t[i].tolist()

    return read_session(write_session(folder, len(q), change))


@pytest.mark.parametrize("name", MISTAKES)
def test_a_planted_mistake_is_named(name: str, tmp_path: Path) -> None:
    spoil, model, words = MISTAKES[name]
    q, t = spoil(*poses())
    with pytest.raises(DataError) as told:
        check_reported_poses([session(tmp_path / "s", q, t)], model)
    assert words in told.value.message
    assert "most likely" in told.value.message
    assert told.value.file is not None
    assert told.value.file.endswith("shots.jsonl")
    assert told.value.remedy


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named_in_spite_of_a_factory_calibration_and_one_bad_pair(name: str) -> None:
    """The controller's own model differs by some mm, and one recording is wrong by itself."""
    rng = np.random.default_rng(2)
    q, t = poses()
    t = t @ se3.exp(rng.normal(size=6) * [1, 1, 1, 1e-3, 1e-3, 1e-3])
    t[3] = t[7]
    spoil, model, words = MISTAKES[name]
    assert words in likely_cause(model, *spoil(q, t))


def test_what_nobody_can_name_is_not_named() -> None:
    q, t = poses()
    told = likely_cause(ABB, np.random.default_rng(3).permutation(q), t)
    assert "most likely" not in told


def test_agreement_gives_no_note(tmp_path: Path) -> None:
    q, t = poses()
    assert check_reported_poses([session(tmp_path / "s", q, t)], ABB) == ()
    nearly = t @ se3.exp(np.array([0.1, 0, 0, 0, 0, 0]))
    assert check_reported_poses([session(tmp_path / "t", q, nearly)], ABB) == ()


@pytest.mark.parametrize("size_mm", [0.5, 5.0, 15.0])
def test_a_factory_calibrated_controller_is_told(size_mm: float, tmp_path: Path) -> None:
    q, t = poses()
    off = t @ se3.exp(np.array([size_mm, 0, 0, 1e-3, 0, 0]))
    notes = check_reported_poses([session(tmp_path / "s", q, off)], ABB)
    assert len(notes) == 1
    assert "factory-calibrated" in notes[0]
    assert f"{size_mm:.2f} mm" in notes[0]


def test_an_angle_beyond_a_degree_is_an_error_even_in_place(tmp_path: Path) -> None:
    q, t = poses()
    with pytest.raises(DataError, match="degrees"):
        check_reported_poses([session(tmp_path / "s", q, t @ se3.exp(np.array([0, 0, 0, 0.05, 0, 0])))], ABB)


def test_without_poses_or_without_a_model_there_is_nothing_to_check(tmp_path: Path) -> None:
    q, t = poses()
    assert check_reported_poses([session(tmp_path / "s", q, None)], ABB) == ()
    assert check_reported_poses([session(tmp_path / "t", np.degrees(q), t)], None) == ()
    assert check_reported_poses([], paper_robot()) == ()


def test_the_session_that_is_wrong_is_named(tmp_path: Path) -> None:
    q, t = poses()
    good, bad = session(tmp_path / "good", q, t), session(tmp_path / "bad", np.degrees(q), t)
    with pytest.raises(DataError) as told:
        check_reported_poses([good, bad], ABB)
    assert json.loads(json.dumps(told.value.as_dict()))["file"].endswith("bad/shots.jsonl")
